"""Exciting motions, this project beside figaroh's optimiser of trajectories, in one run; ratios count, seconds do not.

A horizontal arm of two links with friction moves for 5 s from rest to rest within limits. Both optimisers minimise the
condition number of the same regressor at 50 Hz: Izz of the upper arm; mx, my and Izz of the forearm; viscous and
Coulomb friction of both joints. These are the base columns that figaroh chooses (it is asserted), and both motions are
judged with them, the sign of the velocity as it is. Pinocchio confirms the regressor and the parameters.

figaroh: its defaults, but all of the room within the limits (`soft_lim` 0), and another start where the solver gives up
(`segment_attempts`). It knows no limit of the acceleration, and no friction in that of the torque: here both count.

Every seed of either is a process of its own, one after the other. Ours designs from more and more starts, as long as it
is expected to take no longer than figaroh's solver has taken for that seed; every call is made with another seed
first, in which it compiles. Writes results/excitation_peer.json and .md. The peers: `pip install -e '.[peers]'`.
"""

from __future__ import annotations

import json
import os
import platform
import subprocess
import sys
import tempfile
import time
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

import jaximp
from jaximp.models import Model

RESULTS = Path(__file__).parents[1] / "results"
PEERS = ("figaroh", "cyipopt", "pinocchio")
SEEDS = range(5)
OTHER_SEED = 100
STARTS = (8, 16, 32, 64)
HARMONICS = 6
PERIOD, RATE = 5.0, 50  # s, Hz
WAY_POINTS, ATTEMPTS = 6, 5
TOLERANCE = 1e-6
"""A limit is kept if it is exceeded by no more than such a share of itself."""

LOW, HIGH = (-1.5, 0.1), (1.5, 2.5)  # rad
VELOCITY, ACCELERATION, TORQUE = 6.0, 60.0, 60.0  # rad/s, rad/s^2, N m
LENGTH = 0.31  # m, of the upper arm
MASS, CENTRE, INERTIA = (1.9, 1.7), (0.13, 0.15), (0.014, 0.018)  # kg, m, kg m^2 about the centre of mass
VISCOUS, COULOMB = (0.5, 0.3), (0.4, 0.2)  # N m s/rad, N m

NAMES = ("Izz_joint1", "mx_joint2", "my_joint2", "Izz_joint2", "fv_joint1", "fv_joint2", "fs_joint1", "fs_joint2")
OWN = [inertia + mass * centre**2 for inertia, mass, centre in zip(INERTIA, MASS, CENTRE, strict=True)]
PARAMETERS = (OWN[0] + MASS[1] * LENGTH**2, MASS[1] * CENTRE[1], 0.0, OWN[1], *VISCOUS, *COULOMB)


class Arm(Model):
    """Two links in a horizontal plane whose second one has its centre of mass anywhere, and friction."""

    width: Array | None
    """(2,) velocity [rad/s] around which the sign of it changes, where it is smoothed."""

    def __init__(self) -> None:
        self.names = self.columns = NAMES
        self.units = ("kg m^2", "kg m", "kg m", "kg m^2", "N m s/rad", "N m s/rad", "N m", "N m")
        self.label = "arm"
        self.n_joints = 2
        self.width = None

    def smoothed(self, width: Any) -> Model:
        widths = jnp.broadcast_to(jnp.asarray(width), (2,))
        return eqx.tree_at(lambda arm: arm.width, self, widths, is_leaf=lambda x: x is None)

    def row(self, q: Array, dq: Array, ddq: Array) -> Array:
        sine, cosine, zero = jnp.sin(q[1]), jnp.cos(q[1]), jnp.zeros(())
        sign = jnp.sign(dq) if self.width is None else jnp.tanh(dq / self.width)
        along, across = 2 * ddq[0] + ddq[1], 2 * dq[0] * dq[1] + dq[1] ** 2
        columns = (
            (ddq[0], zero),
            (LENGTH * (along * cosine - across * sine), LENGTH * (ddq[0] * cosine + dq[0] ** 2 * sine)),
            (-LENGTH * (along * sine + across * cosine), LENGTH * (dq[0] ** 2 * cosine - ddq[0] * sine)),
            (ddq[0] + ddq[1], ddq[0] + ddq[1]),
            (dq[0], zero),
            (zero, dq[1]),
            (sign[0], zero),
            (zero, sign[1]),
        )
        return jnp.stack([jnp.stack(column) for column in columns], axis=-1)


