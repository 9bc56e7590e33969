"""Chains from URDF files: microseconds for a sample, gradients, and agreement with pinocchio, where that is installed.

Writes results/chain.json and .md. The arm that comes with the package is measured everywhere. With `pin` and
`example-robot-data` (414 MB) the UR10 and the Panda are measured beside pinocchio's own loop, and all URDFs are
compared with it; without them the table says so. Times are those of the processor, the least of several, so that what
else runs on the machine counts little; both sides are measured in turn.
"""

from __future__ import annotations

import importlib.util
import json
import os
import platform
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import jax
import jax.numpy as jnp
import numpy as np

from jaximp.models import SIX_JOINT_ARM, Chain, parse_urdf, read_urdf, rigid_body
from jaximp.models.urdf import moving_bodies

RESULTS = Path(__file__).parents[1] / "results"
STORED, CACHED, PERIOD, HARMONICS = 100_000, 512, 200, 5
ROUNDS = 7
WANTED = {"stored": 3.0, "in cache": 1.5, "first call": 2.0, "gradient": 100.0, "agreement": 1e-12}


def peers() -> dict[str, Path]:
    """URDF files of example-robot-data by name; none where it or pinocchio is absent."""
    spec = importlib.util.find_spec("pinocchio")
    if spec is None or spec.origin is None:
        return {}
    share = next((p / "share" for p in Path(spec.origin).parents if (p / "share/example-robot-data").is_dir()), None)
    return {} if share is None else {f"{p.parent.parent.name}/{p.stem}": p for p in sorted(share.rglob("*.urdf"))}


def cpu(function: Callable[[], Any], repeat: int = 1) -> float:
    """Seconds of the processor for one call."""
    begin = time.process_time()
    for _ in range(repeat):
        jax.block_until_ready(function())
    return (time.process_time() - begin) / repeat


class Pinocchio:
    """The same robot in pinocchio, as somebody would loop over it."""

    def __init__(self, path: Path, locked: dict[str, float], columns: tuple[int, ...]):
        import pinocchio as pin

        model = pin.buildModelFromUrdf(str(path))
        held = [model.getJointId(name) for name in locked if model.existJointName(name)]
        self.pin, self.model = pin, pin.buildReducedModel(model, held, pin.neutral(model))
        self.data, self.columns = self.model.createData(), np.array(columns)

    def stored(self, q: Any, dq: Any, ddq: Any) -> Any:
        W = np.empty((*q.shape, 10 * q.shape[1]))
        for k in range(len(q)):
            W[k] = self.pin.computeJointTorqueRegressor(self.model, self.data, q[k], dq[k], ddq[k])
        return W

    def in_cache(self, q: Any, dq: Any, ddq: Any) -> None:
        for k in range(len(q)):
            self.pin.computeJointTorqueRegressor(self.model, self.data, q[k], dq[k], ddq[k])

    def log_condition(self, motion: Any) -> float:
        W = self.stored(*motion)[..., self.columns].reshape(-1, len(self.columns))
        return float(np.log(np.linalg.cond(W)))


def fourier(n: int) -> tuple[Any, Any, Any]:
    """Position, velocity and acceleration (PERIOD, variables) of one joint's series."""
    t = np.arange(PERIOD) / PERIOD * 10.0
    w = 2 * np.pi * np.arange(1, HARMONICS + 1) / 10.0
    s, c = np.sin(np.outer(t, w)), np.cos(np.outer(t, w))
    return np.hstack([s, c]), np.hstack([c * w, -s * w]), np.hstack([-s * w**2, -c * w**2])


def measured(path: Path, locked: dict[str, float], with_pinocchio: bool) -> dict[str, Any]:
    chain = Chain(read_urdf(path), locked=locked)
    motion = [jnp.asarray(x) for x in np.random.default_rng(0).normal(size=(3, STORED, chain.n_joints))]
    few = [x[:CACHED] for x in motion]
    found: dict[str, Any] = {"base columns": len(chain.names)}
    found["first call"] = cpu(lambda: chain.observation_matrix(*motion))
    columns = jax.jit(lambda q, dq, ddq: chain.regressor(q, dq, ddq))
    columns(*few)
    other = Pinocchio(path, locked, chain.base.kept) if with_pinocchio else None
    slow = [np.asarray(x[:5000]) for x in motion]
    times: dict[str, list[float]] = {}
    for _ in range(ROUNDS):
        times.setdefault("stored", []).append(cpu(lambda: chain.observation_matrix(*motion)) / STORED)
        times.setdefault("in cache", []).append(cpu(lambda: columns(*few), 200) / CACHED)
        if other:
            times.setdefault("pinocchio stored", []).append(cpu(lambda: other.stored(*slow)) / 5000)
            times.setdefault("pinocchio in cache", []).append(cpu(lambda: other.in_cache(*slow)) / 5000)
    found |= {name: 1e6 * min(each) for name, each in times.items()}
    return found | gradients(chain, other)


def gradients(chain: Chain, other: Pinocchio | None) -> dict[str, float]:
    """Of the logarithm of the condition number over one period: milliseconds, with all variables of the series."""
    basis = fourier(chain.n_joints)

    def log_condition(coefficients: Any) -> Any:
        W = chain.observation_matrix(*(B @ coefficients for B in basis)).reshape(-1, len(chain.names))
        size = jnp.linalg.eigvalsh(W.T @ W)
        return jnp.log(size[-1] / size[0]) / 2

    at = jnp.asarray(np.random.default_rng(1).normal(size=(2 * HARMONICS, chain.n_joints)))
    both = jax.jit(jax.value_and_grad(log_condition))
    value = float(both(at)[0])
    ours = min(cpu(lambda: both(at), 20) for _ in range(ROUNDS))
    found = {"gradient ms": 1e3 * ours}
    if other:
        motion = [np.asarray(B @ at) for B in basis]
        assert abs(other.log_condition(motion) - value) < 1e-6
        one = min(cpu(lambda: other.log_condition(motion)) for _ in range(ROUNDS))
        found |= {"differences ms": 1e3 * one * (at.size + 1), "gradient": one * (at.size + 1) / ours}
    return found


