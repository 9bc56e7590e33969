"""Robots from URDF files: links and joints as they stand in the file, then the bodies that its joints move.

Only the standard library reads the XML, nothing in the file is fetched or expanded, and its size is bounded. Geometry
(meshes, collision shapes) is ignored. The format is that of https://wiki.ros.org/urdf/XML.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from jaximp.models.spatial import about, moved, rotation, rotation_about
from jaximp.types import Numbers, listed, nearest

SIX_JOINT_ARM = Path(__file__).parents[1] / "data" / "six_joint_arm.urdf"
"""A made-up arm that comes with the package, to try things on."""
LARGEST_FILE = 20_000_000
"""Of a URDF [bytes]. Meshes stand in files of their own, so that even humanoids need less than a hundredth of it."""
MOST_LINKS = 1000
"""Links of one file."""
MOST_MOVING = 128
"""Bodies that move: every one of them has a row and ten columns."""
KINDS = ("revolute", "continuous", "prismatic", "fixed", "floating", "planar")


@dataclass(frozen=True)
class Limits:
    """What a joint is allowed to do; infinite where the file says nothing."""

    lower: float = -np.inf
    """Of the position [rad or m]."""
    upper: float = np.inf
    velocity: float = np.inf
    """Largest speed [rad/s or m/s]."""
    effort: float = np.inf
    """Largest torque [N m] or force [N]."""


@dataclass(frozen=True, eq=False)
class Joint:
    """One joint as the file has it."""

    name: str
    kind: str
    parent: str
    """The link it is attached to."""
    child: str
    """The link it moves."""
    rotation: Numbers
    """(3, 3) from the child's frame to the parent's, with the joint at zero."""
    position: Numbers
    """(3,) origin of the child's frame in the parent's [m]."""
    axis: Numbers
    """(3,) of length one, in the child's frame."""
    limits: Limits
    damping: float
    """[N m s/rad] or [N s/m]."""
    friction: float
    """[N m] or [N]."""
    mimic: tuple[str, float, float] | None
    """The joint that it follows, with multiplier and offset: `position = multiplier * position of that + offset`."""


@dataclass(frozen=True, eq=False)
class Urdf:
    """A file: links with their inertias, and joints between them."""

    source: str
    """What errors call it."""
    robot: str
    """The robot's name."""
    links: dict[str, Numbers | None]
    """Ten parameters of each link about the origin of its frame (`spatial.PARAMETERS`); None without `<inertial>`."""
    joints: tuple[Joint, ...]

    @property
    def root(self) -> str:
        """The link that no joint moves."""
        children = {joint.child for joint in self.joints}
        return next(link for link in self.links if link not in children)


@dataclass(frozen=True, eq=False)
class Body:
    """What one joint moves: its link, with all that is fixed to it."""

    joint: Joint
    parent: int
    """The body that the joint is attached to; -1 for the base."""
    rotation: Numbers
    """(3, 3) from this body's frame to the parent body's, with the joint at zero."""
    position: Numbers
    """(3,) of this body's frame in the parent body's."""
    inertia: Numbers
    """(10,) about the origin of its frame, which is that of the link the joint moves."""
    links: tuple[str, ...]
    """Which it is lumped from, the moved one first."""


@dataclass(frozen=True, eq=False)
class Frame:
    """Where a link is fixed."""

    body: int
    """-1 for the base."""
    rotation: Numbers
    position: Numbers
    parent: str = ""
    """The link that it hangs on; none for the base."""


@dataclass(frozen=True, eq=False)
class Bodies:
    """Everything that moves, parents before children, and where each link of the file is fixed."""

    bodies: tuple[Body, ...]
    frames: dict[str, Frame]


def read_urdf(path: str | Path) -> Urdf:
    """A URDF file as links and joints.

    **Raises:** `ValueError`, in one line that names cause and remedy, for what is no URDF: not XML, xacro, SDF or MJCF,
    a document type or entities, a joint without an axis, parts that do not hang together, a closed loop.
    """
    path = Path(path)
    return parse_urdf(text_of(path), str(path))