def urdf() -> str:
    links = "".join(
        f'<link name="link{i + 1}"><inertial><origin xyz="{CENTRE[i]} 0 0"/><mass value="{MASS[i]}"/>'
        f'<inertia ixx="0.003" iyy="{INERTIA[i]}" izz="{INERTIA[i]}" ixy="0" ixz="0" iyz="0"/></inertial></link>'
        for i in (0, 1)
    )
    joints = "".join(
        f'<joint name="joint{i + 1}" type="revolute"><parent link="{parent}"/><child link="link{i + 1}"/>'
        f'<origin xyz="{at} 0 0"/><axis xyz="0 0 1"/>'
        f'<limit lower="{LOW[i]}" upper="{HIGH[i]}" velocity="{VELOCITY}" effort="{TORQUE}"/></joint>'
        for i, parent, at in ((0, "ground", 0.0), (1, "link1", LENGTH))
    )
    return f'<robot name="arm"><link name="ground"/>{links}{joints}</robot>'


def check_regressor() -> None:
    """Against pinocchio: the columns, and the torque that the parameters make."""
    import pinocchio

    model = pinocchio.buildModelFromXML(urdf())
    data = model.createData()
    random = np.random.default_rng(0)
    for _ in range(20):
        q, dq, ddq = random.normal(size=(3, 2)) * [[1], [3], [20]]
        row = np.asarray(Arm().row(*map(jnp.asarray, (q, dq, ddq))))
        friction = np.concatenate([np.diag(dq), np.diag(np.sign(dq))], axis=1)
        all_columns = pinocchio.computeJointTorqueRegressor(model, data, q, dq, ddq)
        expected = np.concatenate([all_columns[:, [9, 11, 12, 19]], friction], axis=1)  # m, mx, my, mz, Ixx ... Izz
        np.testing.assert_allclose(row, expected, atol=1e-9, rtol=0)
        torque = pinocchio.rnea(model, data, q, dq, ddq) + friction @ PARAMETERS[4:]
        np.testing.assert_allclose(row @ PARAMETERS, torque, atol=1e-9, rtol=0)


def judged(motion: Any) -> dict[str, Any]:
    """Condition number at the samples, and the share of every limit that is used, of the joint that uses most."""
    q, dq, ddq = (np.asarray(x) for x in motion)
    assert q.shape == dq.shape == ddq.shape == (round(PERIOD * RATE) + 1, 2)
    W = np.asarray(Arm().observation_matrix(q, dq, ddq))
    middle, half = (np.add(HIGH, LOW) / 2, np.subtract(HIGH, LOW) / 2)
    used = {
        "position": np.abs((q - middle) / half).max(),
        "velocity": np.abs(dq).max() / VELOCITY,
        "acceleration": np.abs(ddq).max() / ACCELERATION,
        "torque": np.abs(W @ PARAMETERS).max() / TORQUE,
    }
    at_rest = max(np.abs(x[end]).max() for x in (dq, ddq) for end in (0, -1)) < TOLERANCE
    return {
        "condition": float(np.linalg.cond(W.reshape(-1, len(NAMES)))),
        "used": {name: float(share) for name, share in used.items()},
        "kept": bool(at_rest and max(used.values()) <= 1 + TOLERANCE),
    }


