"""How far a robot stays from itself and from a table: links as capsules, which are segments with a radius.

A capsule around a link is larger than the link, so that a motion that keeps the distance of capsules keeps that of the
links. The distance of two segments is that of their closest points (Ericson 2005, *Real-Time Collision Detection*,
5.1.9); as these do not move along their segments to first order, they may be held while the distance is differentiated.
"""

from __future__ import annotations

import itertools
import xml.etree.ElementTree as ET
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Num

from jaximp.models import rigid_body
from jaximp.models.chain import Chain
from jaximp.models.rigid_body import KinematicTree
from jaximp.models.spatial import rotation
from jaximp.models.urdf import require_known, root_of, text_of
from jaximp.types import Numbers, listed

RADIUS = 0.06
"""Of a link whose shape is a mesh or is not in the file, unless a radius is given [m]."""
REACH = 0.1
"""What is missing of a distance counts as a share of this [m]."""
RANDOM_POSES = 256
"""By which it is seen what moves relative to what."""
STILL = 1e-6
"""A distance that changes less [m] is that of bodies that do not move relative to each other."""


class Capsule(NamedTuple):
    """All points within a radius of a segment that is fixed to a body."""

    link: str
    body: int
    """-1 for the base."""
    ends: Numbers
    """(2, 3) of the segment in the body's frame [m]."""
    radius: float


@dataclass(frozen=True)
class Plane:
    """What stays on one side, such as above a table: `normal @ point >= offset` in the base's frame."""

    normal: tuple[float, float, float] = (0.0, 0.0, 1.0)
    offset: float = 0.0
    """[m] along the normal."""
    name: str = "table"


class Clearance(eqx.Module):
    """Pairs of links, and links over planes, whose distance a motion must keep. `Clearance.of(chain, ...)` makes it."""

    tree: KinematicTree
    ends: Float[Any, "K 2 3"]
    """Of each capsule's segment in the frame of its body [m]."""
    radii: Float[Any, " K"]
    normals: Float[Any, "Q 3"]
    """Of length one."""
    offsets: Float[Any, " Q"]
    distance: float
    """That must be kept between all surfaces [m]."""
    bodies: tuple[int, ...] = eqx.field(static=True)
    """That each capsule is fixed to."""
    pairs: tuple[tuple[int, int], ...] = eqx.field(static=True)
    """Of capsules."""
    over: tuple[tuple[int, int], ...] = eqx.field(static=True)
    """Capsule and plane."""
    names: tuple[str, ...] = eqx.field(static=True)
    """What each row of `distances` is, such as `forearm and base`: first the pairs, then what is over planes."""
    notes: tuple[str, ...] = eqx.field(static=True)
    """What was left out, and what was assumed."""

    @classmethod
    def of(
        cls,
        chain: Chain,
        urdf: str | Path | None = None,
        *,
        distance: float = 0.0,
        radii: Mapping[str, float] | None = None,
        radius: float = RADIUS,
        planes: Iterable[Plane] = (),
        ignore: Iterable[tuple[str, str]] = (),
        mean: Num[ArrayLike, " n"] | None = None,
    ) -> Clearance:
        """The clearance of a robot, by the shapes of its links.

        **Arguments:**

        - `urdf`: the file whose boxes, cylinders and spheres (`<collision>`, else `<visual>`) are the shapes. Without
          it, and for links with meshes, capsules go from the link's origin to the joints that it bears: to fixed and
          locked ones, too, so that a gripper and its fingers are covered whatever the chain's tip.
        - `distance` between surfaces [m]; `radii` [m] by the name of the link, for links whose capsules go from joint
          to joint, whatever the file says of their shape; `radius` of all other links without a shape.
        - `planes` that all that moves stays over; `ignore` pairs of links that may touch.
        - `mean` (n,) pose that is known to be free, beside that with all joints at zero.

        Neighbours (a body and what bears it) are left out, and with a note pairs that touch at zero or in the mean
        pose: capsules are larger than links, and what overlaps there would forbid every motion.

        **Raises:** `ValueError` in one line for unknown links, sizes that are not above zero and planes without a
        normal.
        """
        planes, radii = tuple(planes), dict(radii or {})
        if not (np.isfinite(distance) and distance >= 0):
            raise ValueError(f"clearance.distance is {distance}: it must be zero or more [m]")
        for name, size in {"radius": radius, **{f"radii.{link}": r for link, r in radii.items()}}.items():
            if not (np.isfinite(size) and size > 0):
                raise ValueError(f"clearance.{name} is {size}: it must be above zero [m]")
        for link in itertools.chain(radii, *ignore):
            require_known(chain.robot, "a link of clearance", "link", link, chain.frames)
        capsules, assumed = _capsules(chain, None if urdf is None else Path(urdf), radii, radius)
        allowed = {frozenset(pair) for pair in ignore}
        normals, offsets = _normals(planes)
        pairs = [
            (i, k)
            for i, k in itertools.combinations(range(len(capsules)), 2)
            if _apart(chain, capsules[i], capsules[k])
        ]
        pairs = [(i, k) for i, k in pairs if frozenset((capsules[i].link, capsules[k].link)) not in allowed]
        over = [(i, k) for i, capsule in enumerate(capsules) if capsule.body >= 0 for k in range(len(planes))]
        everything = cls(
            chain.tree, np.array([c.ends for c in capsules]), np.array([c.radius for c in capsules]), normals, offsets,
            float(distance), tuple(c.body for c in capsules), tuple(pairs), tuple(over),
            tuple(f"{capsules[i].link} and {capsules[k].link}" for i, k in pairs)
            + tuple(f"{capsules[i].link} and {planes[k].name}" for i, k in over), assumed,
        )  # fmt: skip
        return everything._without_what_touches(mean)

    def distances(self, q: Num[ArrayLike, "... n"]) -> Float[Array, "... C"]:
        """Between the surfaces of each pair [m], and of each capsule over its plane; below zero where they overlap.

        For one pose or any batch of poses. Overlaps of two capsules are no less than minus the sum of their radii.
        """
        return rigid_body.over_samples(_distance_lanes, self.tree.n_joints, self, q)

    def shares(self, q: Num[ArrayLike, "N n"]) -> Float[Array, "N C"]:
        """1 where the distance is just kept, less where it is larger."""
        return 1 + (self.distance - self.distances(q)) / REACH

    def _without_what_touches(self, mean: ArrayLike | None) -> Clearance:
        n = self.tree.n_joints
        poses = np.random.default_rng(0).uniform(-np.pi, np.pi, (RANDOM_POSES, n))
        known = [np.zeros(n), *([] if mean is None else [np.broadcast_to(np.asarray(mean, float), (n,))])]
        seen = np.asarray(self.distances(np.concatenate([known, poses])))
        fixed = np.ptp(seen, axis=0) < STILL
        count = len(self.pairs)
        touching = (seen[: len(known)] < self.distance).any(axis=0) & ~fixed
        touching[count:] = False  # a table may well be where the arm is with all joints at zero
        kept = ~(fixed | touching)
        left = list(dict.fromkeys(name for name, out in zip(self.names, touching, strict=True) if out))
        notes = self.notes
        if left:
            notes += (f"left out, as they touch at zero or in the mean pose: {'; '.join(left)}",)
        if not kept.any():
            raise ValueError(
                "clearance has nothing to keep: no two links that are no neighbours move, and no plane is given"
            )
        return replace(
            self,
            pairs=tuple(pair for pair, keep in zip(self.pairs, kept[:count], strict=True) if keep),
            over=tuple(pair for pair, keep in zip(self.over, kept[count:], strict=True) if keep),
            names=tuple(name for name, keep in zip(self.names, kept, strict=True) if keep),
            notes=notes,
        )


