"""Recordings of a simulated robot that is like its URDF but not quite, with the job that identifies it: `simulate
robot`."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from jaximp.models.chain import Chain
from jaximp.models.urdf import SIX_JOINT_ARM
from jaximp.recordings.load import recording_from_arrays
from jaximp.recordings.save import save_recording
from jaximp.simulation.robot import exciting_motion, simulate_robot, true_parameters
from jaximp.types import Progress

JOB = """\
# A simulated robot like its URDF, with links some 10 % heavier or lighter; truth.json holds what is to be found.

[recording]
file = "exciting.csv"
time = "time_s"
position = [{position}]
torque = [{torque}]

[held_out]
file = "held_out.csv"

[model.robot]
urdf = "{urdf}"
friction = true
rotor = true
min_velocity = 0.05           # rad/s or m/s: slower joints say nothing of friction

[filter]
position_cutoff = 10          # Hz
decimation_cutoff = 5         # Hz
"""
MAPPED = ("position", "torque")
"""Channels that the job names."""


def write_robot_recordings(
    folder: Path,
    urdf: Path | None = None,
    duration: float = 30.0,
    seed: int = 0,
    progress: Progress = lambda share: None,
) -> None:
    """Write exciting.csv and held_out.csv of two motions, the URDF, job.toml, and truth.json with the base parameters.

    **Arguments:** the `urdf`, by default that of the arm which comes with the package; `duration` of each motion [s].

    **Raises:** `ValueError` as `Chain`, and for a duration that is too short.
    """
    path = Path(SIX_JOINT_ARM) if urdf is None else urdf
    chain = Chain.from_urdf(path, friction=True, rotor=True)
    parameters = true_parameters(chain, seed)
    kinds = list(chain.joint_kinds)
    for k, name in enumerate(("exciting", "held_out")):
        motion = exciting_motion(chain, seed=2 * seed + k)
        made = simulate_robot(chain, parameters, motion, duration, seed=2 * seed + k)
        measured = recording_from_arrays(made.time, made.position, made.torque, joint=kinds, name=name)
        save_recording(measured, folder / f"{name}.csv")
        progress((k + 1) / 2)
    header = (folder / "exciting.csv").read_text(encoding="utf-8").split("\n", 1)[0].replace('"', "").split(",")
    columns = {channel: ", ".join(f'"{one}"' for one in header if one.startswith(channel)) for channel in MAPPED}
    (folder / path.name).write_bytes(path.read_bytes())
    (folder / "job.toml").write_text(JOB.format(urdf=path.name, **columns), encoding="utf-8")
    truth = zip(chain.names, np.asarray(chain.base.map) @ parameters, chain.units, strict=True)
    found = {name: {"value": value, "unit": unit} for name, value, unit in truth}
    (folder / "truth.json").write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
