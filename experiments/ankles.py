"""Simulated recordings of a joint like an ankle: motions that are known exactly, torque noise of every kind, and joints
that do what the model does not know.

Motions are periodic over the recording and given by their spectrum, so that velocities, accelerations and whatever a
linear system makes of them are exact at any sample rate.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from jaximp.identification.filter_settings import FilterSettings
from jaximp.identification.pipeline import Pipeline, WindowSettings
from jaximp.models import HumanJoint
from jaximp.recordings import recording_from_arrays
from jaximp.types import Recording

Numbers = NDArray[np.float64]
Complex = NDArray[np.complex128]

TRUTH = {"inertia": 0.015, "damping": 0.7, "stiffness": 60.0, "offset_torque": 1.0}
"""kg m^2, N m s/rad, N m/rad, N m."""
INERTIA, DAMPING, STIFFNESS, OFFSET = TRUTH.values()
SECONDS, RATE = 60.0, 1000.0
SIZE, FASTEST = 0.05, 15.0
"""Standard deviation [rad] and highest frequency [Hz] of the motions."""
NOISE, SENSOR = 0.8, 0.2
"""Standard deviation of the torque noise [N m], and of the sensor's white noise at 1 kHz as a share of it."""


@dataclass(frozen=True)
class Motion:
    """A position that repeats itself after the recording."""

    spectrum: Complex
    """Of the position [rad], as `numpy.fft.rfft` gives it."""
    rate: float

    @property
    def samples(self) -> int:
        """An even number."""
        return 2 * (len(self.spectrum) - 1)

    def through(self, response: Callable[[Complex], Complex | float]) -> Numbers:
        """(N,) what a linear system with this response to s = 2 pi i f makes of the position."""
        s = 2j * np.pi * np.fft.rfftfreq(self.samples, 1 / self.rate)
        return np.fft.irfft(self.spectrum * response(s), self.samples)

    @property
    def position(self) -> Numbers:
        """(N,) [rad]."""
        return self.through(lambda s: 1.0)

    @property
    def velocity(self) -> Numbers:
        """(N,) [rad/s]."""
        return self.through(lambda s: s)


def impedance(s: Complex) -> Complex:
    """Of the true joint."""
    return INERTIA * s**2 + DAMPING * s + STIFFNESS


# ---- Motions: each takes a generator, times (N,) and frequencies (N / 2 + 1,), and gives a spectrum of any size.


def random_band(random: np.random.Generator, t: Numbers, f: Numbers) -> Complex:
    """Below `FASTEST`, falling with the frequency."""
    lines = random.normal(size=len(f)) + 1j * random.normal(size=len(f))
    return lines * ((f > 0.3) & (f < FASTEST)) / np.maximum(f, 1)


def multisine(random: np.random.Generator, t: Numbers, f: Numbers) -> Complex:
    """Every half hertz up to `FASTEST`, with random phases."""
    spectrum = np.zeros(len(f), complex)
    lines = np.arange(0.5, FASTEST, 0.5)
    at = np.searchsorted(f, lines - 1e-9)
    spectrum[at] = np.exp(2j * np.pi * random.random(len(lines))) / np.maximum(lines, 2)
    return spectrum


def chirp(random: np.random.Generator, t: Numbers, f: Numbers) -> Complex:
    """Between 0.5 Hz and 14.5 Hz and back, every two seconds."""
    middle, half, period = 7.5, 7.0, 2.0
    swept = half * period / (2 * np.pi) * np.sin(2 * np.pi * (t / period + random.random()))
    return np.fft.rfft(np.sin(2 * np.pi * (middle * t + swept + random.random())))


def slow_and_small(random: np.random.Generator, t: Numbers, f: Numbers) -> Complex:
    """A wide motion below 0.5 Hz, and a fast one of a fifth of its size."""
    lines = random.normal(size=len(f)) + 1j * random.normal(size=len(f))
    slow, fast = ((f > 0) & (f < 0.5)) * 1.0, ((f > 1) & (f < FASTEST)) / np.maximum(f, 1)
    return lines * (slow / np.sqrt((slow**2).sum()) + 0.2 * fast / np.sqrt((fast**2).sum()))


