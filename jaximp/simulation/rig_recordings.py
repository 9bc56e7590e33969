"""Recordings of the simulated rig, alone and held, with the job that identifies them: `demo` and `simulate rig`."""

from __future__ import annotations

from pathlib import Path

import jax

from jaximp.motion.trajectories import FourierSeries
from jaximp.recordings.save import save_recording
from jaximp.simulation.rig import (
    HUMAN_TRAJECTORY,
    ElasticBands,
    Human,
    HumanLoad,
    Rig,
    record,
    simulate_rig,
)
from jaximp.types import Recording

JOB = """\
# The rig of Tout et al. 2023: {what}
# Angles and torques are those of the motor; the handle turns 15 times less.

reference_period = 10.0

[recording]
file = "robot_with_human.csv"
time = "time_s"
position = {{ column = "position_rad", unit = "rad" }}
torque = {{ column = "torque_Nm", unit = "N m" }}
reference = {{ column = "reference_rad", unit = "rad" }}

[robot_recording]
file = "robot_alone.csv"
time = "time_s"
position = {{ column = "position_rad", unit = "rad" }}
torque = {{ column = "torque_Nm", unit = "N m" }}

[model]
robot = {{ gear_ratio = 15, gravity = true, viscous = true, coulomb = true }}
human = {{ gear_ratio = 15, offset = {offset}, joint_name = "other" }}  # a spring at the handle
methods = [1, 3]

[filter]
position_cutoff = 10
decimation_cutoff = 5

[window]
length = 2.0
step = 0.02
min_velocity = 0.1

[trust]
parameters = ["stiffness"]
"""


HOLDING = {
    "spring": (HumanLoad(step_time=10.0), "a spring at the handle whose stiffness doubles after 10 s"),
    "bands": (ElasticBands(), "rubber bands at the handle, half of which are removed after 10 s"),
}
"""What can hold the handle, for two periods of 10 s."""


def rig_recordings(
    human: Human, seed: int = 0, reference: FourierSeries = HUMAN_TRAJECTORY, duration: float = 20.0
) -> tuple[Recording, Recording]:
    """The rig alone (R) and held by a human (RH), on the same motion, `duration` [s] each."""
    rig, keys = Rig(), jax.random.split(jax.random.key(seed))
    alone = simulate_rig(rig, reference, duration, key=keys[0])
    held = simulate_rig(rig, reference, duration, human, key=keys[1])
    return record(alone, "robot_alone"), record(held, "robot_with_human")


def write_rig_recordings(folder: Path, holding: str = "spring", seed: int = 0) -> None:
    """Write both recordings as CSV, and job.toml."""
    human, what = HOLDING[holding]
    for recording in rig_recordings(human, seed):
        save_recording(recording, folder / f"{recording.name}.csv")
    offset = "false" if holding == "spring" else "true"
    (folder / "job.toml").write_text(JOB.format(what=what, offset=offset), encoding="utf-8")