def text_of(path: Path) -> str:
    """What stands in a URDF file. **Raises:** `ValueError` for a file that cannot be read, is too large, or no text."""
    try:
        size = path.stat().st_size
        raw = path.read_bytes() if size <= LARGEST_FILE else b""
    except OSError as error:
        raise ValueError(f"{path} cannot be read: {error.strerror or error}; give the path of a URDF file") from None
    if size > LARGEST_FILE:
        raise ValueError(f"{path} has {size} bytes: a URDF has at most {LARGEST_FILE}; meshes belong in other files")
    try:
        return raw.decode("utf-8-sig")
    except UnicodeDecodeError:
        raise ValueError(f"{path} is no text in UTF-8: save it as such") from None


def parse_urdf(text: str, source: str = "the URDF") -> Urdf:
    """The text of a URDF file as links and joints; errors call it `source`. As `read_urdf`."""
    root = root_of(text, source)
    read = _Reader(source)
    links = {read.name(element): read.inertia(element) for element in read.all(root, "link")}
    joints = tuple(read.joint(element) for element in read.all(root, "joint"))
    _check_tree(source, links, joints)
    return Urdf(source, root.get("name") or "robot", links, joints)


def moving_bodies(
    urdf: Urdf, base: str | None = None, locked: Mapping[str, float] | None = None, strict: bool = True
) -> Bodies:
    """What moves above the link `base` (the root), with what is fixed to it lumped.

    **Arguments:** `locked` joints stay at these positions [rad or m]; what follows one of them (`mimic`) stays, too.
    Unless `strict`, a body without `<inertial>` has no mass, and limits of zero are none.

    **Raises:** `ValueError` for an unknown link or joint, for a joint of kind `floating` or `planar`, for a body
    without inertia and a limit of zero (if strict), and where nothing moves.
    """
    base = urdf.root if base is None else base
    require_known(urdf.source, "base", "link", base, urdf.links)
    held = _held(urdf, locked or {})
    at = {base: Frame(-1, np.eye(3), np.zeros(3))}
    bodies: list[Body] = []
    for joint in _below(urdf, base):
        below = at[joint.parent]
        R, p = below.rotation @ joint.rotation, below.rotation @ joint.position + below.position
        inertia = urdf.links[joint.child]
        if joint.kind == "fixed" or joint.name in held:
            R, p = _displaced(joint, held.get(joint.name, 0.0), R, p)
            at[joint.child] = Frame(below.body, R, p, joint.parent)
            if below.body >= 0:
                lump = bodies[below.body]
                more = 0.0 if inertia is None else moved(inertia, R, p)
                links = (*lump.links, joint.child)
                bodies[below.body] = replace(lump, inertia=lump.inertia + more, links=links)
            continue
        if joint.kind in ("floating", "planar"):
            raise ValueError(
                f"{urdf.source}: joint '{joint.name}' is {joint.kind}: only joints of one degree of freedom are known; "
                f"name it in locked, or start above it with the base '{joint.child}'"
            )
        limits = _checked_limits(urdf.source, joint, strict)
        at[joint.child] = Frame(len(bodies), np.eye(3), np.zeros(3), joint.parent)
        own = np.zeros(10) if inertia is None else inertia
        bodies.append(Body(replace(joint, limits=limits), below.body, R, p, own, (joint.child,)))
    _check_bodies(urdf, bodies, base, strict)
    return Bodies(tuple(bodies), at)


def require_known(source: str, keyword: str, thing: str, name: str, known: Iterable[str]) -> None:
    """**Raises:** `ValueError` for a name that the file has not, with the one that was probably meant."""
    known = list(known)
    if name not in known:
        raise ValueError(f"{source}: {keyword} is '{name}', but no {thing} is called so: {nearest(name, known)}")


