"""Recordings of a simulated robot that is like its URDF but not quite, alone or held by a human, with the job that
identifies it: `simulate robot`."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from jaximp.models.chain import Chain
from jaximp.models.tip import TipImpedance
from jaximp.models.urdf import SIX_JOINT_ARM
from jaximp.motion.trajectories import FourierSeries
from jaximp.recordings.load import recording_from_arrays
from jaximp.recordings.save import save_recording
from jaximp.simulation.robot import exciting_motion, simulate_robot, true_parameters
from jaximp.types import Numbers, Progress

JOB = """\
# A simulated robot like its URDF, with links some 10 % heavier or lighter; truth.json holds what is to be found.

[recording]
file = "{recording}.csv"
time = "time_s"
position = [{position}]
torque = [{torque}]

{beside}
[model.robot]
urdf = "{urdf}"
friction = true
rotor = true
min_velocity = 0.05           # rad/s or m/s: slower joints say nothing of friction

[filter]
position_cutoff = 10          # Hz
decimation_cutoff = 5         # Hz
"""
HELD_OUT = """\
[held_out]
file = "held_out.csv"
"""
HUMAN = """\
[robot_recording]
file = "alone.csv"
time = "time_s"
position = [{position}]
torque = [{torque}]

[model]
methods = [1, 2, 3, 4]

[model.human]
directions = "xyz"
"""
IMPEDANCE = {"mass": (1.0, 1.4, 0.8), "damping": (20.0, 14.0, 25.0), "stiffness": (150.0, 100.0, 200.0)}
"""Of the human, along x, y and z [kg, N s/m, N/m]; at rest where the tip is in the middle of the motion."""
MAPPED = ("position", "torque")
"""Channels that the job names."""


def write_robot_recordings(
    folder: Path,
    urdf: Path | None = None,
    duration: float = 30.0,
    seed: int = 0,
    progress: Progress = lambda share: None,
    held: bool = False,
) -> None:
    """Write exciting.csv and held_out.csv of two motions, the URDF, job.toml, and truth.json with the base parameters.
    Of a robot that is `held` by a human, alone.csv and held.csv of one motion, and the truth of both.

    **Arguments:** the `urdf`, by default that of the arm which comes with the package; `duration` of each motion [s].

    **Raises:** `ValueError` as `Chain`, for a duration that is too short, and for a human who could hold several ends.
    """
    path = Path(SIX_JOINT_ARM) if urdf is None else urdf
    chain = Chain.from_urdf(path, friction=True, rotor=True)
    parameters = true_parameters(chain, seed)
    if held and chain.tip is None:
        raise ValueError(f"{path} branches: nobody knows which end a human would hold; leave --human out")
    kinds, names = list(chain.joint_kinds), ("alone", "held") if held else ("exciting", "held_out")
    human = _human(chain, exciting_motion(chain, seed=2 * seed)) if held else None
    for k, name in enumerate(names):
        motion = exciting_motion(chain, seed=2 * seed + (0 if held else k))
        who = human if name == "held" else None
        made = simulate_robot(chain, parameters, motion, duration, seed=2 * seed + k, human=who)
        measured = recording_from_arrays(made.time, made.position, made.torque, joint=kinds, name=name)
        save_recording(measured, folder / f"{name}.csv")
        progress((k + 1) / 2)
    header = (folder / f"{names[0]}.csv").read_text(encoding="utf-8").split("\n", 1)[0].replace('"', "").split(",")
    columns = {channel: ", ".join(f'"{one}"' for one in header if one.startswith(channel)) for channel in MAPPED}
    (folder / path.name).write_bytes(path.read_bytes())
    beside = HUMAN.format(**columns) if held else HELD_OUT
    job = JOB.format(urdf=path.name, recording=names[1] if held else names[0], beside=beside, **columns)
    (folder / "job.toml").write_text(job, encoding="utf-8")
    truth = [*zip(chain.names, np.asarray(chain.base.map) @ parameters, chain.units, strict=True)]
    truth += [] if human is None else zip(human[0].names, human[1], human[0].units, strict=True)
    found = {name: {"value": value, "unit": unit} for name, value, unit in truth}
    (folder / "truth.json").write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")


def _human(chain: Chain, motion: FourierSeries) -> tuple[TipImpedance, Numbers]:
    """Who holds the end, and is at rest in the middle of the motion."""
    model = TipImpedance(chain)
    place = np.asarray(chain.forward_kinematics(np.asarray(motion.offset))[1])
    force = -np.array(IMPEDANCE["stiffness"]) * place
    return model, np.concatenate([*IMPEDANCE.values(), force])
