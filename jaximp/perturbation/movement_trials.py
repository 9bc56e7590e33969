"""From recordings of a hand that was perturbed, in some of its trials, to movements that begin at one sample.

A trial is perturbed where its `command`, the perturbing force, leaves zero; that is its onset. An unperturbed trial
belongs where the hand passes the place at which the others were perturbed. Derivatives are those of Savitzky-Golay
filters, as in Börner et al. 2020, 2.4.1.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np

from jaximp.models.kinematics import ArmGeometry
from jaximp.numerics.precision import require_float64
from jaximp.perturbation.movements import HISTORY, VOLUNTARY_DELAY, Handle, Movements
from jaximp.signals.derivatives import savitzky_golay, savitzky_golay_gain, savitzky_golay_half_length
from jaximp.signals.filters import butterworth, filter_zero_phase
from jaximp.signals.samples import fill_gaps, noise_level, quantisation_step, widen_gaps
from jaximp.types import Numbers, Recording

NOISE = 6.0
"""A command has left its steady state where it differs from it by so many standard deviations of its own noise."""
LEADING = 0.05
"""Share of a recording in which the command is steady for certain."""
SILENT = 0.01
"""A command that stays below such a share of the largest one of all trials is none."""
FLAT = 0.05
"""Smallest over largest singular value of the perturbations from which on they span the plane."""
MARGIN = 0.05
"""What every movement must have after its window [s], for the filters of what comes next."""
APPROACH = 0.1
"""The hand's way in so many seconds before the onset is the direction of the movement."""
WIDER = 2.0
"""Cut-off of the differentiator over that of the smoothing before it: the smoothing decides. (It leaves 99.1 % of the
acceleration at 40 Hz, with 1.3 times the noise of a differentiator of one stage, and 1.4 times in the jerk.)"""
SLOW = 10.0
"""Up to which force, command and motion are compared [Hz]."""
LOUD = 0.1
"""Noise of such a share of what the perturbations make of a derivative spoils what needs it: a choice."""


@dataclass(frozen=True)
class SensorNoise:
    """White noise of the sensors, and its share of what the perturbations make (root mean squares in the window)."""

    source: str
    """What is differentiated: `position`, `velocity` or `acceleration`."""
    level: float
    """Its standard deviation, in m and s."""
    step: float
    """Step of the encoder [m], or zero where none can be seen."""
    force: float
    """Standard deviation of the noise of the force [N]."""
    share_of_acceleration: float
    share_of_jerk: float
    share_of_force: float

    def in_words(self) -> tuple[str, ...]:
        """One line for each of jerk, acceleration and force that noise spoils; or one that says that there is none."""
        unit = {"position": "m", "velocity": "m/s", "acceleration": "m/s^2"}[self.source]
        level = f"{1e6 * self.level:.3g} um" if unit == "m" else f"{self.level:.2g} {unit}"
        steps = f" (an encoder in steps of {1e6 * self.step:.3g} um)" if self.step else ""
        noise = f"the {self.source}'s noise of {level}{steps} makes"
        jerk = f"{noise} {{}} of the perturbations' jerk: feedback jerk isolation will not work; use output error"
        acceleration = f"{noise} {{}} of their acceleration: estimates from it are biased; use output error"
        force = (
            f"the force's noise of {self.force:.2g} N is {{}} of what they change it by: perturb harder, or more often"
        )
        shares = ((self.share_of_jerk, jerk), (self.share_of_acceleration, acceleration), (self.share_of_force, force))
        words = tuple(text.format(_percent(share)) for share, text in shares if share > LOUD)
        return words or (f"{noise} {_percent(self.share_of_jerk)} of the jerk of the perturbations: little enough",)


def _percent(share: float) -> str:
    return f"{100 * share:.2g} %" if share < 1 else "all"