def root_of(text: str, source: str) -> ET.Element:
    """The `<robot>`. What could expand or fetch something is refused before anything is parsed."""
    for mark, what in {"<!DOCTYPE": "a document type", "<!ENTITY": "entities"}.items():
        if mark in text:
            raise ValueError(f"{source} declares {what} ({mark} ...), which is not read for safety: delete it")
    try:
        root = ET.fromstring(text)
    except (ET.ParseError, ValueError) as error:
        raise ValueError(f"{source} is not XML: {error}; give the path of a URDF file") from None
    if root.tag != "robot":
        raise ValueError(f"{source} is no URDF: it begins with <{root.tag}>, and a URDF with <robot>; convert it")
    for element in [one for one in root if _defines(one)]:
        root.remove(element)
    if any("xacro}" in element.tag for element in root.iter() if isinstance(element.tag, str)):
        raise ValueError(f"{source} is a xacro file: run `xacro {source} > robot.urdf`, and give robot.urdf")
    return root


def _defines(element: ET.Element) -> bool:
    """Whether it is a definition of xacro, which some tools leave behind: nothing comes of it by itself."""
    _, inside, name = str(element.tag).rpartition("xacro}")
    return bool(inside) and name in ("property", "macro", "arg")


class _Reader:
    """Elements to numbers, with errors that name the element."""

    def __init__(self, source: str):
        self.source = source

    def error(self, text: str) -> ValueError:
        return ValueError(f"{self.source}: {text}")

    def all(self, root: ET.Element, tag: str) -> list[ET.Element]:
        elements = root.findall(tag)
        if not elements:
            raise self.error(f"there is no <{tag}>: a chain has links and joints between them")
        if len(elements) > MOST_LINKS:
            raise self.error(f"there are {len(elements)} <{tag}>s: at most {MOST_LINKS} are read")
        names = [self.name(element) for element in elements]
        twice = next((name for k, name in enumerate(names) if name in names[:k]), None)
        if twice is not None:
            raise self.error(f"two {tag}s are called '{twice}': rename one")
        return elements

    def name(self, element: ET.Element) -> str:
        name = element.get("name")
        if not name:
            raise self.error(f"a <{element.tag}> has no name: give it one")
        if "${" in name or "$(" in name:
            raise self.error(
                f"a <{element.tag}> is called '{name}': that is xacro; run `xacro {self.source} > robot.urdf`"
            )
        return name

    def numbers(self, element: ET.Element | None, key: str, default: str | None, count: int, where: str) -> Numbers:
        """An attribute of so many finite numbers."""
        text = default if element is None else element.get(key, default)
        if text is None:
            raise self.error(f"{where} has no '{key}': add it")
        if "${" in text or "$(" in text:
            raise self.error(f"{where} has {key}='{text}': that is xacro; run `xacro {self.source} > robot.urdf`")
        try:
            values = np.array([float(part) for part in text.split()])
        except ValueError:
            values = np.zeros(0)
        if len(values) != count or not np.isfinite(values).all():
            expected = "one finite number" if count == 1 else f"{count} finite numbers with spaces between"
            raise self.error(f"{where} has {key}='{text}': it must be {expected}")
        return values

    def number(self, element: ET.Element | None, key: str, default: str | None, where: str) -> float:
        return float(self.numbers(element, key, default, 1, where)[0])

    def origin(self, element: ET.Element, where: str) -> tuple[Numbers, Numbers]:
        """Rotation (3, 3) and position (3,) of an `<origin>`."""
        origin = element.find("origin")
        angles = self.numbers(origin, "rpy", "0 0 0", 3, where)
        return rotation(angles), self.numbers(origin, "xyz", "0 0 0", 3, where)

    def inertia(self, link: ET.Element) -> Numbers | None:
        """Ten parameters about the origin of the link's frame."""
        element, where = link.find("inertial"), f"the inertial of link '{link.get('name')}'"
        if element is None:
            return None
        R, centre = self.origin(element, where)
        tensor = element.find("inertia")
        mass = self.number(element.find("mass"), "value", None, where)
        if mass < 0:
            raise self.error(f"{where} has a mass of {mass:g} kg: it must not be below zero")
        keys = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
        xx, xy, xz, yy, yz, zz = (self.number(tensor, key, None, where) for key in keys)
        return about(mass, centre, R @ np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]) @ R.T)

    def joint(self, element: ET.Element) -> Joint:
        name = self.name(element)
        where, kind = f"joint '{name}'", element.get("type", "")
        if kind not in KINDS:
            raise self.error(f"{where} is of type '{kind}': {nearest(kind, list(KINDS))}")
        R, p = self.origin(element, where)
        axis = self.numbers(element.find("axis"), "xyz", "1 0 0", 3, where)
        length = float(np.linalg.norm(axis))
        if kind != "fixed" and length < 1e-6:
            raise self.error(f"{where} has a zero axis: give the direction that it turns about or moves along")
        dynamics, (lower, upper) = element.find("dynamics"), (-np.inf, np.inf)
        limit = element.find("limit")
        if limit is not None and kind in ("revolute", "prismatic"):
            lower, upper = (self.number(limit, key, "0", f"the limit of {where}") for key in ("lower", "upper"))
        highest = (
            np.inf
            if limit is None or limit.get(key) is None
            else self.number(limit, key, None, f"the limit of {where}")
            for key in ("velocity", "effort")
        )
        return Joint(
            name,
            kind,
            self.end(element, "parent"),
            self.end(element, "child"),
            R,
            p,
            axis / length if length else axis,
            Limits(lower, upper, *highest),
            self.number(dynamics, "damping", "0", where),
            self.number(dynamics, "friction", "0", where),
            self.mimic(element, where),
        )

    def end(self, joint: ET.Element, which: str) -> str:
        end = joint.find(which)
        link = None if end is None else end.get("link")
        if not link:
            raise self.error(f"joint '{joint.get('name')}' has no {which} link: add <{which} link=\"...\"/>")
        return link

    def mimic(self, joint: ET.Element, where: str) -> tuple[str, float, float] | None:
        element = joint.find("mimic")
        if element is None:
            return None
        leader, where = element.get("joint"), f"the mimic of {where}"
        if not leader:
            raise self.error(f"{where} names no joint: say which it follows")
        multiplier, offset = (self.number(element, *key, where) for key in (("multiplier", "1"), ("offset", "0")))
        return leader, multiplier, offset


