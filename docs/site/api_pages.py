"""One page for each package with its public names: signatures, docstrings and fields, read from the code.

The public names are those of each `__init__.pyi`. Nothing is imported: griffe reads the files.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import griffe

FENCE = "`" * 9
"""Of a name; what stands inside has a shorter one."""
LONGEST_VALUE = 100
"""Of a constant that is shown [characters]."""


@cache
def code(root: Path) -> Any:
    """The whole library."""
    return griffe.load("jaximp", search_paths=[root])


def faces(root: Path) -> dict[str, list[str]]:
    """Every package that has public names, with these, in the order of its `__init__.pyi`."""
    found = {}
    for stub in sorted((root / "jaximp").rglob("__init__.pyi")):
        package = ".".join(stub.parent.relative_to(root).parts)
        lines = stub.read_text(encoding="utf-8").splitlines()
        found[package] = [line.rpartition(" as ")[2] for line in lines if " as " in line]
    return found


def resolved(root: Path, package: str, name: str) -> Any:
    """What a public name stands for."""
    found = code(root)[f"{package}.{name}".removeprefix("jaximp.")]
    return found.final_target if found.is_alias else found


def links_of_names(root: Path) -> dict[str, str]:
    """What may stand in a page between backticks, and the entry that it means: `jaximp.track`, `Estimates`,
    `signals.jumps`, `models.joint.HumanJoint`.

    Single words of small letters mean a name only with their package: many of them are words of English.
    """
    links: dict[str, str] = {}
    top = {resolved(root, "jaximp", name).path: f"jaximp.{name}" for name in faces(root)["jaximp"]}
    for package, names in reversed(faces(root).items()):
        for name in names:
            found = resolved(root, package, name)
            full = top.get(found.path, f"{package}.{name}")
            spellings = [
                full,
                f"{package}.{name}",
                f"{package}.{name}".removeprefix("jaximp."),
                found.path,
                found.path.removeprefix("jaximp."),
                name,
            ]
            links |= {each: full for each in spellings if not (each.isalpha() and each.islower())}
    return links


def api_pages(root: Path) -> dict[str, str]:
    """The text of every page, by its file."""
    return {f"api/{package}.md": "\n".join(_page(root, package, names)) for package, names in faces(root).items()}


def _page(root: Path, package: str, names: list[str]) -> Iterator[str]:
    module = code(root)[package.removeprefix("jaximp.")] if package != "jaximp" else code(root)
    yield f"# {package}\n"
    yield f"{_text(module)}\n"
    if package == "jaximp":
        yield (
            "Examples take for granted that `jaximp` and numpy (as `np`) are imported, that float64 is on "
            '(`jax.config.update("jax_enable_x64", True)`), and that they run beside the folder `examples`.\n'
        )
        yield "The names of all packages, which stand on pages of their own:\n"
        yield from ["```{toctree}", ":maxdepth: 1\n", *(each for each in faces(root) if each != package), "```\n"]
    yield from [f"{FENCE[:3]}{{py:module}} {package}", FENCE[:3] + "\n"]
    top = {resolved(root, "jaximp", name).path: f"jaximp.{name}" for name in faces(root)["jaximp"]}
    for name in names:
        found = resolved(root, package, name)
        if package != "jaximp" and found.path in top:
            yield f"- `{top[found.path]}` is `{package}.{name}`.\n"
        elif f"{package}.{name}" not in faces(root):
            yield from _entry(name, found, _other_name(root, found) if package == "jaximp" else "")


def _other_name(root: Path, found: Any) -> str:
    """Where else a name of jaximp itself is public: in the package that has it."""
    for package, names in faces(root).items():
        for name in names if package != "jaximp" else ():
            if resolved(root, package, name).path == found.path:
                return f"{package}.{name}"
    return ""


def _text(found: Any) -> str:
    """A docstring, but for how names are found, which is no matter of a reader."""
    text = found.docstring.value if found.docstring else ""
    return "\n\n".join(part for part in text.split("\n\n") if "__init__.pyi" not in part)


def _block(directive: str, head: str, *inside: str, options: tuple[str, ...] = (), fence: str = FENCE) -> Iterator[str]:
    yield "\n".join([f"{fence}{{py:{directive}}} {head}", *options, ""])
    yield from inside
    yield f"{fence}\n"


def _entry(name: str, found: Any, other: str = "") -> Iterator[str]:
    """One public name, which may be that of a package, too."""
    also = (f":canonical: {other}",) if other else ()
    if found.is_module:
        functions = [each for each in found.functions.values() if not each.name.startswith("_") and not each.is_alias]
        inside = [line for each in functions for line in _entry(f"{name}.{each.name}", each)]
        yield from _block("data", name, _text(found) + "\n", options=(":type: module",))
        yield from inside
    elif found.is_function:
        yield from _block("function", f"{name}{_signature(found)}", _text(found), options=also)
    elif found.is_class:
        head = f"{name}{_signature(found)}" if "__init__" in found.members and not _fields(found) else name
        inside = [_text(found) + "\n", *_bases(found), *_members(found)]
        yield from _block("class", head, *inside, options=also)
    else:
        value = str(found.value or "")
        options = (f":value: {value}",) if 0 < len(value) < LONGEST_VALUE and "\n" not in value else ()
        yield from _block("data", name, _text(found), options=(*options, *also))


def _bases(found: Any) -> Iterator[str]:
    bases = [str(base) for base in found.bases if str(base) not in ("eqx.Module", "NamedTuple", "Protocol", "ABC")]
    if bases:
        yield f"A {', '.join(f'`{base}`' for base in bases)}, with what that offers.\n"


def _fields(found: Any) -> list[Any]:
    """Fields with a type, which are the arguments of a class without an `__init__` of its own."""
    written = "__init__" in found.members and found.members["__init__"].lineno  # griffe gives dataclasses one
    own = [each for each in found.attributes.values() if each.annotation and "property" not in each.labels]
    return [] if written else [each for each in own if not each.name.startswith("_")]


def _members(found: Any) -> Iterator[str]:
    """Fields, properties and methods of a class that have something to say."""
    fields = _fields(found)
    for each in fields:
        value = f":value: {each.value}"
        default = (value,) if each.value is not None and len(value) < LONGEST_VALUE and "\n" not in value else ()
        options = (f":type: {each.annotation}", *default)
        yield from _block("attribute", each.name, _text(each), options=options, fence=FENCE[:-1])
    for each in found.members.values():
        if each in fields or each.name.startswith("_") or each.is_alias or not each.docstring:
            continue
        if each.is_function:
            yield from _block("method", f"{each.name}{_signature(each)}", _text(each), fence=FENCE[:-1])
        elif each.is_attribute:
            kind = (f":type: {each.annotation}",) if each.annotation else ()
            yield from _block("attribute", each.name, _text(each), options=kind, fence=FENCE[:-1])


def _signature(found: Any) -> str:
    """Arguments with their types and defaults, as they are written."""
    parts: list[str] = []
    star = False
    for each in found.parameters:
        if each.name in ("self", "cls"):
            continue
        kind = each.kind.value
        if kind == "keyword-only" and not star:
            parts.append("*")
        star = star or kind in ("keyword-only", "variadic positional")
        prefix = {"variadic positional": "*", "variadic keyword": "**"}.get(kind, "")
        typed = f": {each.annotation}" if each.annotation is not None else ""
        default = f" = {each.default}" if each.default is not None and not prefix else ""
        parts.append(f"{prefix}{each.name}{typed}{default}")
    returns = getattr(found, "returns", None)
    return f"({', '.join(parts)})" + (f" -> {returns}" if returns is not None else "")
