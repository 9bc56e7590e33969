"""What the sensors of perturbed trials allow, and whether force, command and handle agree."""

from __future__ import annotations

from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np

from jaximp.perturbation.trials import VOLUNTARY_DELAY, Handle, Trials
from jaximp.signals.derivatives import savitzky_golay, savitzky_golay_gain
from jaximp.signals.filters import butterworth, filter_zero_phase
from jaximp.signals.samples import noise_level, quantisation_step
from jaximp.types import Numbers

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


def judge_sensors(
    perturbed: Trials,
    unperturbed: Trials | None,
    window: float = VOLUNTARY_DELAY,
    source: str = "position",
    cutoff: float = 50.0,
    order: int = 7,
) -> SensorNoise:
    """White noise of the position, through the differentiator, against what the perturbations make.

    **Arguments:** trials **as measured** (`smooth=False`), and the `window` [s] after the onset that is judged;
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


def handle_disagreement(perturbed: Trials, handle: Handle | None) -> tuple[float, str]:
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
