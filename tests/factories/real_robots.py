"""Small robots whose links are real bodies, others of the same geometry, and estimates of their base parameters."""

from __future__ import annotations

from functools import partial

import numpy as np

from factories.robots import joint, link, robot
from jaximp.models.chain import Chain
from jaximp.models.spatial import from_pseudo_inertia, pseudo_inertia
from jaximp.models.urdf import parse_urdf

real_link = partial(link, inertia="0.02 0.001 -0.002 0.025 0.0015 0.015")

PENDULUM = Chain(
    parse_urdf(robot('<link name="base"/>', joint("hinge", "base", "bob", axis="0 1 0"), real_link("bob"))),
    friction="viscous",
)
"""Its base parameters are two first moments, the inertia about the hinge, and friction."""

PLANAR = Chain(
    parse_urdf(
        robot(
            '<link name="ground"/>',
            joint("shoulder", "ground", "upper", xyz="0 0 0"),
            real_link("upper", 2.0, "0.17 0.02 0"),
            joint("elbow", "upper", "fore", xyz="0.4 0 0"),
            real_link("fore", 1.3, "0.12 -0.01 0"),
        )
    ),
    gravity=(0, -9.81, 0),
    rotor=True,
    friction=True,
    offset=True,
)


def another(chain: Chain, seed: int, size: float = 0.4) -> np.ndarray:
    """(P,) a robot with other links, all of them real: the URDF's are stretched, sheared and moved at random."""
    random = np.random.default_rng(seed)
    links = []
    for own in np.asarray(chain.links):
        T = np.eye(4) + size * np.triu(random.normal(size=(4, 4)))
        T[range(4), range(4)] = np.exp(size * random.normal(size=4))
        root = np.linalg.cholesky(pseudo_inertia(own)[::-1, ::-1])[::-1, ::-1] @ T
        links.append(from_pseudo_inertia(root @ root.T))
    rest = chain.standard_parameters[10 * len(links) :]
    return np.concatenate([np.ravel(links), 0.1 + 0.2 * random.random(len(rest)) + rest])


def estimated(
    chain: Chain, standard: np.ndarray, error: float, seed: int | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Base parameters with correlated errors of this share, drawn where there is a seed."""
    base = chain.base.map @ standard
    size = error * np.maximum(np.abs(base), 0.05)
    mixed = np.random.default_rng(1).normal(size=(len(base), len(base))) * 0.3 / np.sqrt(len(base)) + np.eye(len(base))
    root = size[:, None] * mixed
    drawn = 0.0 if seed is None else root @ np.random.default_rng(seed).normal(size=len(base))
    return base + drawn, root @ root.T


def is_real(chain: Chain, standard: np.ndarray) -> bool:
    """Whether every link is a body, and friction and rotors' inertias at least zero."""
    links = standard[: 10 * chain.tree.n_bodies].reshape(-1, 10)
    at_joints = [
        x for n, x in zip(chain.base.standard_names, standard, strict=True) if n[0] == "j" and "offset" not in n
    ]
    return all(np.linalg.eigvalsh(pseudo_inertia(one))[0] > 0 for one in links) and min(at_joints, default=0) >= 0