def read_movements(
    recordings: Sequence[Recording],
    *,
    window: float = VOLUNTARY_DELAY,
    onset: float | Sequence[float] | None = None,
    trigger: tuple[int, float] | None = None,
    before: float | None = None,
    after: float | None = None,
    handle: Handle | None = None,
    geometry: ArmGeometry | None = None,
    smooth: bool = True,
    cutoff: float = 50.0,
    order: int = 7,
) -> tuple[Movements, Movements | None, tuple[str, ...]]:
    """Movements of one length, cut so that all perturbations begin at the same sample, from one recording each.

    **Arguments:**

    - `recordings` of the hand: joints `("prismatic", "prismatic")`, position [m], `torque` for the force on it [N],
      and as `command` the perturbing force [N], zero throughout unperturbed trials. Velocity and acceleration serve
      where they were measured.
    - `window` [s] after the onset from which impedance is to be estimated.
    - `onset` [s] in each recording's own time, NaN for an unperturbed one; without it, it is found in the command.
      Needed without a command, which then follows from the `handle` (or is NaN).
    - `trigger`: axis (0 or 1) and position [m] on it at which unperturbed trials are aligned; without it, the median
      place of the hand at the onset, along the direction in which it moved there.
    - `before` and `after` [s] are kept around the onset; without them, as much as every trial has.
    - `geometry` of the arm: positions out of its reach are refused.
    - `smooth`: position and force pass the filter as well, and the derivatives are those of the smoothed position: what
      is linear between them then holds, which differentiators of one stage do not keep (they take 0.5 % off the
      velocity, 6 % off the acceleration and 4 % off the force of the paper's perturbations). Without it position and
      force stay as measured, with noise that is white. The command always stays.
    - `cutoff` [Hz] and `order` of the Savitzky-Golay filter, see `savitzky_golay_half_length`.

    **Returns:** the perturbed movements, the unperturbed ones (or None), and notes in plain words: what the sensors
    allow (`judge_sensors`), what is missing, what reading the files changed.

    **Raises:** `ValueError` that names the trial, the cause and the remedy: no recording of a hand, another sample
    rate, no command, gaps, too little before or after the onset, perturbations that do not span the plane.

    **Source:** Börner et al. 2020, 2.3.2 and 2.4.1.
    """
    require_float64()
    _check_kept(before, after, window)
    rate = _check_recordings(recordings, geometry)
    names = [trial_name(k, recording) for k, recording in enumerate(recordings)]
    found = _onsets(names, recordings, onset)
    filters = _Filters(rate, cutoff, order, smooth)
    trials = [_Trial(*x, filters, handle) for x in zip(names, recordings, found, strict=True)]
    if not any(trial.perturbed for trial in trials):
        raise ValueError("no trial is perturbed: all commands stay at zero; map the perturbing force as the command")
    _align(trials, trigger)
    kept = _common_length(trials, (HISTORY, window + MARGIN), before, after)
    groups = [[trial for trial in trials if trial.perturbed is wanted] for wanted in (True, False)]
    check_directions(_pushes(groups[0], max(2, round(window * rate))), f"{len(groups[0])} perturbed trials")
    measured = [_movements(group, kept, False) for group in groups]
    assert measured[0] is not None
    noise = judge_sensors(measured[0], measured[1], window, trials[0].source, cutoff, order)
    push, free = [_movements(group, kept, True) for group in groups] if smooth else measured
    assert push is not None
    return push, free, (*noise.in_words(), *_notes(trials, window))


def read_postures(
    recordings: Sequence[Recording],
    *,
    onset: float | Sequence[float] | None = None,
    before: float | None = None,
    after: float | None = None,
    geometry: ArmGeometry | None = None,
    smooth: bool = True,
    cutoff: float = 50.0,
    order: int = 7,
) -> tuple[Movements, tuple[str, ...]]:
    """Trials of a hand that keeps a posture and is moved out of it, as movements: the static task.

    **Arguments:** as in `read_movements`; every trial is perturbed, and its onset may also stand in the `reference`,
    the position [m] that the handle was asked to follow. Where no force was commanded, the command is zero.

    **Raises:** as `read_movements`.
    """
    require_float64()
    _check_kept(before, after, 0.0)
    rate = _check_recordings(recordings, geometry)
    names = [trial_name(k, recording) for k, recording in enumerate(recordings)]
    given = _given_onsets(onset, len(recordings))
    filters = _Filters(rate, cutoff, order, smooth)
    trials = []
    for name, recording, at in zip(names, recordings, given, strict=True):
        first = find_onset(name, recording) if np.isnan(at) else _sample(recording, at)
        trials.append(_Trial(name, recording, first, filters, None, at_rest=True))
    kept = _common_length(trials, (filters.half / rate, MARGIN), before, after)
    postures = _movements(trials, kept, smooth)
    assert postures is not None
    x, first = np.asarray(postures.position), kept[0]
    check_directions(_farthest(x[:, first:] - x[:, first : first + 1]), f"{len(trials)} trials")
    return postures, _reading_notes(trials)


