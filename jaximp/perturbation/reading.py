"""From recordings of a hand to trials that begin their perturbation at one sample: movements, and postures.

A movement is perturbed where its `command`, the perturbing force, leaves zero; that is its onset. An unperturbed one
belongs where the hand passes the place at which the others were perturbed. A posture is always perturbed. Derivatives
are those of Savitzky-Golay filters, as in Börner et al. 2020, 2.4.1.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np

from jaximp.models.kinematics import ArmGeometry
from jaximp.numerics.precision import require_float64
from jaximp.perturbation.onsets import SILENT, find_onset, starts_at_rest
from jaximp.perturbation.sensors import judge_sensors
from jaximp.perturbation.trials import (
    HISTORY,
    VOLUNTARY_DELAY,
    Handle,
    Trials,
    check_directions,
    farthest,
    window_warning,
)
from jaximp.signals.derivatives import savitzky_golay, savitzky_golay_half_length
from jaximp.signals.samples import fill_gaps, widen_gaps
from jaximp.types import Numbers, Recording, nearest

TASKS = ("movement", "posture")
"""What the subject does: move and be perturbed at times, or keep a posture and be moved out of it."""
MARGIN = 0.05
"""What every trial must have after its window [s], for the filters of what comes next."""
APPROACH = 0.1
"""The hand's way in so many seconds before the onset is the direction of the movement."""
WIDER = 2.0
"""Cut-off of the differentiator over that of the smoothing before it: the smoothing decides. (It leaves 99.1 % of the
acceleration at 40 Hz, with 1.3 times the noise of a differentiator of one stage, and 1.4 times in the jerk.)"""


def read_trials(
    recordings: Sequence[Recording],
    task: str = "movement",
    *,
    window: float = VOLUNTARY_DELAY,
    onset: float | Sequence[float] | None = None,
    trigger: tuple[int, float] | None = None,
    before: float | None = None,
    after: float | None = None,
    handle: Handle | None = None,
    geometry: ArmGeometry | None = None,
    smooth: bool = True,
    cutoff: float | None = 50.0,
    order: int = 7,
) -> tuple[Trials, Trials | None, tuple[str, ...]]:
    """Trials of one length, cut so that all perturbations begin at the same sample, from one recording each.

    **Arguments:**

    - `recordings` of the hand: joints `("prismatic", "prismatic")`, position [m], `torque` for the force on it [N],
      and what the robot was asked for: as `command` the perturbing force [N], zero throughout unperturbed movements.
      Velocity and acceleration serve where they were measured.
    - `task` is `movement`, or `posture`: the hand keeps a place and is moved out of it in every trial. The onset of a
      posture may also stand in the `reference`, the position [m] that the handle was asked to follow; where no force
      was commanded, the command is then zero. `window`, `trigger` and `handle` are of no use with postures.
    - `window` [s] after the onset from which impedance is to be estimated.
    - `onset` [s] in each recording's own time, NaN for an unperturbed movement; without it, it is found in the command
      (`find_onset`). Needed without a command, which then follows from the `handle` (or is NaN).
    - `trigger`: axis (0 or 1) and position [m] on it at which unperturbed movements are aligned; without it, the median
      place of the hand at the onset, along the direction in which it moved there.
    - `before` and `after` [s] are kept around the onset; without them, as much as every trial has.
    - `geometry` of the arm: positions out of its reach are refused.
    - `smooth`: position and force pass the filter as well, and the derivatives are those of the smoothed position: what
      is linear between them then holds, which differentiators of one stage do not keep (they take 0.5 % off the
      velocity, 6 % off the acceleration and 4 % off the force of the paper's perturbations). Without it position and
      force stay as measured, with noise that is white. The command always stays.
    - `cutoff` [Hz] and `order` of the Savitzky-Golay filter, see `savitzky_golay_half_length`. None for what a later
      step filters itself: nothing is smoothed, and a derivative that was not measured is NaN.

    **Returns:** the perturbed trials, the unperturbed ones (or None), and notes in plain words: what the sensors
    allow (`judge_sensors`), what is missing, what reading the files changed.

    **Raises:** `ValueError` that names the trial, the cause and the remedy: no recording of a hand, another sample
    rate, no command, gaps, too little before or after the onset, movements whose perturbations do not span the plane.
    (Of postures, what estimates from them asks for that.)

    **Source:** Börner et al. 2020, 2.3.2 and 2.4.1.
    """
    require_float64()
    if task not in TASKS:
        raise ValueError(f"task is '{task}': {nearest(task, list(TASKS))}")
    moving = task == "movement"
    _check_kept(before, after, window if moving else 0.0)
    filters = _Filters(_check_recordings(recordings, geometry), cutoff, order, smooth and cutoff is not None)
    trials = _trials(recordings, filters, handle, onset, moving)
    if not moving:
        kept = _common_length(trials, (filters.half / filters.rate, MARGIN), before, after)
        return _cut(trials, kept, filters.alike), None, _reading_notes(trials)
    if not any(trial.perturbed for trial in trials):
        raise ValueError("no trial is perturbed: all commands stay at zero; map the perturbing force as the command")
    _align(trials, trigger)
    kept = _common_length(trials, (HISTORY, window + MARGIN), before, after)
    pushed, free = ([trial for trial in trials if trial.perturbed is wanted] for wanted in (True, False))
    check_directions(_pushes(pushed, max(2, round(window * filters.rate))), f"{len(pushed)} perturbed trials")
    measured = [_cut(group, kept, False) if group else None for group in (pushed, free)]
    read = [_cut(group, kept, True) if group else None for group in (pushed, free)] if filters.alike else measured
    perturbed, unperturbed = read
    assert measured[0] is not None
    assert perturbed is not None
    notes = _notes(trials, window)
    if cutoff is not None:
        noise = judge_sensors(measured[0], measured[1], window, trials[0].source, cutoff, order)
        notes = (*noise.in_words(), *notes)
    return perturbed, unperturbed, notes


