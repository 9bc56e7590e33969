"""A URDF with identified links: the file as it was, with other `<inertial>` elements."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple
from xml.parsers import expat
from xml.sax.saxutils import escape

import numpy as np
from jaxtyping import Bool, Num

from jaximp.models.chain import Chain
from jaximp.models.spatial import about, moved, pseudo_inertia
from jaximp.models.urdf import Urdf, read_urdf
from jaximp.results import Column
from jaximp.types import AnyArray, Numbers, listed

MOST_BEHIND = 0.9
"""Links behind locked joints keep no more than this of the sum that they are part of, in any of its moments."""


@dataclass(frozen=True, eq=False)
class Exported:
    """What stands in a URDF that was written, and where its numbers come from."""

    path: Path
    names: tuple[str, ...]
    """Of the P standard parameters."""
    units: tuple[str, ...]
    value: Numbers
    """(P,) as exported."""
    file_value: Numbers
    """(P,) of the original URDF."""
    source: tuple[str, ...]
    """(P,) `data` or `prior`, which is the URDF; `not written` for what joints have: a URDF lacks a place for most."""

    def columns(self) -> list[Column]:
        """The table: parameter, unit, value, that of the original file, and whether the data or the prior say so."""
        return [
            Column("parameter", "", list(self.names)),
            Column("unit", "", list(self.units)),
            Column("value", "", self.value),
            Column("file", "", self.file_value),
            Column("source", "", list(self.source)),
        ]


def export_urdf(
    source: str | Path,
    chain: Chain,
    standard: Num[AnyArray, " P"],
    determined: Bool[AnyArray, " P"],
    out: str | Path,
) -> Exported:
    """Write a chain's URDF with other inertial parameters; all else in the file stays as it is, to the letter.

    Everything that moves together has one inertia in a chain. It is written to the link that the joint moves; links
    that are fixed to it lose their `<inertial>`, as they are in the sum. (To share it out again would take guesses, and
    the rest could be no real body.) Links behind locked joints keep theirs, as what can move needs one, and the link
    that bears them has the rest of the sum at the locked position: so the file can be read without locking anything.
    Where the rest would be no real body, they keep the largest share that leaves one. Friction and rotors' inertias are
    not written. A comment at the head of the file says which numbers the data determined.

    **Arguments:** `source` the URDF that the chain was made of; `standard` parameters as of `consistent_fit`; which of
    them the data `determined`, such as `consistent_ranges(...).determined`; `out` the file to write.

    **Raises:** `ValueError` in one line for a file that is not that of the chain, shapes that do not fit, links that no
    body can have (find the nearest that can with `consistent_fit`), and where `out` is the source or cannot be written.
    """
    source, out = Path(source), Path(out)
    standard, determined = np.asarray(standard, float), np.asarray(determined, bool)
    P = len(chain.base.standard_names)
    if standard.shape != (P,) or determined.shape != (P,):
        raise ValueError(
            f"there are {standard.size} standard parameters and {determined.size} marks: for this chain there are {P}, "
            "in the order of chain.base.standard_names"
        )
    urdf = read_urdf(source)
    missing = [name for names in chain.link_names for name in names if name not in urdf.links]
    if missing:
        raise ValueError(f"{source} has no link '{missing[0]}': give the URDF that the chain was made of")
    if out.resolve() == source.resolve():
        raise ValueError(f"{out} is the original: give another file")
    links = standard[: 10 * chain.tree.n_bodies].reshape(-1, 10)
    lumps = [_lump(urdf, chain, k, link) for k, link in enumerate(links)]
    inertials = {name: element for lump in lumps for name, element in lump.inertials.items()}
    marks = ["data" if mark else "prior" for mark in determined[: links.size]] + ["not written"] * (P - links.size)
    found = Exported(
        out,
        chain.base.standard_names,
        chain.standard_units,
        standard,
        np.array(chain.standard_parameters, float),
        tuple(marks),
    )
    # The decoded text, so that places count in its own bytes.
    text = source.read_text(encoding="utf-8-sig").encode("utf-8")
    try:
        out.write_bytes(_replaced(text, inertials, _comment(found, lumps)))
    except OSError as error:
        raise ValueError(f"{out} cannot be written: {error.strerror or error}; choose another place") from None
    return found


class _Lump(NamedTuple):
    """What moves together, and how it is shared out over its links."""

    fixed: tuple[str, ...]
    """The link that the joint moves, and those that are fixed to it."""
    held: tuple[str, ...]
    """Links behind locked joints."""
    share: float
    """That they keep of their inertia."""
    inertials: dict[str, str]
    """The new element of each link that changes; empty for none."""


def _lump(urdf: Urdf, chain: Chain, k: int, total: Numbers) -> _Lump:
    names, frames = chain.link_names[k], chain.frames
    kinds = {joint.child: joint.kind for joint in urdf.joints}
    held: list[str] = []
    for name in names[1:]:  # parents before children
        if kinds[name] != "fixed" or frames[name].parent in held:
            held.append(name)
    own = {name: inertia for name in held if (inertia := urdf.links[name]) is not None}
    behind = sum((moved(x, frames[name].rotation, frames[name].position) for name, x in own.items()), np.zeros(10))
    whole = pseudo_inertia(total)
    if not np.isfinite(total).all() or not np.linalg.eigvalsh(whole)[0] > 0:
        raise ValueError(f"link{k + 1} is no real body: find the nearest robot that can be with consistent_fit")
    # The rest is a real body as long as no combination of moments needs more than the whole has.
    most = float(np.linalg.eigvals(np.linalg.solve(whole, pseudo_inertia(behind))).real.max())
    share = min(1.0, MOST_BEHIND / most) if most > 0 else 1.0
    fixed = tuple(name for name in names if name not in held)
    inertials = dict.fromkeys(fixed, "") | {names[0]: _inertial(total - share * behind)}
    if share < 1:
        inertials |= {name: _inertial(share * x) for name, x in own.items()}
    return _Lump(fixed, tuple(held), share, inertials)


def _inertial(link: Numbers) -> str:
    """The element of a link about its centre of mass, in the axes of its frame."""
    mass = link[0]
    centre = link[1:4] / mass if mass > 0 else np.zeros(3)
    xx, xy, yy, xz, yz, zz = (link - about(mass, centre, np.zeros((3, 3))))[4:]
    numbers = {"ixx": xx, "ixy": xy, "ixz": xz, "iyy": yy, "iyz": yz, "izz": zz}
    inertia = " ".join(f'{key}="{value:.15g}"' for key, value in numbers.items())
    return (
        f'<inertial><origin xyz="{" ".join(f"{x:.15g}" for x in centre)}" rpy="0 0 0"/><mass value="{mass:.15g}"/>'
        f"<inertia {inertia}/></inertial>"
    )


def _comment(found: Exported, lumps: list[_Lump]) -> bytes:
    """Which numbers the data determined, link by link."""
    lines = [
        "Inertial parameters by jaximp, about the origin of each link's frame. Determined by data, or kept from the"
    ]
    lines.append("original file (prior) as far as a real body with the same torques can keep them:")
    for k, lump in enumerate(lumps):
        at = range(10 * k, 10 * k + 10)
        by = {mark: [found.names[j].split(".")[1] for j in at if found.source[j] == mark] for mark in ("data", "prior")}
        also = [f"{listed(lump.fixed[1:])}, whose inertial is in this sum"] if lump.fixed[1:] else []
        if lump.held:
            kept = "the inertial" if lump.share == 1 else f"{lump.share:.0%} of the inertial"
            also.append(f"{listed(lump.held)} behind locked joints, which keep {kept} of the original file")
        about_it = f" (with {', and '.join(also)})" if also else ""
        lines.append(
            f"{lump.fixed[0]}{about_it}: data {', '.join(by['data']) or 'none'}; "
            f"prior {', '.join(by['prior']) or 'none'}"
        )
    # Two hyphens would end a comment too early.
    text = "\n  ".join(lines).replace("--", "- -")
    return f"\n  <!-- {escape(text)} -->".encode()


def _replaced(text: bytes, inertials: dict[str, str], comment: bytes) -> bytes:
    """The file with other inertials of these links (none where it is empty), and a comment after the first tag."""
    edits = _Places(text).edits(inertials, comment)
    for begin, end, new in sorted(edits, reverse=True):
        text = text[:begin] + new + text[end:]
    return text


class _Places:
    """Where the first tag ends, and where links and their inertials begin and end, in bytes."""

    def __init__(self, text: bytes):
        self.text, self.path = text, list[tuple[str, int]]()
        self.head = 0
        self.links: dict[str, tuple[int, int, bool]] = {}
        """Begin and end of the start tag, and whether it is the whole element."""
        self.inertials: dict[str, tuple[int, int]] = {}
        self.link = ""
        parser = expat.ParserCreate("utf-8")
        parser.StartElementHandler, parser.EndElementHandler = self._start, self._end
        self.parser = parser
        parser.Parse(text, True)

    def edits(self, inertials: dict[str, str], comment: bytes) -> list[tuple[int, int, bytes]]:
        """What to put in place of which bytes."""
        found = [(self.head, self.head, comment)]
        for name, element in inertials.items():
            new = element.encode()
            begin, end, alone = self.links[name]
            if name in self.inertials:
                found.append((*self.inertials[name], new))
            elif new and alone:  # <link name="x"/>
                slash = self.text.rindex(b"/", begin, end)
                found.append((slash, end, b">" + new + b"</link>"))
            elif new:
                found.append((end, end, new))
        return found

    def _start(self, tag: str, attributes: dict[str, str]) -> None:
        begin = self.parser.CurrentByteIndex
        end = self._end_of_tag(begin)
        if not self.path:
            self.head = end
        if len(self.path) == 1 and tag == "link":
            self.link = attributes["name"]
            self.links[self.link] = begin, end, self.text[end - 2 : end] == b"/>"
        self.path.append((tag, begin))

    def _end(self, tag: str) -> None:
        _, begin = self.path.pop()
        if [name for name, _ in self.path] == ["robot", "link"] and tag == "inertial":
            # What has no content of its own ends where it began.
            self.inertials[self.link] = begin, self._end_of_tag(self.parser.CurrentByteIndex)

    def _end_of_tag(self, begin: int) -> int:
        """Behind the next `>` that stands in no quotes."""
        quote = b""
        for at in range(begin, len(self.text)):
            letter = self.text[at : at + 1]
            if quote:
                quote = b"" if letter == quote else quote
            elif letter in (b'"', b"'"):
                quote = letter
            elif letter == b">":
                return at + 1
        return len(self.text)