def judge_sensors(
    perturbed: Movements,
    unperturbed: Movements | None,
    window: float = VOLUNTARY_DELAY,
    source: str = "position",
    cutoff: float = 50.0,
    order: int = 7,
) -> SensorNoise:
    """White noise of the position, through the differentiator, against what the perturbations make.

    **Arguments:** movements **as measured** (`smooth=False`), and the `window` [s] after the onset that is judged;
    `source` is what was measured and differentiated: `position`, `velocity` or `acceleration`; `cutoff` [Hz] and
    `order` of the Savitzky-Golay filter.

    What the perturbations make is the difference from the mean unperturbed movement, or without one, from the value at
    the onset. An encoder in steps that the hand takes several samples to cross makes noise that is not white, and up to
    twice as much of the jerk.
    """
    measured = {"position": 0, "velocity": 1, "acceleration": 2}[source]
    groups = [group for group in (perturbed, unperturbed) if group is not None]
    rate = perturbed.sample_rate
    series = np.concatenate([np.asarray(getattr(group, source)) for group in groups])
    force = np.concatenate([np.asarray(group.force) for group in groups])
    first = int(np.asarray(perturbed.onset)[0])
    inside = slice(first, first + max(1, round(window * rate)))

    def share(x: Numbers, noise: float) -> float:
        """`noise` over the root mean square of what the perturbations make of x."""
        pushed, free = x[: len(perturbed)], x[len(perturbed) :]
        away = pushed[:, inside] - (free[:, inside].mean(axis=0) if len(free) else pushed[:, first : first + 1])
        made = (away**2).mean() - noise**2 * (1 + 1 / max(1, len(free)))
        return float(noise / np.sqrt(made)) if made > noise**2 else 1.0

    def derived(derivative: int) -> float:
        along = np.moveaxis(series, 1, 0)
        x = np.moveaxis(savitzky_golay(along, rate, derivative - measured, cutoff, order), 0, 1)
        return share(x, level * savitzky_golay_gain(rate, derivative - measured, cutoff, order))

    level, loudness = _noise(series), _noise(force)
    step = max(quantisation_step(x) for x in np.moveaxis(series, -1, 1).reshape(-1, series.shape[1]))
    return SensorNoise(source, level, step if measured == 0 else 0.0, loudness,
                       derived(2), derived(3), share(force, loudness))  # fmt: skip


def _noise(x: Numbers) -> float:
    """Standard deviation of the white noise of (T, N, 2), over all trials and both axes."""
    return float(np.sqrt(np.mean([noise_level(row) ** 2 for row in np.moveaxis(x, -1, 1).reshape(-1, x.shape[1])])))


# --- which trials are perturbed, and when -----------------------------------------------------------------------------


def find_onset(name: str, recording: Recording) -> int:
    """Index of the last sample at which the commanded force (or position, in `reference`) is still what it was at the
    beginning, within the noise that it has there."""
    command = recording.reference if recording.command is None else recording.command
    if command is None:
        raise ValueError(
            f"{name}: its onset is not known: pass onset=, or map the commanded force as the command, or the commanded "
            "position as the reference"
        )
    first = _onset_of(command)
    if first is None:
        raise ValueError(f"{name}: no perturbation was found in its command: leave it out, or pass onset=")
    return first


def _onset_of(command: Numbers, least: float = 0.0) -> int | None:
    """Where a command (N, n) begins to differ from its beginning, by more than its noise and `least`; None: nowhere."""
    leading = _leading(command)
    away = np.abs(command - leading.mean(axis=0)).max(axis=1)
    left = away > max(NOISE * float(leading.std(axis=0).max()), 1e-9 * float(np.nanmax(away)))
    # One sample beyond may be a spike: the command stays away for a while.
    left = left & np.append(left[1:], False) & np.append(left[2:], [False, False])
    if not left.any() or not np.nanmax(away) > least:
        return None
    return max(0, int(np.argmax(left)) - 1)


def _leading(command: Numbers) -> Numbers:
    """What was measured of a command first, while it is steady for certain."""
    measured = command[np.isfinite(command).all(axis=1)]
    return measured[: max(10, round(LEADING * len(command)))]