def steps(random: np.random.Generator, t: Numbers, f: Numbers) -> Complex:
    """Small steps every 0.3 s to random angles, with nothing left of them above `FASTEST`."""
    angles = random.normal(size=int(t[-1] / 0.3) + 1)
    return np.fft.rfft(angles[(t / 0.3).astype(int)]) * np.exp(-0.5 * (f / (FASTEST / 3)) ** 2)


def pulses(random: np.random.Generator, t: Numbers, f: Numbers) -> Complex:
    """The joint swings freely after short pulses of torque."""
    torque, at = np.zeros(len(t)), np.arange(0.2, t[-1] - 0.5, 0.5)
    at = np.round((at + 0.2 * random.random(len(at))) / t[1]).astype(int)
    torque[at] = random.normal(size=len(at))
    return np.fft.rfft(torque) * np.exp(-0.5 * (f / (FASTEST / 3)) ** 2) / impedance(2j * np.pi * f)


MOTIONS = {
    "random": random_band,
    "multisine": multisine,
    "chirp": chirp,
    "slow plus small": slow_and_small,
    "steps": steps,
    "free swing": pulses,
}


def move(random: np.random.Generator, name: str = "random", rate: float = RATE, seconds: float = SECONDS) -> Motion:
    """One of `MOTIONS`, of standard deviation `SIZE`."""
    n = 2 * round(seconds * rate / 2)
    spectrum = MOTIONS[name](random, np.arange(n) / rate, np.fft.rfftfreq(n, 1 / rate))
    spectrum[0] = spectrum[-1] = 0
    return Motion(spectrum * SIZE / np.fft.irfft(spectrum, n).std(), rate)


# ---- Noise of the torque.


def _shaped(shape: Callable[[Numbers], Numbers]) -> Callable[[np.random.Generator, Motion], Numbers]:
    """Gaussian noise whose density by frequency has this shape, and a little white noise of the sensor."""

    def noise(random: np.random.Generator, motion: Motion) -> Numbers:
        n, rate = motion.samples, motion.rate
        f = np.fft.rfftfreq(2 * n, 1 / rate)  # of twice the length: its ends do not meet
        lines = (random.normal(size=len(f)) + 1j * random.normal(size=len(f))) * np.sqrt(shape(f))
        x = np.fft.irfft(lines, 2 * n)[:n]
        return x / np.sqrt((np.abs(lines) ** 2).sum() * 2) * (2 * n) + SENSOR * white(random, motion)

    return noise


def white(random: np.random.Generator, motion: Motion) -> Numbers:
    """Of the same density at any sample rate, and of unit variance at 1 kHz."""
    return random.normal(size=motion.samples) * np.sqrt(motion.rate / 1000)


def hum(random: np.random.Generator, motion: Motion) -> Numbers:
    """50 Hz from the mains."""
    t = np.arange(motion.samples) / motion.rate
    sine = np.sqrt(2) * np.sin(2 * np.pi * (50 * t + random.random()))
    return sine + SENSOR * white(random, motion)


def in_proportion(random: np.random.Generator, motion: Motion) -> Numbers:
    """White, 30 % of the torque of the moment."""
    return 0.3 / NOISE * (motion.through(impedance) + OFFSET) * white(random, motion)


NOISES: Mapping[str, Callable[[np.random.Generator, Motion], Numbers]] = {
    "white": white,
    "pink": _shaped(lambda f: 1 / np.maximum(f, 0.05)),
    "AR(1) of 50 ms": _shaped(lambda f: 1 / (1 + (2 * np.pi * f * 0.05) ** 2)),
    "AR(1) of 500 ms": _shaped(lambda f: 1 / (1 + (2 * np.pi * f * 0.5) ** 2)),
    "slow voluntary, below 1 Hz": _shaped(lambda f: (f < 1) * 1.0),
    "hum, 50 Hz": hum,
    "tremor, 8 to 12 Hz": _shaped(lambda f: ((f > 8) & (f < 12)) * 1.0),
    "30 % of the torque": in_proportion,
}
"""In units of `NOISE`."""


# ---- Joints that do what the model does not know.


