"""Exciting motions of robots with six joints: the condition number reached, and in what time, compilation included.

Limits: positions within half a turn, velocity and effort of the URDF, 4.9 rad/s^2. 10 s from rest to rest, 8 harmonics,
36 columns in SI units. Every seed is a process of its own, without a store of compiled programs: seconds count from the
call to the motion. Motions are judged on 2000 instants, with pinocchio's torque where that is installed.

The robots are the UR10 of `example-robot-data`, where that is installed; the UR10e of the public recordings, where
these are found (JAXIMP_DATA, else ../shared/data); and the arm that comes with the package. With `figaroh`
(pip install -e '.[peers]') its optimiser of trajectories runs beside on the UR10: splines from rest to rest, which know
no limit of the acceleration. Writes results/chain_excitation.json and .md.

    python chain_excitation.py [--peer]      # --peer: figaroh too, some minutes a seed
"""

from __future__ import annotations

import json
import os
import platform
import subprocess
import sys
import tempfile
import time
import xml.etree.ElementTree as ET
from importlib.util import find_spec
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np

HERE = Path(__file__).parent
RESULTS = HERE.parent / "results"
DATA = Path(os.environ.get("JAXIMP_DATA") or HERE / "../../../shared/data")
SEEDS = range(3)
PERIOD, HARMONICS, ACCELERATION, FINE = 10.0, 8, 4.9, 2000
WANTED, SECONDS = 8.0, 25.0
TOLERANCE = 1e-6
"""A limit is kept if it is exceeded by no more than such a share of itself."""
PEERS = ("figaroh", "cyipopt", "pinocchio")
WAY_POINTS, SEGMENT, RATE, ATTEMPTS = 6, 2.0, 20, 5
"""Of figaroh's splines: segments [s], and samples a second."""


def robots() -> dict[str, Path]:
    from chain import peers

    from jaximp.models import SIX_JOINT_ARM

    found = {}
    for name, path in peers().items():
        if name == "ur_description/ur10_robot":
            found["UR10"] = path
    if (DATA / "ur10e/ur10e.urdf").is_file():
        found["UR10e"] = DATA / "ur10e/ur10e.urdf"
    return found | {"six-joint arm": SIX_JOINT_ARM}