def _onsets(
    names: list[str], recordings: Sequence[Recording], onset: float | Sequence[float] | None
) -> list[int | None]:
    """Sample of each trial's onset, None where it is unperturbed."""
    given = _given_onsets(onset, len(recordings))
    largest = max((float(np.nanmax(np.abs(r.command))) for r in recordings if r.command is not None), default=0.0)
    onsets: list[int | None] = []
    for name, recording, at in zip(names, recordings, given, strict=True):
        if recording.command is None:
            if onset is None:
                raise ValueError(
                    f"{name}: whether it is perturbed, when and in which direction is not known: map the perturbing "
                    "force as the command (two columns, in N), or pass onset= (NaN for unperturbed trials)"
                )
            onsets.append(None if np.isnan(at) else _sample(recording, at))
            continue
        _check_beginning(name, recording.command, largest)
        first = _onset_of(recording.command, SILENT * largest)
        if first is None and isinstance(onset, Sequence) and not np.isnan(at):
            raise ValueError(f"{name} has an onset, but its command stays at zero: correct one of them")
        onsets.append(first if first is None or np.isnan(at) else _sample(recording, at))
    return onsets


def _given_onsets(onset: float | Sequence[float] | None, trials: int) -> Numbers:
    given = np.asarray(np.nan if onset is None else onset, float)
    if given.shape not in ((), (trials,)):
        raise ValueError(f"onset has {given.size} numbers for {trials} trials: give one, or one for each")
    return np.broadcast_to(given, trials)


def _sample(recording: Recording, at: float) -> int:
    return round((at - recording.time[0]) * recording.sample_rate)


def _check_beginning(name: str, command: Numbers, largest: float) -> None:
    """A command that has begun when the recording does would pass for its own steady state."""
    if np.abs(_leading(command) - np.nanmedian(command, axis=0)).max() > 0.1 * largest > 0:
        raise ValueError(
            f"{name}: its command is not at rest when the recording begins; record at least {HISTORY:g} s before the "
            "onset, or leave it out"
        )


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


def check_directions(peaks: Numbers, which: str) -> None:
    """Perturbations (T, 2) along one line tell nothing of the stiffness across it."""
    singular = np.linalg.svd(peaks, compute_uv=False)
    if len(peaks) > 1 and singular[-1] > FLAT * singular[0]:
        return
    along = peaks @ np.linalg.svd(peaks)[2][0]
    how = "all the same" if (along > 0).all() or (along < 0).all() else "all along one line"
    raise ValueError(
        f"the directions of {which} are {how} and do not span the plane of the two joints: perturb in at least two "
        "directions"
    )


def _pushes(trials: list[_Trial], samples: int) -> Numbers:
    """(T, 2) largest commands soon after the onset [N]; where none is known, the largest changes of the force."""
    peaks = []
    for trial in trials:
        part = slice(trial.onset, trial.onset + samples)
        known = np.isfinite(trial.command[part]).all()
        push = trial.command[part] if known else trial.force[part] - trial.force[trial.onset]
        peaks.append(_farthest(push[None])[0])
    return np.array(peaks)


def _farthest(x: Numbers) -> Numbers:
    """(T, 2) of (T, N, 2): where each is farthest from zero."""
    return x[np.arange(len(x)), (x**2).sum(axis=-1).argmax(axis=1)]


# --- from a recording to a movement -----------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Filters:
    rate: float
    cutoff: float
    order: int
    alike: bool
    """Position and force are smoothed, and the derivatives are those of the smoothed position."""

    @property
    def half(self) -> int:
        """Samples that the filters reach to either side."""
        beyond = savitzky_golay_half_length(self.rate, WIDER * self.cutoff, self.order) if self.alike else 0
        return savitzky_golay_half_length(self.rate, self.cutoff, self.order) + beyond

    def smooth(self, x: Numbers) -> Numbers:
        return np.asarray(savitzky_golay(x, self.rate, 0, self.cutoff, self.order))

    def derivative(self, x: Numbers, derivative: int) -> Numbers:
        if not self.alike:
            return np.asarray(savitzky_golay(x, self.rate, derivative, self.cutoff, self.order))
        return np.asarray(savitzky_golay(self.smooth(x), self.rate, derivative, WIDER * self.cutoff, self.order))


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
                f"{name} has {len(recording)} samples, but the filter of {filters.cutoff:g} Hz takes "
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

    def movement(self, part: slice, smooth: bool) -> tuple[Numbers, ...]:
        """The arrays of `Movements`."""
        position, velocity, acceleration, force = self.position, self.velocity, self.acceleration, self.force
        if smooth:
            smoothed = self.filters.smooth
            position, force = smoothed(position), smoothed(force)
            velocity = velocity if self.recording.velocity is None else smoothed(velocity)
            acceleration = acceleration if self.recording.acceleration is None else smoothed(acceleration)
        return tuple(x[part] for x in (position, velocity, acceleration, force, self.command))


