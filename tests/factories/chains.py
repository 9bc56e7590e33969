"""Recordings of a made-up arm of two joints from a URDF, with a truth."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.signal import lfilter

from factories.robots import joint, link, robot
from jaximp.identification.payload import load_columns
from jaximp.models import Chain, TipImpedance
from jaximp.recordings import recording_from_arrays
from jaximp.types import Recording

TWO_JOINTS = robot(
    link("base"),
    joint("shoulder", "base", "upper", axis="0 1 0"),
    link("upper", 2.0, "0.01 0.02 0.15"),
    joint("elbow", "upper", "fore", axis="0 1 0"),
    link("fore", 1.0, "0.02 0.01 0.1"),
    name="two_joints",
)
GRIP = joint("grip", "fore", "hand", "fixed", "0 0 0.25") + '<link name="hand"/>'
HELD = TWO_JOINTS.replace("</robot>", f"{GRIP}</robot>")
"""The same with a hand, which somebody can hold."""
HUMAN = {
    "mass_x": 1.5, "mass_z": 0.8, "damping_x": 20.0, "damping_z": 10.0, "stiffness_x": 150.0, "stiffness_z": 90.0,
    "force_x": -30.0, "force_z": -20.0,
}  # fmt: skip
"""Who holds it, in the plane of the arm."""
RATE, SECONDS = 100.0, 20.0
SIZES, COLOUR = np.array([0.3, 0.03]), 0.8
"""Standard deviations of the torques' noise [N m], and how much neighbouring samples have in common."""
FRICTION = {"viscous_friction": 0.8, "coulomb_friction": 0.5}


def urdf_in(folder: Path) -> Path:
    path = folder / "two_joints.urdf"
    path.write_text(TWO_JOINTS, encoding="utf-8")
    return path


def chain_in(folder: Path, **settings: object) -> Chain:
    return Chain.from_urdf(urdf_in(folder), friction=True, **settings)  # type: ignore[arg-type]


def truth_of(chain: Chain) -> np.ndarray:
    """(p,) the URDF's parameters, and friction."""
    theta = np.array(chain.parameters)
    for k, name in enumerate(chain.names):
        theta[k] = FRICTION.get(name.split(".")[1], theta[k])
    return theta


def motion(seed: int, seconds: float = SECONDS) -> tuple[np.ndarray, ...]:
    """Time (N,), and position, velocity and acceleration (N, 2)."""
    rng = np.random.default_rng(seed)
    time = np.arange(0, seconds, 1 / RATE)
    w = 2 * np.pi * np.array([0.1, 0.25, 0.45, 0.8])
    q, dq, ddq = np.zeros((3, len(time), 2))
    for j in range(2):
        amplitude, phase = rng.uniform(0.1, 0.4, 4), rng.uniform(0, 2 * np.pi, 4)
        angle = np.outer(time, w) + phase
        q[:, j] = np.sin(angle) @ amplitude
        dq[:, j] = np.cos(angle) @ (amplitude * w)
        ddq[:, j] = -np.sin(angle) @ (amplitude * w**2)
    return time, q, dq, ddq


def arrays(chain: Chain, seed: int, seconds: float = SECONDS, noise: float = 1.0) -> tuple[np.ndarray, ...]:
    """Time, position and torque with coloured noise."""
    time, q, dq, ddq = motion(seed, seconds)
    rng = np.random.default_rng(1000 + seed)
    white = rng.normal(size=(len(time) + 200, 2))
    coloured = lfilter([np.sqrt(1 - COLOUR**2)], [1, -COLOUR], white, axis=0)[200:]
    torque = np.asarray(chain.observation_matrix(q, dq, ddq)) @ truth_of(chain) + noise * SIZES * coloured
    return time, q + 1e-5 * rng.normal(size=q.shape), torque


def with_load(
    chain: Chain,
    seed: int,
    load: np.ndarray | None = None,
    moves: int | None = None,
    gain: float | np.ndarray = 1.0,
    noise: float = 1.0,
    **also: object,
) -> Recording:
    """The motion of one seed with the noise of another, and currents where there is a gain; `load` (10,) at the tip."""
    _, q, dq, ddq = motion(seed if moves is None else moves)
    time, position, torque = arrays(chain, seed, noise=noise)
    noisy = torque - np.asarray(chain.observation_matrix(*motion(seed)[1:])) @ truth_of(chain)
    theta = truth_of(chain) + (0 if load is None else load_columns(chain) @ load)
    torque = np.asarray(chain.observation_matrix(q, dq, ddq)) @ theta + noisy
    position = position - motion(seed)[1] + q
    return recording_from_arrays(time, position, torque / gain, name=f"run {seed}", **also)  # type: ignore[arg-type]


def held(chain: Chain, human: TipImpedance, seed: int, moves: int | None = None) -> Recording:
    """The motion of one seed with the noise of another, of a robot that a human holds."""
    alone = with_load(chain, seed, moves=moves)
    W = np.asarray(human.observation_matrix(*motion(seed if moves is None else moves)[1:]))
    theta = np.array([HUMAN[name] for name in human.names])
    return recording_from_arrays(alone.time, alone.position, alone.torque + W @ theta, name=f"held {seed}")


def recording(chain: Chain, seed: int, seconds: float = SECONDS, noise: float = 1.0) -> Recording:
    return recording_from_arrays(*arrays(chain, seed, seconds, noise), name=f"run {seed}")