# --- which trials are perturbed, and when -----------------------------------------------------------------------------


def _trials(
    recordings: Sequence[Recording],
    filters: _Filters,
    handle: Handle | None,
    onset: float | Sequence[float] | None,
    moving: bool,
) -> list[_Trial]:
    """Each with the sample of its onset, None where it is unperturbed."""
    given = _given_onsets(onset, len(recordings))
    commands = [recording.command for recording in recordings if moving and recording.command is not None]
    largest = max((float(np.nanmax(np.abs(command))) for command in commands), default=0.0)
    trials = []
    for k, (recording, at) in enumerate(zip(recordings, given, strict=True)):
        name = trial_name(k, recording)
        if moving:
            first = _onset_of_movement(name, recording, at, largest, onset)
        else:
            first = _onset_of_posture(name, recording) if np.isnan(at) else _sample(recording, at)
        trials.append(_Trial(name, recording, first, filters, handle, at_rest=not moving))
    return trials


def _onset_of_movement(
    name: str, recording: Recording, at: float, largest: float, onset: float | Sequence[float] | None
) -> int | None:
    if recording.command is None:
        if onset is None:
            raise ValueError(
                f"{name}: whether it is perturbed, when and in which direction is not known: map the perturbing "
                "force as the command (two columns, in N), or pass onset= (NaN for unperturbed trials)"
            )
        return None if np.isnan(at) else _sample(recording, at)
    if not starts_at_rest(recording.command, largest):
        raise ValueError(
            f"{name}: its command is not at rest when the recording begins; record at least {HISTORY:g} s before the "
            "onset, or leave it out"
        )
    first = find_onset(recording.command, SILENT * largest)
    if first is None and isinstance(onset, Sequence) and not np.isnan(at):
        raise ValueError(f"{name} has an onset, but its command stays at zero: correct one of them")
    return first if first is None or np.isnan(at) else _sample(recording, at)


def _onset_of_posture(name: str, recording: Recording) -> int:
    """By the commanded force, or without one by the position that the handle was asked to follow."""
    signal = recording.reference if recording.command is None else recording.command
    if signal is None:
        raise ValueError(
            f"{name}: its onset is not known: pass onset=, or map the commanded force as the command, or the commanded "
            "position as the reference"
        )
    first = find_onset(signal)
    if first is None:
        raise ValueError(f"{name}: no perturbation was found in its command: leave it out, or pass onset=")
    return first