def segment_distance(a: Float[Array, "2 3 *N"], b: Float[Array, "2 3 *N"]) -> Float[Array, "*N"]:
    """Distance of two segments by their ends, with the samples on the last axes."""
    u, v, w = a[1] - a[0], b[1] - b[0], a[0] - b[0]
    uu, vv, uv, uw, vw = ((x * y).sum(axis=0) for x, y in ((u, u), (v, v), (u, v), (u, w), (v, w)))
    tiny = jnp.finfo(w.dtype).tiny ** 0.5

    def share(above: Array, below: Array) -> Array:
        return jnp.clip(jnp.where(below > tiny, above / jnp.where(below > tiny, below, 1.0), 0.0), 0.0, 1.0)

    # Parallel segments have many closest points: any of them will do.
    s = share(uv * vw - vv * uw, jnp.where(uu * vv - uv**2 > 1e-12 * uu * vv, uu * vv - uv**2, 0.0))
    t = share(uv * s + vw, vv)
    s = share(uv * t - uw, uu)
    s, t = jax.lax.stop_gradient((s, t))
    apart = w + s * u - t * v
    return jnp.sqrt((apart**2).sum(axis=0) + tiny)


def _distance_lanes(clearance: Clearance, q: Array) -> Array:
    """(C, N)"""
    R, p = rigid_body.body_poses(clearance.tree, q)
    turned, origin = jnp.stack([jnp.stack(row) for row in R]), jnp.stack(p)  # (3, 3, n_b, N), (3, n_b, N)
    own = jnp.asarray(clearance.ends)
    moves = np.array(clearance.bodies) >= 0
    at = np.maximum(clearance.bodies, 0)
    world = jnp.einsum("ijkN,kej->keiN", turned[:, :, at], own) + origin[:, at].swapaxes(0, 1)[:, None]
    ends = jnp.where(moves[:, None, None, None], world, own[..., None]).transpose(1, 2, 0, 3)  # (2, 3, K, N)
    radii = jnp.asarray(clearance.radii)[:, None]
    first, second = np.array(clearance.pairs, int).reshape(-1, 2).T
    above, plane = np.array(clearance.over, int).reshape(-1, 2).T
    between = segment_distance(ends[:, :, first], ends[:, :, second]) - radii[first] - radii[second]
    heights = (jnp.asarray(clearance.normals).T[:, plane, None] * ends[:, :, above]).sum(axis=1).min(axis=0)
    return jnp.concatenate([between, heights - radii[above] - jnp.asarray(clearance.offsets)[plane, None]])


