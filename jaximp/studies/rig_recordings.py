"""Recordings of the simulated rig, alone and held, with the job that identifies them: `demo` and `simulate rig`."""

from __future__ import annotations

from pathlib import Path

import jax

from jaximp.recordings import save_recording
from jaximp.simulation.rig import (
    BANDS_TRAJECTORY,
    PAPER_TRAJECTORY,
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
human = {{ gear_ratio = 15, offset = {offset} }}
methods = [1, 3, 4]

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


def rig_recordings(holding: str = "spring", seed: int = 0) -> tuple[Recording, Recording]:
    """The rig alone (R) and held (RH), each 10 s (`spring`, a stiffness that doubles) or 20 s (`bands`)."""
    rig, keys = Rig(), jax.random.split(jax.random.key(seed))
    human: Human
    if holding == "spring":
        reference, human, duration = PAPER_TRAJECTORY, HumanLoad(), 10.0
    elif holding == "bands":
        reference, human, duration = BANDS_TRAJECTORY, ElasticBands(), 20.0
    else:
        raise ValueError(f"the handle can be held by 'spring' or 'bands', not '{holding}'")
    alone = simulate_rig(rig, reference, duration, key=keys[0])
    held = simulate_rig(rig, reference, duration, human, key=keys[1])
    return record(alone, "robot_alone"), record(held, "robot_with_human")


def write_rig_recordings(folder: Path, holding: str = "spring", seed: int = 0) -> None:
    """Write both recordings as CSV, and job.toml."""
    for recording in rig_recordings(holding, seed):
        save_recording(recording, folder / f"{recording.name}.csv")
    what = {
        "spring": "a spring at the handle whose stiffness doubles after 5 s",
        "bands": "rubber bands at the handle, half of which are removed after 10 s",
    }[holding]
    offset = "false" if holding == "spring" else "true"
    # Top-level keys come first in TOML.
    text = JOB.format(what=what, offset=offset).replace("\n[recording]", "\nreference_period = 10.0\n\n[recording]", 1)
    (folder / "job.toml").write_text(text, encoding="utf-8")