def _given_onsets(onset: float | Sequence[float] | None, trials: int) -> Numbers:
    given = np.asarray(np.nan if onset is None else onset, float)
    if given.shape not in ((), (trials,)):
        raise ValueError(f"onset has {given.size} numbers for {trials} trials: give one, or one for each")
    return np.broadcast_to(given, trials)


def _sample(recording: Recording, at: float) -> int:
    return round((at - recording.time[0]) * recording.sample_rate)


def _align(trials: list[_Trial], trigger: tuple[int, float] | None) -> None:
    """Give unperturbed trials the sample at which the hand passes the place where the others were perturbed."""
    pushed = [trial for trial in trials if trial.perturbed]
    if trigger is not None:
        axis, place = trigger
        if axis not in (0, 1):
            raise ValueError(f"trigger is on axis {axis}: the axes of the hand are 0 and 1")
        direction = np.eye(2)[axis]
    else:
        direction = _direction(pushed)
        place = float(np.median([direction @ trial.position[min(trial.onset, len(trial) - 1)] for trial in pushed]))
    for trial in trials:
        if trial.perturbed:
            continue
        along = trial.position @ direction
        begun = along[np.argmax(np.isfinite(along))]
        # An explicit place may be approached from either side.
        side = 1.0 if trigger is None else np.sign(place - begun)
        reached = side * (along - place) >= 0
        passed = reached & ~np.append(False, reached[:-1])
        passed[0] = False
        if not passed.any():
            raise ValueError(
                f"{trial.name} is unperturbed and never passes {_in_words(direction, place)}, where perturbations "
                "begin: leave it out, or give the trigger"
            )
        trial.onset = int(np.argmax(passed))


def _direction(pushed: list[_Trial]) -> Numbers:
    """Unit vector (2,) in which the hands moved just before they were perturbed."""
    ways = []
    for trial in pushed:
        last = min(max(trial.onset, 0), len(trial) - 1)
        ways.append(trial.position[last] - trial.position[max(0, last - round(APPROACH * trial.filters.rate))])
    way = np.mean(ways, axis=0)
    return np.asarray(way / max(float(np.linalg.norm(way)), 1e-12))


def _in_words(direction: Numbers, place: float) -> str:
    axis = int(np.argmax(np.abs(direction)))
    if abs(direction[axis]) > 0.999:
        return f"{place * np.sign(direction[axis]):.4g} m on axis {axis + 1}"
    return f"{place:.4g} m along ({direction[0]:.2g}, {direction[1]:.2g})"


def _pushes(trials: list[_Trial], samples: int) -> Numbers:
    """(T, 2) largest commands soon after the onset [N]; where none is known, the largest changes of the force."""
    peaks = []
    for trial in trials:
        part = slice(trial.onset, trial.onset + samples)
        known = np.isfinite(trial.command[part]).all()
        push = trial.command[part] if known else trial.force[part] - trial.force[trial.onset]
        peaks.append(farthest(push[None])[0])
    return np.array(peaks)


# --- from a recording to a trial --------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Filters:
    rate: float
    cutoff: float | None
    """None: there are none."""
    order: int
    alike: bool
    """Position and force are smoothed, and the derivatives are those of the smoothed position."""

    @property
    def half(self) -> int:
        """Samples that the filters reach to either side."""
        if self.cutoff is None:
            return 0
        beyond = savitzky_golay_half_length(self.rate, WIDER * self.cutoff, self.order) if self.alike else 0
        return savitzky_golay_half_length(self.rate, self.cutoff, self.order) + beyond

    def smooth(self, x: Numbers) -> Numbers:
        return self._savitzky_golay(x, 0, 1.0)

    def derivative(self, x: Numbers, derivative: int) -> Numbers:
        if self.alike:
            return self._savitzky_golay(self.smooth(x), derivative, WIDER)
        return self._savitzky_golay(x, derivative, 1.0)

    def _savitzky_golay(self, x: Numbers, derivative: int, wider: float) -> Numbers:
        if self.cutoff is None:
            return np.full_like(x, np.nan)
        return np.asarray(savitzky_golay(x, self.rate, derivative, wider * self.cutoff, self.order))