def half_turn(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """The file's positions, no farther than half a turn either way."""
    from jaximp.models import Chain

    limits = Chain.from_urdf(path).limits
    return np.maximum(limits.lower, -np.pi), np.minimum(limits.upper, np.pi)


def judged(path: Path, motion: Any) -> dict[str, Any]:
    """Condition numbers, and the share of every limit that is used, of the joint that uses most."""
    from jaximp.models import Chain

    chain = Chain.from_urdf(path)
    q, dq, ddq = (np.asarray(x) for x in motion)
    W = np.asarray(chain.observation_matrix(q, dq, ddq)).reshape(-1, len(chain.names))
    low, high = half_turn(path)
    torque = pinocchios_torque(path, q, dq, ddq)
    if torque is None:
        torque = np.asarray(chain.inverse_dynamics(q, dq, ddq))
    used = {
        "position": np.maximum(q / high, q / low).max(),
        "velocity": (np.abs(dq).max(axis=0) / chain.limits.velocity).max(),
        "acceleration": np.abs(ddq).max() / ACCELERATION,
        "torque": (np.abs(torque).max(axis=0) / chain.limits.effort).max(),
    }
    return {
        "condition": float(np.linalg.cond(W)),
        "unit": float(np.linalg.cond(W / np.linalg.norm(W, axis=0))),
        "used": {name: float(share) for name, share in used.items()},
        "rest": float(max(np.abs(x[[0, -1]]).max() for x in (dq, ddq))),
    }


def pinocchios_torque(path: Path, *motion: np.ndarray) -> np.ndarray | None:
    if find_spec("pinocchio") is None:
        return None
    import pinocchio as pin

    model = pin.buildModelFromUrdf(str(path))
    data = model.createData()
    return np.array([pin.rnea(model, data, *sample) for sample in zip(*motion, strict=True)])


def ours(path: Path, seed: int) -> dict[str, Any]:
    import jax

    jax.config.update("jax_enable_x64", True)
    import jaximp
    from jaximp.models import Chain

    wall, cpu = time.perf_counter(), time.process_time()
    chain = Chain.from_urdf(path)
    limits = jaximp.Limits(position=half_turn(path), acceleration=ACCELERATION)
    one = jaximp.design_excitation(chain, limits=limits, period=PERIOD, harmonics=HARMONICS, rest=True, seed=seed)
    found = {"wall_s": time.perf_counter() - wall, "cpu_s": time.process_time() - cpu}
    t = np.linspace(0, PERIOD, FINE + 1)
    found |= judged(path, one.trajectory(t)) | {"active": one.limits_reached()}
    return found | {"columns": len(chain.names), "conditions": one.conditions.tolist()}


def theirs(path: Path, seed: int) -> dict[str, Any]:
    """figaroh's splines, on the robot without its meshes and within half a turn."""
    begin = time.perf_counter()
    from figaroh.optimal.base_optimal_trajectory import BaseOptimalTrajectory, BaseTrajectoryIPOPTProblem
    from figaroh.tools.load_robot import load_robot

    class Trajectory(BaseOptimalTrajectory):
        def create_ipopt_problem(self, *problem: Any) -> BaseTrajectoryIPOPTProblem:
            return BaseTrajectoryIPOPTProblem(self, *problem)

    tree = ET.parse(path)
    for link in tree.getroot().findall("link"):
        for shape in [*link.findall("visual"), *link.findall("collision")]:
            link.remove(shape)
    joints = []
    (low, high), moving = half_turn(path), [j for j in tree.getroot().findall("joint") if j.get("type") == "revolute"]
    for joint, lower, upper in zip(moving, low, high, strict=True):
        joints.append(str(joint.get("name")))
        limit = joint.find("limit")
        assert limit is not None
        limit.set("lower", str(lower))
        limit.set("upper", str(upper))
    config = {
        "robot": {"name": "arm", "properties": {"joints": {"active_joints": joints}, "mechanics": {}}},
        "tasks": {
            "identification": {
                "problem": {"model_components": {"friction": False, "joint_offset": False, "actuator_inertia": False}},
                "signal_processing": {"sampling_frequency": RATE, "cutoff_frequency": RATE / 5},
            },
            "optimal_trajectory": {
                "problem": {"soft_lim": 0.0, "segment_attempts": ATTEMPTS},
                "trajectory": {"waypoints": WAY_POINTS, "frequency": RATE, "segment_duration": SEGMENT},
            },
        },
    }
    np.random.seed(seed)  # noqa: NPY002 (figaroh draws from it)
    with tempfile.TemporaryDirectory() as folder:
        robot, settings = Path(folder, "arm.urdf"), Path(folder, "arm.yaml")
        tree.write(robot)
        settings.write_text(json.dumps(config))  # JSON is YAML
        optimiser = Trajectory(load_robot(str(robot), package_dirs=folder), joints, str(settings))
    optimiser.identif_config["act_idxv"] = list(range(len(joints)))
    optimiser.initialize()
    found = optimiser.solve(stack_reps=1)
    result: dict[str, Any] = {"wall_s": time.perf_counter() - begin}
    if found["P_F"]:
        result |= judged(path, [found[name][0] for name in ("P_F", "V_F", "A_F")])
    return result


def measure(who: str, path: Path, seed: int) -> dict[str, Any]:
    environment = os.environ | {"JAX_ENABLE_COMPILATION_CACHE": "0"}
    command = [sys.executable, __file__, who, str(path), str(seed)]
    done = subprocess.run(command, capture_output=True, text=True, env=environment)
    if done.returncode:
        sys.exit(f"{who}, {path.stem}, {seed}: {done.stderr}")
    found = json.loads(done.stdout.splitlines()[-1])
    print(f"{who}, {path.stem}, seed {seed}: {found}", flush=True)
    return found


def row(name: str, seed: int, who: str, one: dict[str, Any], ours: bool) -> str:
    if "condition" not in one:
        return f"| {name} | {seed} | {who} | no motion | | {one['wall_s']:.1f} s | | |"
    cells = [f"{one['condition']:.2f}", f"{one['unit']:.2f}", f"{one['wall_s']:.1f} s"]
    if ours:
        cells[0] = cells[0] if one["condition"] <= WANTED else f"**{cells[0]}**"
        cells[2] = cells[2] if one["wall_s"] <= SECONDS else f"**{cells[2]}**"
    cells.insert(3, f"{one['cpu_s']:.1f} s" if "cpu_s" in one else "")
    over = {limit: share for limit, share in one["used"].items() if share > 1 + TOLERANCE}
    cells.append(", ".join(f"{limit} {100 * share:.0f} %" for limit, share in over.items()) or "all kept")
    return f"| {name} | {seed} | {who} | {' | '.join(cells)} |"


def table(found: dict[str, Any]) -> str:
    lines = ["| robot | seed | by | condition | unit columns | time | of the processor | limits |", "|" + "---|" * 8]
    for name, seeds in found["robots"].items():
        for seed, one in zip(SEEDS, seeds, strict=True):
            lines.append(row(name, seed, "jaximp", one["ours"], True))
            if "theirs" in one:
                lines.append(row(name, seed, "figaroh", one["theirs"], False))
    at_rest = max(one["ours"]["rest"] for seeds in found["robots"].values() for one in seeds)
    lines += [
        "",
        f"{found['machine']}. Time includes compilation. Velocity and acceleration at the ends: {at_rest:.0e} at most.",
    ]
    if found["missing"]:
        lines.append(f"figaroh was not run here: {found['missing']}.")
    return "\n".join([*lines, ""])


def machine() -> str:
    model = next((line for line in Path("/proc/cpuinfo").read_text().splitlines() if line.startswith("model name")), "")
    return f"{os.cpu_count()} cores, {model.split(':')[-1].strip() or platform.processor()}"


def main() -> None:
    lacking = [name for name in PEERS if find_spec(name) is None]
    missing = (
        f"{', '.join(lacking)} not installed" if lacking else "" if "--peer" in sys.argv else "--peer was not given"
    )
    found: dict[str, Any] = {"machine": machine(), "missing": missing, "robots": {}}
    for name, path in robots().items():
        seeds = []
        for seed in SEEDS:
            one = {"ours": measure("ours", path, seed)}
            if not missing and name == "UR10":
                one["theirs"] = measure("theirs", path, seed)
            seeds.append(one)
        found["robots"][name] = seeds
    (RESULTS / "chain_excitation.json").write_text(json.dumps(found, indent=1) + "\n")
    (RESULTS / "chain_excitation.md").write_text(table(found))
    print(table(found))


if __name__ == "__main__":
    if len(sys.argv) > 3:
        who, path, seed = sys.argv[1:4]
        print("\n" + json.dumps((ours if who == "ours" else theirs)(Path(path), int(seed))))
    else:
        main()
