"""Recordings of the simulated arm of Börner et al. 2020, with the job that reads them: `simulate arm`.

They are sampled at 2 kHz, every second sample of the simulation: half the file (6 MB in place of 13), and little is
lost. Of what the perturbations make in the window, velocities that are read are wrong by 0.73 % in place of 0.68 %,
and accelerations by 4.4 % in place of 4.2 %, nearly all of which the smoothing takes off the force as well.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from jaximp.models.inertia import BASE_INERTIA
from jaximp.models.kinematics import ArmGeometry
from jaximp.perturbation.stiffness import symmetric_matrix
from jaximp.perturbation.trials import VOLUNTARY_DELAY, Trials
from jaximp.recordings.load import recording_from_arrays
from jaximp.recordings.save import save_trial_table
from jaximp.simulation.neuromuscular import (
    ANGLES,
    POSTURES,
    RATE,
    NeuromuscularArm,
    Reach,
    Reaches,
    hold_posture,
    neural_noise,
    perturbing_forces,
    reach,
)
from jaximp.types import Numbers, Progress, Recording

EVERY = 2
"""One of so many samples of the simulation is recorded."""
SETTLE = 1.0
"""The noise of the static task starts at zero; from here on it is recorded [s]."""
STATIC = (0.5, 1.1)
"""Onset in a recording of the static task, and its duration [s]."""

JOB = """\
# Simulated reaching movements, some of them perturbed, and perturbed postures: Börner et al. 2020.

[trials]
file = "movements.{format}"
trial = "trial"
time = "time_s"
position = ["position1_m", "position2_m"]   # of the hand, from the shoulder
torque = ["torque1_N", "torque2_N"]         # the force of the handle on the hand
command = ["command1_N", "command2_N"]      # the perturbing force: zero in unperturbed trials
method = "output_error"                       # or a list: the first makes the report
window = {window}                              # s

[trials.handle]
mass = {mass}                           # kg
damping = {damping}                      # N s/m

[trials.posture]                              # for the inertia: the arm keeps a posture, the handle moves it by 8 mm
file = "postures.{format}"
reference = ["reference1_m", "reference2_m"]  # what the handle was asked to follow

[model.arm]
lengths = {lengths}                      # m
"""


@dataclass(frozen=True)
class Sensors:
    """What the recordings add to the simulation."""

    position_step: float = 1e-6
    """Step of the encoders [m]; zero for none. Those of the paper have 1 um."""
    force_noise: float = 0.0
    """Standard deviation of the white noise of the force [N]."""


def arm_movements(
    arm: NeuromuscularArm, perturbed: int = 20, unperturbed: int = 40, seed: int = 0, duration: float = 2.0
) -> Reaches:
    """Reaching movements (T, N) in random order, `perturbed` of them with the paper's perturbations, at 4 kHz.

    **Arguments:** `duration` [s] of each trial; the hand moves in its middle.

    **Raises:** `ValueError` for fewer than two perturbed movements, or less than a second.
    """
    if perturbed < 2 or unperturbed < 0:
        raise ValueError(f"{perturbed} perturbed and {unperturbed} unperturbed movements: at least 2 and 0 are needed")
    if not 1.0 <= duration <= 20.0:
        raise ValueError(f"a movement of {duration:g} s: it must last from 1 to 20 s")
    keys = jax.random.split(jax.random.key(seed), 3)
    pushes = perturbing_forces(keys[0], -(-perturbed // len(ANGLES)))[:perturbed]
    forces = jax.random.permutation(keys[1], jnp.concatenate([pushes, jnp.zeros((unperturbed, 2))]))
    task = Reach(duration=duration)

    def simulated() -> Reaches:
        return reach(arm, task, forces, neural_noise(keys[2], len(forces), round(duration * RATE)))

    return jax.jit(simulated)()


def arm_postures(arm: NeuromuscularArm, seed: int = 0) -> Trials:
    """The static task: every posture with four of the twenty directions, all of them once, at 4 kHz.

    The onset is the same in all trials: `STATIC`.
    """
    postures = np.repeat(POSTURES, 4, axis=0)
    angles = np.concatenate([ANGLES[k :: len(POSTURES)] for k in range(len(POSTURES))])
    first, duration = STATIC
    key = jax.random.fold_in(jax.random.key(seed), 1)

    def simulated() -> Trials:
        noise = neural_noise(key, len(angles), round((SETTLE + duration) * RATE))
        return hold_posture(arm, postures, angles, noise, onset=SETTLE + first)

    return jax.jit(simulated)()


def as_recordings(
    movements: Trials, sensors: Sensors, seed: int = 0, first: int = 0, every: int = EVERY, static: bool = False
) -> list[Recording]:
    """What sensors record, every n-th sample from the first on: position [m], force [N], and the perturbing force [N]
    as `command`, or in the static task the handle's position [m] as `reference`."""
    if not 0 <= sensors.force_noise < np.inf:
        raise ValueError(f"the force's noise of {sensors.force_noise:g} N: it must be zero or more")
    rng = np.random.default_rng(seed)
    part = (slice(None), slice(first, None, every))
    position, force, command = (np.asarray(x)[part] for x in (movements.position, movements.force, movements.command))
    time = np.arange(position.shape[1]) * every / movements.sample_rate
    measured = _rounded(position, sensors.position_step)
    force = force + sensors.force_noise * rng.normal(size=force.shape)
    asked = {"reference": position} if static else {"command": command}
    return [
        recording_from_arrays(
            time, measured[k], force[k], joint="prismatic", name=f"{k + 1}", **{name: x[k] for name, x in asked.items()}
        )
        for k in range(len(measured))
    ]