def theirs(seed: int) -> dict[str, Any]:
    begin = time.perf_counter()
    from figaroh.optimal.base_optimal_trajectory import BaseOptimalTrajectory, BaseTrajectoryIPOPTProblem
    from figaroh.tools.load_robot import load_robot

    class Trajectory(BaseOptimalTrajectory):
        def create_ipopt_problem(self, *problem: Any) -> BaseTrajectoryIPOPTProblem:
            return BaseTrajectoryIPOPTProblem(self, *problem)

    joints = ["joint1", "joint2"]
    components = {"friction": True, "joint_offset": False, "actuator_inertia": False}
    friction = {"friction_coefficients": {"viscous": VISCOUS, "static": COULOMB}}
    shape = {"waypoints": WAY_POINTS, "frequency": RATE, "segment_duration": PERIOD / (WAY_POINTS - 1)}
    config = {
        "robot": {"name": "arm", "properties": {"joints": {"active_joints": joints}, "mechanics": friction}},
        "tasks": {
            "identification": {
                "problem": {"model_components": components},
                "signal_processing": {"sampling_frequency": RATE, "cutoff_frequency": RATE / 5},
            },
            "optimal_trajectory": {
                "problem": {"soft_lim": 0.0, "segment_attempts": ATTEMPTS},
                "trajectory": shape,
            },
        },
    }
    imported = time.perf_counter()
    np.random.seed(seed)  # noqa: NPY002 (figaroh draws from it)
    with tempfile.TemporaryDirectory() as folder:
        robot, settings = Path(folder, "arm.urdf"), Path(folder, "arm.yaml")
        robot.write_text(urdf())
        settings.write_text(json.dumps(config))  # JSON is YAML
        optimiser = Trajectory(load_robot(str(robot), package_dirs=folder), joints, str(settings))
    optimiser.identif_config["act_idxv"] = [0, 1]
    optimiser.initialize()
    left = [name for i, name in enumerate(optimiser.base_computer.standard_parameter) if i not in optimiser.idx_e]
    assert tuple(left[i] for i in optimiser.idx_b) == NAMES
    built = time.perf_counter()
    found = optimiser.solve(stack_reps=1)
    solved = time.perf_counter()
    result: dict[str, Any] = {"import_s": imported - begin, "build_s": built - imported, "s": solved - built}
    if found["P_F"]:
        last = found["iteration_data"][0]
        result |= {"attempts": last["attempt"], "converged": last["converged"]}
        result |= judged([found[name][0] for name in ("P_F", "V_F", "A_F")])
    return result


def ours(seed: int, budget: float) -> dict[str, Any]:
    limits = jaximp.Limits(position=(LOW, HIGH), velocity=VELOCITY, acceleration=ACCELERATION, torque=TORQUE)

    def designed(seed: int, starts: int) -> dict[str, Any]:
        begin = time.perf_counter()
        one = jaximp.design_excitation(
            Arm(), harmonics=HARMONICS, period=PERIOD, rest=True, limits=limits, parameters=PARAMETERS,
            sample_rate=RATE, seed=seed, starts=starts,
        )  # fmt: skip
        passed = time.perf_counter() - begin
        motion = one.trajectory(np.arange(round(PERIOD * RATE) + 1) / RATE)
        return {"starts": starts, "s": passed} | judged(motion)

    calls: list[dict[str, Any]] = []
    for starts in STARTS:
        if calls and calls[-1]["s"] * starts / calls[-1]["starts"] > budget:
            break
        first_s = designed(OTHER_SEED, starts)["s"]
        calls.append(designed(seed, starts) | {"first_s": first_s})
    return {"calls": calls}


def measure(*what: Any) -> dict[str, Any]:
    done = subprocess.run([sys.executable, __file__, *map(str, what)], capture_output=True, text=True)
    if done.returncode:
        sys.exit(f"{what}: {done.stderr}")
    found = json.loads(done.stdout.splitlines()[-1])
    print(f"{what}: {found}", flush=True)
    return found


def in_time(found: dict[str, Any]) -> tuple[dict[str, Any], bool]:
    """Our call with the most starts that took no longer than figaroh, or the smallest; and whether it did."""
    calls = found["ours"]["calls"]
    short = [call for call in calls if call["s"] <= found["theirs"]["s"]]
    return (short[-1], True) if short else (calls[0], False)