class _Trial:
    """One recording with its derivatives; all arrays are (N, 2), and gaps are bridged by straight lines."""

    def __init__(
        self,
        name: str,
        recording: Recording,
        onset: int | None,
        filters: _Filters,
        handle: Handle | None,
        at_rest: bool = False,
    ):
        self.name, self.recording, self.filters = name, recording, filters
        self.perturbed = onset is not None
        self.onset = -1 if onset is None else onset
        """Of an unperturbed trial it is known when all have been read."""
        if len(recording) < 2 * filters.half + 1:
            raise ValueError(
                f"{name} has {len(recording)} samples, but the filter of {filters.cutoff or 0:g} Hz takes "
                f"{2 * filters.half + 1}: leave it out"
            )
        self.position, self.force = self._bridged(recording.position), self._bridged(recording.torque)
        self.source, self.velocity, self.acceleration = self._derived()
        self.usable = widen_gaps(recording.valid, filters.half)
        """(N,) True where the filter saw measured samples only."""
        self.command = self._commanded(handle, at_rest)

    def __len__(self) -> int:
        return len(self.recording)

    def _bridged(self, x: Numbers) -> Numbers:
        return fill_gaps(x, self.recording.valid)

    def _derived(self) -> tuple[str, Numbers, Numbers]:
        """What was measured of the highest order, velocity [m/s] and acceleration [m/s^2] from it."""
        velocity, acceleration = self.recording.velocity, self.recording.acceleration
        filters = self.filters
        source = "position" if velocity is None else "velocity"
        of_position = filters.derivative(self.position, 1)
        known = (self.position, 2) if velocity is None else (self._bridged(velocity), 1)
        of_velocity = filters.derivative(*known)
        return (
            source if acceleration is None else "acceleration",
            of_position if velocity is None else self._bridged(velocity),
            of_velocity if acceleration is None else self._bridged(acceleration),
        )

    def _commanded(self, handle: Handle | None, at_rest: bool) -> Numbers:
        """Perturbing force [N]: as recorded, or what the handle must have been commanded, eq. (25)."""
        if self.recording.command is not None:
            return self._bridged(self.recording.command)
        if at_rest or not self.perturbed:
            return np.zeros_like(self.position)
        if handle is None:
            return np.full_like(self.position, np.nan)
        without = handle.force(np.zeros_like(self.position), self.velocity, self.acceleration)
        command = self.filters.smooth(self.force) - np.asarray(without)
        command[: max(0, self.onset)] = 0.0
        return np.asarray(command)

    def signals(self, part: slice, smooth: bool) -> tuple[Numbers, ...]:
        """The arrays of `Trials`."""
        position, velocity, acceleration, force = self.position, self.velocity, self.acceleration, self.force
        if smooth:
            smoothed = self.filters.smooth
            position, force = smoothed(position), smoothed(force)
            velocity = velocity if self.recording.velocity is None else smoothed(velocity)
            acceleration = acceleration if self.recording.acceleration is None else smoothed(acceleration)
        return tuple(x[part] for x in (position, velocity, acceleration, force, self.command))


def _cut(trials: list[_Trial], kept: tuple[int, int], smooth: bool) -> Trials:
    before, after = kept
    parts = [trial.signals(slice(trial.onset - before, trial.onset + after), smooth) for trial in trials]
    x, v, a, force, command = (jnp.asarray(np.stack(column)) for column in zip(*parts, strict=True))
    onset = jnp.full(len(trials), before, jnp.int32)
    return Trials(x, v, a, force, command, onset, trials[0].filters.rate)


def _common_length(
    trials: list[_Trial], least: tuple[float, float], before: float | None, after: float | None
) -> tuple[int, int]:
    """Samples before the onset and from it on that every trial has, unless they are given [s]."""
    rate = trials[0].filters.rate
    needed = [
        round((low if given is None else given) * rate) for low, given in zip(least, (before, after), strict=True)
    ]
    longest = []
    for trial in trials:
        gaps = np.flatnonzero(~trial.usable)
        gaps = np.r_[-1, gaps, len(trial)]
        next_gap = int(np.searchsorted(gaps, trial.onset, side="right"))
        room = (trial.onset - int(gaps[next_gap - 1]) - 1, int(gaps[min(next_gap, len(gaps) - 1)]) - trial.onset)
        if room[0] < needed[0] or room[1] < needed[1]:
            raise ValueError(_too_short(trial, needed))
        longest.append(room)
    most = [min(room) for room in zip(*longest, strict=True)]
    return (
        most[0] if before is None else needed[0],
        most[1] if after is None else needed[1],
    )