def _check_tree(source: str, links: Mapping[str, Numbers | None], joints: tuple[Joint, ...]) -> None:
    """Every link hangs on one joint, but for one root, and every joint is between known links."""
    mover: dict[str, str] = {}
    names = [joint.name for joint in joints]
    for joint in joints:
        for which, link in (("parent", joint.parent), ("child", joint.child)):
            require_known(source, f"the {which} of joint '{joint.name}'", "link", link, links)
        if joint.child in mover:
            raise ValueError(
                f"{source}: link '{joint.child}' is moved by two joints, '{mover[joint.child]}' and '{joint.name}': "
                "closed loops are not known; delete one of them"
            )
        mover[joint.child] = joint.name
        if joint.mimic:
            require_known(source, f"what joint '{joint.name}' follows", "joint", joint.mimic[0], names)
    roots = [link for link in links if link not in mover]
    if len(roots) > 1:
        raise ValueError(f"{source}: no joint moves the links {listed(roots[:5])}: only one can be the root; join them")
    reached = {joint.child for joint in _reached(joints, roots[0])} if roots else set()
    caught = [joint for joint in joints if joint.child not in reached]
    if caught:
        raise ValueError(
            f"{source}: the joints {listed([joint.name for joint in caught[:5]])} form a loop, in which each link "
            "hangs on the next: correct the parent of one of them"
        )