@dataclass(frozen=True)
class Wrong:
    """A joint that is not what the model says."""

    torque: Callable[[Motion], Numbers]
    """Without noise and offset."""
    culprits: tuple[str, ...]
    """Groups of `jaximp.identification.suspects.SUSPECTS`, any of which names it rightly."""


def reflex(gain: float, delay: float = 0.05, muscle: float = 0.02) -> Wrong:
    """Stretch velocity [rad/s] times a gain [N m s/rad], through delay [s] and muscle (second order)."""

    def torque(motion: Motion) -> Numbers:
        stretch = Motion(np.fft.rfft(np.maximum(motion.velocity, 0)), motion.rate)
        late = stretch.through(lambda s: gain * np.exp(-s * delay) / (1 + s * muscle) ** 2)
        return motion.through(impedance) + late

    return Wrong(torque, ("reflex",))


def cubic(share: float) -> Wrong:
    """Stiffer by a share at one standard deviation from the middle."""
    added = STIFFNESS * share / SIZE**2
    return Wrong(lambda motion: motion.through(impedance) + added * motion.position**3, ("stiffness",))


def late(seconds: float) -> Wrong:
    """The torque comes late."""
    return Wrong(lambda motion: motion.through(lambda s: impedance(s) * np.exp(-s * seconds)), ("delay", "lag"))


def amplifier(cutoff: float) -> Wrong:
    """A low-pass of first order in the torque's channel alone [Hz]."""
    response = lambda s: impedance(s) / (1 + s / (2 * np.pi * cutoff))  # noqa: E731
    return Wrong(lambda motion: motion.through(response), ("delay", "lag"))


def cuff(stiffness: float) -> Wrong:
    """The position is measured before a spring [N m/rad] that the limb hangs on."""
    response = lambda s: impedance(s) * stiffness / (impedance(s) + stiffness)  # noqa: E731
    return Wrong(lambda motion: motion.through(response), ("delay", "lag"))


def second_mode(inertia: float = 0.003, frequency: float = 12.0, damping: float = 0.1) -> Wrong:
    """Soft tissue that swings on the limb, with a frequency [Hz] and a share of critical damping."""
    w = 2 * np.pi * frequency

    def response(s: Complex) -> Complex:
        spring = inertia * (2 * damping * w * s + w**2)
        return impedance(s) + spring * inertia * s**2 / (inertia * s**2 + spring)

    return Wrong(lambda motion: motion.through(response), ("lag",))


def backlash(play: float) -> Wrong:
    """The spring follows the joint only behind a play [rad]."""

    def torque(motion: Motion) -> Numbers:
        q, follows = motion.position, np.zeros(motion.samples)
        for k in range(len(q)):
            follows[k] = min(max(follows[k - 1], q[k] - play / 2), q[k] + play / 2)
        return motion.through(lambda s: INERTIA * s**2 + DAMPING * s) + STIFFNESS * follows

    return Wrong(torque, ("play",))


def saturating(deviations: float) -> Wrong:
    """The sensor reads no more than so many standard deviations of the torque, and less and less up to there."""

    def torque(motion: Motion) -> Numbers:
        true = motion.through(impedance) + OFFSET
        most = deviations * true.std()
        return most * np.tanh(true / most) - OFFSET

    return Wrong(torque, ("sensor",))


def apart(share: float) -> Wrong:
    """The clock of the torque is fast by a share, and right in the middle of the record."""

    def torque(motion: Motion) -> Numbers:
        from scipy.interpolate import CubicSpline

        t = (np.arange(motion.samples) - motion.samples / 2) / motion.rate
        return np.asarray(CubicSpline(t, motion.through(impedance))(t * (1 + share)))

    return Wrong(torque, ("clock",))


def heavier(share: float) -> Wrong:
    """The inertia grows by a share at one standard deviation from the middle, with its centripetal torque."""

    def torque(motion: Motion) -> Numbers:
        q, dq, ddq = motion.position, motion.velocity, motion.through(lambda s: s**2)
        return motion.through(impedance) + INERTIA * share / SIZE**2 * (q**2 * ddq + q * dq**2)

    return Wrong(torque, ("inertia",))