def _too_short(trial: _Trial, needed: list[int]) -> str:
    rate, time, half = trial.filters.rate, trial.recording.time, trial.filters.half
    for_filters = f", and {half / rate:.2g} s more for the filters" if half else ""
    begins = time[0] + trial.onset / rate
    what = "perturbation begins" if trial.perturbed else "hand passes the place of perturbations"
    wanted = f"{needed[0] / rate:.3g} s before that and {needed[1] / rate:.3g} s after it"
    first, last = trial.onset - needed[0] - half, trial.onset + needed[1] + half
    if first >= 0 and last <= len(trial):
        missing = np.flatnonzero(~trial.recording.valid[first:last])
        return (
            f"{trial.name} has a gap at {time[first + missing[0]]:.4g} s, and its {what} at {begins:.4g} s: {wanted} "
            f"are needed without one{for_filters}; leave it out"
        )
    return (
        f"{trial.name} lasts from {time[0]:.4g} to {time[-1]:.4g} s, and its {what} at {begins:.4g} s: {wanted} are "
        f"needed{for_filters}; record longer, ask for less, or leave it out"
    )


# --- what is checked and said -----------------------------------------------------------------------------------------


def trial_name(k: int, recording: Recording) -> str:
    """How messages call the k-th trial."""
    return f"trial {k + 1} ({recording.name})" if recording.name else f"trial {k + 1}"


def check_hand(name: str, recording: Recording, rate: float) -> None:
    """**Raises:** `ValueError` if this is no recording of a hand in a plane at the sample rate [Hz]."""
    if recording.joints != ("prismatic", "prismatic"):
        raise ValueError(
            f"{name} is not a recording of a hand in a plane: load it with joint='prismatic', two columns of the "
            "position and two of the force"
        )
    if abs(recording.sample_rate - rate) > 1e-3 * rate:
        raise ValueError(
            f"{name} was sampled at {recording.sample_rate:g} Hz and trial 1 at {rate:g} Hz: resample one of them"
        )


def _check_recordings(recordings: Sequence[Recording], geometry: ArmGeometry | None) -> float:
    """The sample rate [Hz] of all of them."""
    if not recordings:
        raise ValueError("there are no trials: give at least one recording")
    rate = recordings[0].sample_rate
    for k, recording in enumerate(recordings):
        name = trial_name(k, recording)
        check_hand(name, recording, rate)
        if recording.torque.shape != recording.position.shape:
            raise ValueError(
                f"{name}: position and force have different time bases, {len(recording.position)} and "
                f"{len(recording.torque)} samples: resample the force at the times of the position"
            )
        if geometry is None:
            continue
        try:
            geometry.inverse(recording.position)
        except ValueError as error:
            raise ValueError(
                f"{name}: {error}: state the unit of the position (mm?), or correct the arm's lengths and shoulder"
            ) from None
    return rate


def _check_kept(before: float | None, after: float | None, window: float) -> None:
    if not 0 <= window < np.inf:
        raise ValueError(f"window is {window:g} s: it must be zero or more")
    least = (HISTORY, window + MARGIN) if window else (0.0, 0.0)
    for name, given, low in zip(("before", "after"), (before, after), least, strict=True):
        if given is not None and not low <= given < np.inf:
            raise ValueError(f"{name} is {given:g} s: at least {low:.3g} s are needed")


def _notes(trials: list[_Trial], window: float) -> tuple[str, ...]:
    """What the user should know, in plain words."""
    notes = []
    if too_long := window_warning(window):
        notes.append(too_long)
    if all(trial.perturbed for trial in trials):
        notes.append(
            "no trial is unperturbed: what the perturbations change is not known by comparison; record unperturbed "
            "movements, or use a method that does without"
        )
    if any(trial.perturbed and not np.isfinite(trial.command).all() for trial in trials):
        notes.append("the commands are not known (no command, no handle): methods that simulate cannot be used")
    return (*notes, *_reading_notes(trials))


def _reading_notes(trials: list[_Trial]) -> tuple[str, ...]:
    """What reading the files changed: each note once."""
    counts = Counter(note for trial in trials for note in trial.recording.notes)
    return tuple(f"{note} ({count} {'trial' if count == 1 else 'trials'})" for note, count in counts.items())