def _apart(chain: Chain, one: Capsule, other: Capsule) -> bool:
    """Whether two capsules are on bodies that are no neighbours."""
    i, k = one.body, other.body
    parents = chain.tree.parents
    return i != k and not (k >= 0 and parents[k] == i) and not (i >= 0 and parents[i] == k)


def _normals(planes: tuple[Plane, ...]) -> tuple[Numbers, Numbers]:
    normals = np.array([plane.normal for plane in planes], float).reshape(-1, 3)
    offsets = np.array([plane.offset for plane in planes], float)
    length = np.linalg.norm(normals, axis=1)
    if not (np.isfinite(normals).all() and np.isfinite(offsets).all() and (length > 0).all()):
        raise ValueError("a plane of clearance needs a normal that is not zero, and a finite offset [m]")
    return normals / length[:, None], offsets / length


def _capsules(
    chain: Chain, urdf: Path | None, radii: Mapping[str, float], radius: float
) -> tuple[list[Capsule], tuple[str, ...]]:
    """Of all links, and what was assumed of them."""
    shapes = {} if urdf is None else _shapes(urdf)
    found: list[Capsule] = []
    assumed = []
    own_of = {next(iter(chain.frames)), *(links[0] for links in chain.link_names)}
    for link, at in chain.frames.items():
        # Without a file nobody knows what stands around the robot, but what moves is covered.
        shape = shapes.get(link, [] if at.body < 0 else None)
        if shape and link not in radii:
            found += [Capsule(link, at.body, ends @ at.rotation.T + at.position, size) for ends, size in shape]
            continue
        bars = _to_joints(chain, link)
        if bars or shape is None or link in own_of or link in radii:
            point = np.stack([at.position] * 2)
            found += [Capsule(link, at.body, ends, radii.get(link, radius)) for ends in bars or [point]]
            assumed += [link] * (link not in radii)
    if not assumed:
        return found, ()
    return found, (
        f"shapes that could not be read: {listed(assumed)} have a radius of {radius:g} m from joint to joint",
    )


def _to_joints(chain: Chain, link: str) -> list[Numbers]:
    """Segments (2, 3) in the frame of a link's body, from the link's origin to the joints that it bears: fixed ones,
    too, if it moves. The first link of the base reaches to all joints of the base."""
    frames, tree = chain.frames, chain.tree
    at, root = frames[link], next(iter(frames))
    bears = [
        below.position if below.body == at.body else np.asarray(tree.position[below.body])
        for below in frames.values()
        if below.parent == link and (at.body >= 0 or below.body >= 0)
    ]
    if link == root:
        bears = [np.asarray(tree.position[k]) for k, parent in enumerate(tree.parents) if parent < 0]
    return [np.stack([at.position, end]) for end in bears if (end != at.position).any()]


def _shapes(path: Path) -> dict[str, list[tuple[Numbers, float]] | None]:
    """Segments (2, 3) in the link's frame, with their radii, of each link's boxes, cylinders and spheres.

    None for a body whose shape cannot be read, as that of a mesh; an empty list for a link that is only a frame.
    """
    found: dict[str, list[tuple[Numbers, float]] | None] = {}
    for link in root_of(text_of(path), str(path)).findall("link"):
        name = str(link.get("name"))
        found[name] = [] if link.find("inertial") is None else None
        for kind in ("collision", "visual"):
            each = [_capsule(element, f"{path}: a {kind} of link '{name}'") for element in link.findall(kind)]
            known = [capsule for capsule in each if capsule is not None]
            if each:  # nobody knows what a mesh beside a box covers
                found[name] = known if len(known) == len(each) else None
            if found[name]:
                break
    return found


def _capsule(element: ET.Element, where: str) -> tuple[Numbers, float] | None:
    """Around one shape, in the frame of its link; None for a mesh."""
    shape = next(iter(element.find("geometry") or ()), None)
    if shape is None or shape.tag not in ("box", "cylinder", "sphere"):
        return None
    origin = element.find("origin")

    def numbers(of: ET.Element | None, key: str, count: int, default: str = "") -> Numbers:
        text = default if of is None else of.get(key, default)
        try:
            values = np.array([float(part) for part in text.split()])
        except ValueError:
            values = np.zeros(0)
        if len(values) != count or not np.isfinite(values).all():
            raise ValueError(f"{where} has {key}='{text}': it must be {count} finite numbers")
        return values

    axis, half = 2, 0.0
    if shape.tag == "box":
        sides = numbers(shape, "size", 3)
        axis = int(np.argmax(sides))
        half, radius = sides[axis] / 2, float(np.linalg.norm(np.delete(sides, axis))) / 2
    else:
        radius = float(numbers(shape, "radius", 1)[0])
        if shape.tag == "cylinder":
            half = float(numbers(shape, "length", 1)[0]) / 2
    segment = np.outer([-half, half], np.eye(3)[axis])
    turn = rotation(numbers(origin, "rpy", 3, "0 0 0"))
    return segment @ turn.T + numbers(origin, "xyz", 3, "0 0 0"), radius