def _reached(joints: tuple[Joint, ...], base: str) -> Iterator[Joint]:
    """Joints above a link, each after its parent's; branches follow each other, in the order of the file."""
    above: dict[str, list[Joint]] = {}
    for joint in joints:
        above.setdefault(joint.parent, []).append(joint)
    waiting = above.get(base, [])[::-1]
    while waiting:
        joint = waiting.pop()
        yield joint
        waiting += above.get(joint.child, [])[::-1]


def _below(urdf: Urdf, base: str) -> Iterator[Joint]:
    return _reached(urdf.joints, base)


def _held(urdf: Urdf, locked: Mapping[str, float]) -> dict[str, float]:
    """Positions of the joints that stay, and of those that follow them."""
    by_name = {joint.name: joint for joint in urdf.joints}
    for name, position in locked.items():
        require_known(urdf.source, "a locked joint", "joint", name, by_name)
        if not np.isfinite(position):
            raise ValueError(f"locked joint '{name}' is at {position}: give a position [rad or m]")
    held = dict(locked)
    for joint in urdf.joints:
        if joint.mimic and joint.name not in held:
            leader, multiplier, offset = following(urdf.source, by_name, joint)
            if leader in held:
                held[joint.name] = multiplier * held[leader] + offset
    return held


def following(source: str, by_name: Mapping[str, Joint], joint: Joint) -> tuple[str, float, float]:
    """Whom a joint follows in the end, as followers may follow each other: leader, multiplier and offset."""
    name, multiplier, offset = joint.name, 1.0, 0.0
    for _ in by_name:
        mimic = by_name[name].mimic
        if mimic is None:
            return name, multiplier, offset
        name, multiplier, offset = mimic[0], multiplier * mimic[1], offset + multiplier * mimic[2]
    raise ValueError(f"{source}: joint '{joint.name}' follows itself: delete one <mimic> of the circle")


def _displaced(joint: Joint, position: float, R: Numbers, p: Numbers) -> tuple[Numbers, Numbers]:
    """A child's frame with its joint held at a position."""
    if joint.kind == "prismatic":
        return R, p + R @ joint.axis * position
    return (R @ rotation_about(joint.axis, position) if position else R), p


def _checked_limits(source: str, joint: Joint, strict: bool) -> Limits:
    limits, zero = joint.limits, ""
    if limits.lower > limits.upper:
        raise ValueError(
            f"{source}: joint '{joint.name}' has a lower limit of {limits.lower:g} above the upper one of "
            f"{limits.upper:g}: swap them"
        )
    if limits.lower == limits.upper:
        zero = f"cannot move: both limits are {limits.lower:g}"
        limits = replace(limits, lower=-np.inf, upper=np.inf)
    for what in ("velocity", "effort"):
        if getattr(limits, what) <= 0:
            zero = zero or f"has a limit of {getattr(limits, what):g} for the {what}"
            limits = replace(limits, **{what: np.inf})
    if zero and strict:
        raise ValueError(
            f"{source}: joint '{joint.name}' {zero}; correct the limit, lock the joint, or set strict to false, "
            "which takes it for no limit"
        )
    return limits


def _check_bodies(urdf: Urdf, bodies: list[Body], base: str, strict: bool) -> None:
    if not bodies:
        raise ValueError(f"{urdf.source}: no joint above link '{base}' moves: choose another base, or lock less")
    if len(bodies) > MOST_MOVING:
        raise ValueError(f"{urdf.source}: {len(bodies)} joints move, and at most {MOST_MOVING} can: lock some of them")
    for body in bodies:
        if strict and all(urdf.links[link] is None for link in body.links):
            raise ValueError(
                f"{urdf.source}: link '{body.links[0]}', which joint '{body.joint.name}' moves, has no <inertial>: add "
                "one, or set strict to false, which takes it for massless"
            )
