"""What crosses the borders between modules: names of shapes, and the recording.

Shapes, everywhere in jaximp: time is axis 0. `N` samples, `M` windows, `S` samples in a window, `n` joints,
`p` parameters. SI units inside; other units are converted where files are read.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

AnyArray = Any
"""What public functions take: arrays of JAX or numpy. (Their shape and kind of number are checked all the same.)"""

Numbers = NDArray[np.float64]

JOINT_TYPES = ("revolute", "prismatic")

Progress = Callable[[float], None]
"""Called with the finished share of a long computation, from 0 to 1."""


@dataclass(frozen=True)
class Fault:
    """What a sensor or a recorder did to the raw samples of one column."""

    label: str
    """Of the column: `position`, or `torque 2` of several joints."""
    kind: str
    """`glitches`, `held samples` or `saturation`."""
    share: float
    """Of the samples."""
    text: str
    """What was seen and what was done about it, in words that begin with the label."""


@dataclass(frozen=True, eq=False)
class Recording:
    """One measured motion on a uniform time grid, in SI units.

    Angles [rad] and torques [N m] for revolute joints, positions [m] and forces [N] for prismatic ones. A sample
    that was not measured (a gap, NaN) is False in `valid` and NaN in the arrays.

    **Example:**

    ```pycon
    >>> t = np.arange(0, 4, 0.005)
    >>> recording = jaximp.recording_from_arrays(t, np.sin(t), np.cos(t), name="knee")
    >>> print(recording.name, recording.joints, len(recording.time), recording.valid.all())
    knee ('revolute',) 800 True

    ```
    """

    time: NDArray[np.float64]
    """(N,) uniformly spaced time stamps [s]."""
    position: NDArray[np.float64]
    """(N, n) joint position."""
    torque: NDArray[np.float64]
    """(N, n) torque of each joint, with the sign of the model."""
    valid: NDArray[np.bool_]
    """(N,) False where the sample must not be used."""
    joints: tuple[str, ...]
    """`revolute` or `prismatic`, for each joint."""
    velocity: NDArray[np.float64] | None = None
    """(N, n) measured velocity."""
    acceleration: NDArray[np.float64] | None = None
    """(N, n) measured acceleration."""
    force: NDArray[np.float64] | None = None
    """(N, k) force at the endpoint [N]."""
    reference: NDArray[np.float64] | None = None
    """(N, n) position that the controller was asked to follow."""
    command: NDArray[np.float64] | None = None
    """(N, n) perturbing torque (or force) that was commanded, zero before and after the perturbation."""
    position_noise: NDArray[np.float64] | None = None
    """(n,) standard deviation of the white noise of each position, as it was seen before anything was resampled; None
    where nobody has looked."""
    stated_noise: NDArray[np.float64] | None = None
    """(n,) standard deviation of the sensor of each position, where it was stated; samples may not show all of it."""
    delay_unknown: bool = False
    """Whether the delay of the torque behind the position is to be estimated and taken out."""
    gain_covariance: NDArray[np.float64] | None = None
    """(n, n) covariance of the relative errors of the gains behind the torques, where these are stated: a drive's gain
    that is 3 % off makes the torque of its joint 3 % too large throughout."""
    clipped: NDArray[np.bool_] | None = None
    """(N,) True where a torque was cut off at a limit; these samples are not valid."""
    name: str = "recording"
    notes: tuple[str, ...] = ()
    """What reading the file changed or noticed, in plain words."""
    faults: tuple[Fault, ...] = ()
    """What was wrong with the raw samples; the notes say it too."""

    @property
    def sample_rate(self) -> float:
        """Samples per second [Hz], to nine digits: recordings made alike share compiled code whatever their clock's
        rounding."""
        return float(f"{(len(self.time) - 1) / (self.time[-1] - self.time[0]):.9g}")

    @property
    def n_joints(self) -> int:
        return self.position.shape[1]

    def __len__(self) -> int:
        return len(self.time)

    def of_joint(self, j: int) -> Recording:
        """Position and torque of one joint of several, counted from zero, and what was asked of it."""
        this = slice(j, j + 1)
        seen, stated = (None if noise is None else noise[this] for noise in (self.position_noise, self.stated_noise))
        reference, command = (None if x is None else x[:, this] for x in (self.reference, self.command))
        gains = None if self.gain_covariance is None else self.gain_covariance[this, this]
        return replace(
            self,
            position=self.position[:, this],
            torque=self.torque[:, this],
            joints=self.joints[this],
            reference=reference,
            command=command,
            position_noise=seen,
            stated_noise=stated,
            gain_covariance=gains,
        )


MOST_CHOICES = 50
"""How many choices a hint names."""


RobotAlone = Recording | tuple[Recording, Recording] | None
"""The robot without the human: one recording, or one before and one after that with the human."""


def listed(names: Sequence[str]) -> str:
    """a, b and c."""
    return " and ".join(filter(None, [", ".join(names[:-1]), names[-1]]))


def nearest(name: str, choices: list[str]) -> str:
    """A hint for error messages: the choice that `name` was probably meant to be, and what there is if none is near."""
    import difflib

    close = difflib.get_close_matches(name, choices, n=1, cutoff=0.6)
    if close:
        return f"did you mean '{close[0]}'?"
    shown = [f"'{choice}'" for choice in choices[:MOST_CHOICES]]
    return "there are: " + ", ".join([*shown, *["..."] * (len(choices) > MOST_CHOICES)])