def limits(one: dict[str, Any]) -> str:
    name, share = max(one["used"].items(), key=lambda item: item[1])
    return f"{'yes' if one['kept'] else 'no'} ({name}, {100 * share:.4g} %)"


def table(found: list[dict[str, Any]]) -> list[str]:
    lines = [
        "| seed | figaroh: condition | time, attempts | limits kept (nearest) | "
        "jaximp: condition | time, starts | limits kept (nearest) | ratio of conditions |",
        "|" + " --- |" * 8,
    ]
    for seed, one in zip(SEEDS, found, strict=True):
        peer, (own, short) = one["theirs"], in_time(one)
        solved = "condition" in peer
        cells = [
            f"{peer['condition']:.2f}" if solved else "no motion",
            f"{peer['s']:.1f} s, {peer['attempts'] if solved else ATTEMPTS}",
            limits(peer) if solved else "",
            f"{own['condition']:.2f}",
            f"{own['s']:.1f} s, {own['starts']}" + ("" if short else " (longer than figaroh)"),
            limits(own),
            f"{peer['condition'] / own['condition']:.2f}" if solved else "",
        ]
        lines.append(f"| {seed} | {' | '.join(cells)} |")
    return [*lines, "", *summary(found)]


def summary(found: list[dict[str, Any]]) -> list[str]:
    theirs = [one["theirs"] for one in found]
    own, short = zip(*map(in_time, found), strict=True)
    least = [one["ours"]["calls"][0] for one in found]
    solved = [one["condition"] for one in theirs if "condition" in one]
    took = np.mean([one["s"] for one in theirs])
    lines = [
        f"In figaroh's time: {sum(short)} of {len(found)} seeds. Conditions: figaroh {min(solved):.2f} to "
        f"{max(solved):.2f}, here {min(x['condition'] for x in own):.2f} to {max(x['condition'] for x in own):.2f} "
        f"(harmonics {HARMONICS}).",
        f"figaroh's best of all seeds, {min(solved):.2f}: here {sum(x['condition'] <= min(solved) for x in least)} of "
        f"{len(least)} calls of {STARTS[0]} starts are at or below it, in {np.mean([x['s'] for x in least]):.2f} s on "
        f"average, {np.mean([x['s'] for x in least]) / took:.2f} of figaroh's {took:.1f} s a seed.",
        f"Not in these times: figaroh imports {np.mean([x['import_s'] for x in theirs]):.1f} s and builds its model "
        f"{np.mean([x['build_s'] for x in theirs]):.1f} s; the first design here, which compiles, takes "
        f"{np.mean([one['first_s'] for one in least]):.1f} s with {STARTS[0]} starts.",
    ]
    return [f"{line}\n" for line in lines]


def machine() -> str:
    model = next((line for line in Path("/proc/cpuinfo").read_text().splitlines() if line.startswith("model name")), "")
    return f"{os.cpu_count()} cores, {model.split(':')[-1].strip() or platform.processor()}"


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    if missing := [name for name in PEERS if find_spec(name) is None]:
        print(f"skipped: {', '.join(missing)} not installed (pip install -e '.[peers]')")
        sys.exit(0)
    if len(sys.argv) > 1:
        who, seed, *budget = sys.argv[1:]
        result = theirs(int(seed)) if who == "theirs" else ours(int(seed), float(budget[0]))
        print("\n" + json.dumps(result))  # after what the solver has printed
        sys.exit(0)
    check_regressor()
    found = []
    for seed in SEEDS:
        peer = measure("theirs", seed)
        found.append({"theirs": peer, "ours": measure("ours", seed, peer["s"])})
    text = "\n".join([machine() + "\n", *table(found)])
    (RESULTS / "excitation_peer.json").write_text(json.dumps({"machine": machine(), "seeds": found}, indent=1) + "\n")
    (RESULTS / "excitation_peer.md").write_text(text)
    print(text)