def _rounded(x: Numbers, step: float) -> Numbers:
    if not 0 <= step < 0.01:
        raise ValueError(f"an encoder in steps of {step:g} m: it must be from 0 to 0.01 m")
    return np.round(x / step) * step if step else x


def write_arm_recordings(
    folder: Path,
    *,
    perturbed: int = 20,
    unperturbed: int = 40,
    duration: float = 2.0,
    seed: int = 0,
    sensors: Sensors | None = None,
    format: str = "parquet",
    progress: Progress = lambda share: None,
) -> None:
    """Write `movements` and `postures` (one file each, with a column `trial`), the job.toml that reads them, and
    truth.json with the impedance and the inertia behind them."""
    arm, sensors = NeuromuscularArm(), sensors or Sensors()
    moved = arm_movements(arm, perturbed, unperturbed, seed, duration)
    progress(0.4)
    held = arm_postures(arm, seed)
    progress(0.6)
    save_trial_table(as_recordings(moved.movements, sensors, seed), folder / f"movements.{format}")
    settled = round(SETTLE * RATE)
    static = as_recordings(held, sensors, seed + 1, settled, static=True)
    save_trial_table(static, folder / f"postures.{format}")
    progress(0.9)
    numbers = {"lengths": arm.lengths, "mass": arm.handle.mass, "damping": arm.handle.damping}
    lists = {name: np.asarray(x).tolist() for name, x in numbers.items()}
    text = JOB.format(format=format, window=VOLUNTARY_DELAY, **lists)
    (folder / "job.toml").write_text(text, encoding="utf-8")
    truth = json.dumps(true_values(arm, moved, seed), indent=1) + "\n"
    (folder / "truth.json").write_text(truth, encoding="utf-8")


def true_values(arm: NeuromuscularArm, moved: Reaches, seed: int = 0) -> dict[str, object]:
    """Impedance of the joints in the window after the onset, mean and standard deviation over perturbed movements; the
    inertia, by the names of `BASE_INERTIA`; and at the hand, the stiffness at the mean position of the onset."""
    pushed = np.flatnonzero(np.abs(np.asarray(moved.movements.command)).max(axis=(1, 2)) > 0)
    onset, samples = np.asarray(moved.movements.onset)[pushed], round(VOLUNTARY_DELAY * RATE)
    rows = onset[:, None] + np.arange(samples)
    stiffness = np.asarray(moved.stiffness)[pushed[:, None], rows].mean(axis=1)
    mean, sd = (symmetric_matrix(x) for x in (stiffness.mean(axis=0), stiffness.std(axis=0, ddof=1)))
    place = np.asarray(moved.movements.position)[pushed, onset].mean(axis=0)
    geometry = ArmGeometry(np.asarray(arm.lengths))
    inverse = np.linalg.inv(np.asarray(geometry.jacobian(geometry.inverse(place))))
    time = float(arm.damping_time)
    return {
        "seed": seed,
        "window_s": VOLUNTARY_DELAY,
        "stiffness_Nm_per_rad": mean.tolist(),
        "stiffness_sd_over_trials": sd.tolist(),
        "damping_Nms_per_rad": (time * mean).tolist(),
        "damping_sd_over_trials": (time * sd).tolist(),
        "inertia_kgm2": dict(zip(BASE_INERTIA, np.asarray(arm.inertia).tolist(), strict=True)),
        "hand_at_onset_m": place.tolist(),
        "stiffness_of_the_hand_N_per_m": (inverse.T @ mean @ inverse).tolist(),
        "perturbed_trials": (pushed + 1).tolist(),
        "onset_s": (onset / RATE).tolist(),
    }