def _movements(trials: list[_Trial], kept: tuple[int, int], smooth: bool) -> Movements | None:
    if not trials:
        return None
    before, after = kept
    parts = [trial.movement(slice(trial.onset - before, trial.onset + after), smooth) for trial in trials]
    x, v, a, force, command = (jnp.asarray(np.stack(column)) for column in zip(*parts, strict=True))
    onset = jnp.full(len(trials), before, jnp.int32)
    return Movements(x, v, a, force, command, onset, trials[0].filters.rate)


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
    begins = time[0] + trial.onset / rate
    what = "perturbation begins" if trial.perturbed else "hand passes the place of perturbations"
    wanted = f"{needed[0] / rate:.3g} s before that and {needed[1] / rate:.3g} s after it"
    first, last = trial.onset - needed[0] - half, trial.onset + needed[1] + half
    if first >= 0 and last <= len(trial):
        missing = np.flatnonzero(~trial.recording.valid[first:last])
        return (
            f"{trial.name} has a gap at {time[first + missing[0]]:.4g} s, and its {what} at {begins:.4g} s: {wanted} "
            f"are needed without one, and {half / rate:.2g} s more for the filters; leave it out"
        )
    return (
        f"{trial.name} lasts from {time[0]:.4g} to {time[-1]:.4g} s, and its {what} at {begins:.4g} s: {wanted} are "
        f"needed, and {half / rate:.2g} s more for the filters; record longer, ask for less, or leave it out"
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


def window_warning(window: float) -> str:
    """What is to be said of a window [s] that is longer than a subject needs to answer; empty of others."""
    if window <= VOLUNTARY_DELAY + 1e-9:
        return ""
    return (
        f"the window of {1e3 * window:.4g} ms is longer than the voluntary delay of {1e3 * VOLUNTARY_DELAY:g} ms: "
        "the estimates are those of an arm that may already answer at will"
    )


def handle_disagreement(perturbed: Movements, handle: Handle | None) -> tuple[float, str]:
    """Share by which the recorded force differs from the one that handle and command make, apart from an offset, and
    what to do about it.

    The recordings themselves tell the mass and the damping, since `command - force = mass a + damping v` (eq. (25) of
    Börner et al. 2020): at low frequencies, which all filters leave alone.
    """
    if handle is None or not np.isfinite(np.asarray(perturbed.command)).all():
        return 0.0, ""
    slow = butterworth(2, SLOW, perturbed.sample_rate)
    signals = (perturbed.velocity, perturbed.acceleration, perturbed.force, perturbed.command)
    v, a, force, command = (np.asarray(filter_zero_phase(slow, jnp.moveaxis(x, 1, 0))).reshape(-1, 2) for x in signals)
    difference = force - np.asarray(handle.force(command, v, a))
    off = _rms(difference - difference.mean(axis=0)) / _rms(force)
    columns = [np.stack([a[:, k], v[:, k], np.ones(len(a))], axis=1) for k in (0, 1)]
    seen = [np.linalg.lstsq(W, (command - force)[:, k])[0] for k, W in enumerate(columns)]
    left = np.stack([(command - force)[:, k] - W @ seen[k] for k, W in enumerate(columns)], axis=1)
    mass, damping, offset = (", ".join(f"{x:.2f}" for x in values) for values in zip(*seen, strict=True))
    explained = _rms(left) < off * _rms(force) / 3
    return off, f"the recorded force differs by {100 * off:.3g} % from what command and handle make: " + (
        f"by the recordings, the handle has a mass of {mass} kg and a damping of {damping} N s/m (and the force "
        f"an offset of {offset} N); correct [trials.handle], or the force"
        if explained
        else "no mass and damping explain it; check the sign and the unit of force and command, and whether force, "
        "command and position are of one instant"
    )


def _rms(x: Numbers) -> float:
    return float(np.sqrt((x**2).mean()))


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