def difference(path: Path) -> dict[str, float]:
    """From pinocchio for a random motion of all joints: the largest, as a share of the largest number."""
    import pinocchio as pin

    chain = Chain(read_urdf(path), strict=False)
    tree, model = chain.tree, pin.buildModelFromUrdf(str(path))
    data, (z, dz, ddz) = model.createData(), np.random.default_rng(1).normal(size=(3, chain.n_joints))
    rates = np.asarray(tree.coordinates)
    q, v, a = pin.neutral(model), np.zeros(model.nv), np.zeros(model.nv)
    T, bodies = np.zeros((model.nv, chain.n_joints)), []
    for k, body in enumerate(moving_bodies(read_urdf(path), strict=False).bodies):
        index, position = model.getJointId(body.joint.name), float(chain.joint_positions(z)[k])
        joint = model.joints[index]
        turn = [np.cos(position), np.sin(position)] if joint.nq == 2 else [position]
        q[joint.idx_q : joint.idx_q + joint.nq] = turn
        v[joint.idx_v], a[joint.idx_v], T[joint.idx_v] = rates[k] @ dz, rates[k] @ ddz, rates[k]
        bodies += list(range(10 * (index - 1), 10 * index))
    M = np.triu(pin.crba(model, data, q))
    pairs = {
        "torque": (chain.inverse_dynamics(z, dz, ddz), T.T @ pin.rnea(model, data, q, v, a)),
        "mass matrix": (chain.mass_matrix(z), T.T @ (M + np.triu(M, 1).T) @ T),
        "regressor": (
            rigid_body.regressor(tree, z, dz, ddz),
            (T.T @ pin.computeJointTorqueRegressor(model, data, q, v, a))[:, bodies],
        ),
    }
    if chain.tip:
        pin.framesForwardKinematics(model, data, q)
        J = pin.computeFrameJacobian(model, data, q, model.getFrameId(chain.tip), pin.LOCAL_WORLD_ALIGNED)
        pairs["Jacobian"] = (chain.jacobian(z), J @ T)
    return {name: float(np.abs(x - y).max() / max(np.abs(y).max(), 1e-12)) for name, (x, y) in pairs.items()}


def agreement(files: dict[str, Path]) -> dict[str, Any]:
    found: dict[str, Any] = {"robots": 0, "refused": {}, "worst": {}}
    for name, path in files.items():
        try:
            parse_urdf(path.read_text(encoding="utf-8"))
            worst = difference(path)
        except ValueError as error:
            found["refused"][name] = str(error).removeprefix(f"{path}: ")
            continue
        print(f"{name}: {worst}", flush=True)
        found["robots"] += 1
        for what, share in worst.items():
            found["worst"][what] = max(share, found["worst"].get(what, 0.0))
    return found


def table(found: dict[str, Any]) -> str:
    lines = [
        "| robot | base columns | stored | in cache | first call | pinocchio stored | in cache | gradient |",
        "|" + "---|" * 8,
    ]
    for name, each in found["robots"].items():
        cells = [f"{each['base columns']}"]
        for key in ("stored", "in cache", "first call", "pinocchio stored", "pinocchio in cache"):
            text = f"{each[key]:.2f}" if key in each else "not measured"
            cells.append(f"**{text}**" if key in WANTED and each[key] > WANTED[key] else text)
        ratio = f", {each['gradient']:.0f} times faster than differences" if "gradient" in each else ""
        ratio = f"**{ratio}**".replace("**, ", ", **") if each.get("gradient", np.inf) < WANTED["gradient"] else ratio
        lines.append(f"| {name} | {' | '.join(cells)} | {each['gradient ms']:.2f} ms{ratio} |")
    lines += ["", "Microseconds of one core for a sample, seconds for the first call (all samples, compilation in)."]
    if found["agreement"] is None:
        return "\n".join([*lines, "", "Agreement with pinocchio was not measured here.", ""])
    worst = ", ".join(f"{what} {share:.1e}" for what, share in found["agreement"]["worst"].items())
    return "\n".join(
        [*lines, "", f"Largest difference from pinocchio over {found['agreement']['robots']} URDFs: {worst}.", ""]
    )


def main() -> None:
    jax.config.update("jax_enable_x64", True)
    files = peers()
    robots: dict[str, tuple[Path, dict[str, float]]] = {"six-joint arm": (SIX_JOINT_ARM, {})}
    if files:
        fingers = {"panda_finger_joint1": 0.0, "panda_finger_joint2": 0.0}
        robots["UR10"] = (files["ur_description/ur10_robot"], {})
        robots["Panda"] = (files["panda_description/panda"], fingers)
    found: dict[str, Any] = {"machine": platform.processor() or platform.machine(), "jax": jax.__version__}
    found["robots"] = {name: measured(path, locked, bool(files)) for name, (path, locked) in robots.items()}
    found["agreement"] = None
    write(found)
    if files and "--quick" not in sys.argv:
        jax.config.update("jax_disable_most_optimizations", True)  # what runs once need not be fast
        found["agreement"] = agreement(files)
        write(found)


def write(found: dict[str, Any]) -> None:
    (RESULTS / "chain.json").write_text(json.dumps(found, indent=2) + "\n")
    (RESULTS / "chain.md").write_text(table(found))


if __name__ == "__main__":
    main()