def slipping(share: float, frequency: float) -> Wrong:
    """A marker on the skin, which follows slow motion less by a share, below some frequency [Hz]."""
    response = lambda s: impedance(s) / (1 - share / (1 + s / (2 * np.pi * frequency)))  # noqa: E731
    return Wrong(lambda motion: motion.through(response), ("lag",))


def relaxing(share: float, seconds: float) -> Wrong:
    """Fast motion meets a further share of the stiffness, which relaxes (Maxwell)."""
    response = lambda s: impedance(s) + share * STIFFNESS * s * seconds / (1 + s * seconds)  # noqa: E731
    return Wrong(lambda motion: motion.through(response), ("lag",))


def softer(share: float) -> Wrong:
    """The stiffness falls with the speed; no suspect is that."""

    def torque(motion: Motion) -> Numbers:
        speed = np.abs(motion.velocity)
        stiffness = STIFFNESS * (1 - share * speed / (speed + speed.std()))
        return motion.through(lambda s: INERTIA * s**2 + DAMPING * s) + stiffness * motion.position

    return Wrong(torque, ())


WRONG: Mapping[str, Wrong] = {
    "weak reflex, 1 N m s/rad": reflex(1.0),
    "strong reflex, 4 N m s/rad": reflex(4.0),
    "Coulomb friction, 0.3 N m": Wrong(
        lambda motion: motion.through(impedance) + 0.3 * np.sign(motion.velocity), ("friction",)
    ),
    "cubic stiffness, +10 %": cubic(0.1),
    "cubic stiffness, +30 %": cubic(0.3),
    "torque 0.5 ms late": late(0.0005),
    "torque 1 ms late": late(0.001),
    "torque 2 ms late": late(0.002),
    "torque 5 ms late": late(0.005),
    "amplifier of 20 Hz": amplifier(20.0),
    "cuff of 600 N m/rad": cuff(600.0),
    "cuff of 1250 N m/rad": cuff(1250.0),
    "second mode at 12 Hz": second_mode(),
    "backlash of 0.02 rad": backlash(0.02),
    "sensor saturates softly, 2.5 sd": saturating(2.5),
    "clocks 100 ppm apart": apart(1e-4),
    "inertia by angle, +20 %": heavier(0.2),
    "skin slips 15 % below 3 Hz": slipping(0.15, 3.0),
    "30 % relaxes in 100 ms": relaxing(0.3, 0.1),
    "30 % relaxes in 500 ms": relaxing(0.3, 0.5),
    "stiffness falls with speed": softer(0.5),
}


# ---- Recordings, and what identifies them.


def record(
    random: np.random.Generator,
    noise: str = "pink",
    motion: str = "random",
    wrong: Wrong | None = None,
    *,
    rate: float = RATE,
    seconds: float = SECONDS,
    level: float = 1.0,
    encoder: float = 0.0,
    converter: float = 0.0,
) -> Recording:
    """One recording.

    **Arguments:** `level` of the noise in units of `NOISE`; steps of the `encoder` [rad] and of the torque's
    `converter` [N m], zero for none.
    """
    moved = move(random, motion, rate, seconds)
    torque = moved.through(impedance) if wrong is None else wrong.torque(moved)
    torque = torque + OFFSET + level * NOISE * NOISES[noise](random, moved)
    position = moved.position
    if encoder:
        position = encoder * np.round(position / encoder)
    if converter:
        torque = converter * np.round(torque / converter)
    return recording_from_arrays(np.arange(moved.samples) / rate, position, torque)


def pipeline(
    rate: float = RATE,
    window: float = 2.0,
    high_pass: float | None = None,
    noise: str = "estimated",
    estimates: str = "generalised",
) -> Pipeline:
    """Windows side by side, behind a low-pass above the motion, or below the fastest frequency there is."""
    return Pipeline(
        rate,
        HumanJoint(offset=high_pass is None),
        WindowSettings(window, step=window, noise=noise, estimates=estimates),
        FilterSettings(position_cutoff=min(40.0, 0.45 * rate), decimation_cutoff=20.0, high_pass=high_pass),
    )
