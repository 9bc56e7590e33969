"""Whether `identify` is right, or refuses, where a sensor, a recorder or a mapping spoils the signals of a good joint.

The ankle of `ankles`, records of 60 s with windows of 2 s side by side: motion, sample rate, noise and the size of the
fault are drawn for every record. A record is wrong with a straight face if for any parameter too few of the windows
that are trusted in it hold the truth in their 95 % intervals (so few that this would happen by chance in 1 of 200
records). Writes experiments/results/broken_signals.json and broken_signals.md.

    python experiments/broken_signals.py [--records 200]
"""

from __future__ import annotations

import argparse
import json
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import ankles
import jax
import numpy as np
from numpy.typing import NDArray
from scipy.signal import butter, sosfiltfilt
from scipy.stats import binom

from jaximp.identification.identify import estimate
from jaximp.recordings import recording_from_arrays

jax.config.update("jax_enable_x64", True)

Numbers = NDArray[np.float64]
RECORDS, CHANCE, FEWEST = 200, 0.005, 3
NAMES = ("inertia", "damping", "stiffness")
RATES = (500.0, 1000.0)
MOTIONS, NOISES = ("random", "multisine", "chirp"), ("white", "pink", "AR(1) of 50 ms")
FOLDER = Path(__file__).parent / "results"


@dataclass
class Signals:
    """A good record before it is spoilt."""

    motion: ankles.Motion
    time: Numbers
    position: Numbers
    torque: Numbers
    stiffness: Numbers
    """(N,) [N m/rad]"""
    command: Numbers | None = None
    """(N,) torque that drives the joint and its rig [N m], where it is recorded."""
    drive: str | None = None
    """What the job says of it."""

    def spoilt(self, **signals: Any) -> Signals:
        return replace(self, **signals)


Fault = Callable[[np.random.Generator, Signals], Signals]


def between(random: np.random.Generator, low: float, high: float) -> float:
    """Evenly over the logarithm."""
    return float(np.exp(random.uniform(np.log(low), np.log(high))))


def good(random: np.random.Generator, of: Signals) -> Signals:
    return of


def clipped(random: np.random.Generator, of: Signals) -> Signals:
    """At 0.5 to 3 standard deviations, around zero or the mean; sometimes with 2 mN m of noise behind it."""
    limit, middle = random.uniform(0.5, 3) * of.torque.std(), random.choice([0.0, of.torque.mean()])
    torque = np.clip(of.torque, middle - limit, middle + limit)
    return of.spoilt(torque=torque + random.choice([0, 2e-3]) * random.normal(size=len(torque)))


def noisy_position(random: np.random.Generator, of: Signals) -> Signals:
    """0.1 to 2 mrad below 20 to 400 Hz, as behind a recorder's filter."""
    band, rate = min(between(random, 20, 400), 0.45 * of.motion.rate), of.motion.rate
    noise = sosfiltfilt(butter(4, band, fs=rate, output="sos"), random.normal(size=len(of.time)))
    return of.spoilt(position=of.position + between(random, 1e-4, 2e-3) * noise / noise.std())


def small_and_noisy(random: np.random.Generator, of: Signals) -> Signals:
    """A motion and a torque five times smaller, beside the same noise of the position."""
    return noisy_position(random, of.spoilt(position=of.position / 5, torque=of.torque / 5))


def jittered(random: np.random.Generator, of: Signals) -> Signals:
    """A coarse encoder, and stamps that jitter by 5 %."""
    step, rate = between(random, 2e-4, 3e-3), of.motion.rate
    time = of.time + 0.05 / rate * random.uniform(-1, 1, len(of.time))
    return of.spoilt(time=time, position=step * np.round(of.position / step))


def glitches(random: np.random.Generator, of: Signals) -> Signals:
    """Spikes, a sentinel or zeros, in 1e-4 to 1e-2 of the samples of one channel."""
    at = random.random(len(of.time)) < between(random, 1e-4, 1e-2)
    name, kind = str(random.choice(["position", "torque"])), random.integers(3)
    x = getattr(of, name).copy()
    spikes = x[at] + x.std() * random.choice([-1, 1], at.sum()) * random.uniform(1, 10, at.sum())
    x[at] = (spikes, -999.0, 0.0)[kind]
    return of.spoilt(**{name: x})


def delayed(random: np.random.Generator, of: Signals) -> Signals:
    """The torque 0.5 to 20 ms late, sometimes early."""
    seconds = between(random, 5e-4, 2e-2) * random.choice([1, -1], p=[0.8, 0.2])
    f = np.fft.rfftfreq(len(of.time), 1 / of.motion.rate)
    turned = np.fft.rfft(of.torque) * np.exp(-2j * np.pi * f * seconds)
    return of.spoilt(torque=np.fft.irfft(turned, len(of.time)))


def held(random: np.random.Generator, of: Signals) -> Signals:
    """One channel changes only every 2 to 10 samples."""
    every, name = int(random.integers(2, 11)), str(random.choice(["position", "torque"]))
    return of.spoilt(**{name: getattr(of, name)[np.arange(len(of.time)) // every * every]})


def drifting(random: np.random.Generator, of: Signals) -> Signals:
    """The stiffness changes by up to 30 % in a window, up and down in ten seconds."""
    there_and_back = 2 * np.abs((of.time / 20 + random.random()) % 1 - 0.5) - 0.5
    stiffness = ankles.STIFFNESS * (1 + 5 * random.uniform(0, 0.3) * there_and_back)
    more = (stiffness - ankles.STIFFNESS) * of.motion.position
    return of.spoilt(torque=of.torque + more, stiffness=stiffness)


def followed(random: np.random.Generator, of: Signals) -> Signals:
    """The motion is imposed, by a servo that lags behind what it was asked for."""
    s = 2j * np.pi * np.fft.rfftfreq(len(of.time), 1 / of.motion.rate)
    return of.spoilt(command=np.fft.irfft(of.motion.spectrum * (1 + 0.01 * s), len(of.time)))


def driven(recorded: bool, drive: str | None) -> Fault:
    """A torque drives the joint and a rig of up to the same impedance, and noise of the joint's torque moves both."""

    def fault(random: np.random.Generator, of: Signals) -> Signals:
        s, share = 2j * np.pi * np.fft.rfftfreq(len(of.time), 1 / of.motion.rate), random.uniform(0, 1)
        rig = share * (0.3 * ankles.INERTIA * s**2 + 0.3 * ankles.DAMPING * s + ankles.STIFFNESS)
        own = np.fft.rfft(of.torque - of.motion.through(ankles.impedance) - ankles.OFFSET)
        moved = np.fft.irfft(-own / (ankles.impedance(s) + rig), len(of.time))
        command = np.fft.irfft(of.motion.spectrum * (ankles.impedance(s) + rig), len(of.time))
        held = np.fft.irfft((of.motion.spectrum + np.fft.rfft(moved)) * rig, len(of.time))
        torque = command - held + ankles.OFFSET + 0.02 * random.normal(size=len(of.time))
        position = of.position + moved
        return of.spoilt(position=position, torque=torque, command=command if recorded else None, drive=drive)

    return fault


def warming(random: np.random.Generator, of: Signals) -> Signals:
    """The gain of the torque's sensor changes by 12 to 25 % while it warms up."""
    gain, seconds = random.choice([-1, 1]) * random.uniform(0.12, 0.25), random.uniform(15, 60)
    return of.spoilt(torque=of.torque * (1 + gain * (1 - np.exp(-of.time / seconds))))


def pushed_and_pulled(random: np.random.Generator, of: Signals) -> Signals:
    """The sensor counts one direction 10 to 25 % too small or too large."""
    gain = random.choice([-1, 1]) * random.uniform(0.1, 0.25)
    return of.spoilt(torque=of.torque * np.where(of.torque > 0, 1 + gain, 1))


def lost_packets(random: np.random.Generator, of: Signals) -> Signals:
    """8 to 20 % of the torque were lost, 40 to 120 ms at a time, and bridged by straight lines."""
    share, length = random.uniform(0.08, 0.2), random.uniform(0.04, 0.12) * of.motion.rate
    kept = np.ones(len(of.time), bool)
    for first in random.integers(len(of.time), size=round(share * len(of.time) / length)):
        kept[first : first + round(length)] = False
    return of.spoilt(torque=np.interp(of.time, of.time[kept], of.torque[kept]))


def slower_device(random: np.random.Generator, of: Signals) -> Signals:
    """The torque was measured at 45 to 110 Hz, and joined by straight lines."""
    stamps = np.arange(random.uniform(0, 0.01), of.time[-1], 1 / random.uniform(45, 110))
    return of.spoilt(torque=np.interp(of.time, stamps, np.interp(stamps, of.time, of.torque)))


def sent_twice(random: np.random.Generator, of: Signals) -> Signals:
    """A buffer gives 6 to 15 % of the torque again in place of what came after it."""
    length, torque = int(random.uniform(0.03, 0.15) * of.motion.rate), of.torque.copy()
    count = round(random.uniform(0.06, 0.15) * len(torque) / length)
    for block in random.choice(np.arange(1, len(torque) // length), count, replace=False):
        torque[block * length : (block + 1) * length] = of.torque[(block - 1) * length : block * length]
    return of.spoilt(torque=torque)


def dead_zone(random: np.random.Generator, of: Signals) -> Signals:
    """A robot's force sensor shows nothing below 0.05 to 0.25 standard deviations, and so much less above."""
    width = random.uniform(0.05, 0.25) * of.torque.std()
    return of.spoilt(torque=np.sign(of.torque) * np.maximum(np.abs(of.torque) - width, 0))


def packets(random: np.random.Generator, of: Signals) -> Signals:
    """Stamps of when packets of 6 to 16 ms arrived."""
    count, rate = max(3, round(random.uniform(0.006, 0.016) * of.motion.rate)), of.motion.rate
    index = np.arange(len(of.time))
    return of.spoilt(time=index // count * count / rate + 1e-5 * (index % count))


OWN = ("the joint is free", "own torque makes", "instrumental variables by", "belongs with later motion")
FAULTS: Mapping[str, tuple[Fault, str | None, tuple[str, ...]]] = {
    "nothing": (good, None, ()),
    "torque at a limit": (clipped, None, ("limit",)),
    "noise of the position": (noisy_position, None, ("position noise", "noise of the position")),
    "noise of the position, a motion five times smaller": (
        small_and_noisy,
        None,
        ("position noise", "noise of the position"),
    ),
    "coarse encoder, stamps that jitter": (jittered, None, ("position noise",)),
    "glitches": (glitches, None, ("stand out", "stands out")),
    "delay": (delayed, None, ("delay",)),
    "held samples": (held, None, ("changes only every",)),
    "stiffness that changes inside windows": (drifting, None, ("change",)),
    "degrees read as radians": (
        lambda random, of: of.spoilt(position=np.rad2deg(of.position)),
        "ankle",
        ("in degrees",),
    ),
    "torque in N mm": (lambda random, of: of.spoilt(torque=1000 * of.torque), "ankle", ("in N mm",)),
    "a gear of 50 forgotten": (
        lambda random, of: of.spoilt(position=50 * of.position, torque=of.torque / 50),
        "ankle",
        ("gear",),
    ),
    "a clock twice too fast": (lambda random, of: of.spoilt(time=of.time / 2), "ankle", ("clock",)),
    "joint driven by its own torque, nothing said": (driven(False, None), None, OWN),
    'the same, `drive = "free"`': (driven(False, "free"), None, OWN),
    "the same, with its command": (driven(True, None), None, OWN),
    'the same, `drive = "free"`, with its command': (driven(True, "free"), None, OWN),
    "nothing, with a reference that is followed": (followed, None, ()),
    "a gain that changes": (warming, None, ("gain of a sensor",)),
    "another gain in each direction": (pushed_and_pulled, None, ("torque sensor",)),
    "lost packets, bridged by lines": (lost_packets, None, ("straight lines",)),
    "a slower torque, joined by lines": (slower_device, None, ("straight lines",)),
    "blocks of torque sent twice": (sent_twice, None, ("repeat earlier ones",)),
    "a dead zone": (dead_zone, None, ("dead zone",)),
    "stamps of packets": (packets, None, ("packets",)),
}
"""What is done, the joint's name where it is given, and words that name the culprit."""


def record(random: np.random.Generator) -> Signals:
    rate, motion, noise = (random.choice(some) for some in (RATES, MOTIONS, NOISES))
    moved, level = ankles.move(random, str(motion), float(rate)), between(random, 0.3, 1)
    torque = (
        moved.through(ankles.impedance) + ankles.OFFSET + level * ankles.NOISE * ankles.NOISES[noise](random, moved)
    )
    position = moved.position + 1e-5 * random.normal(size=moved.samples)
    time = np.arange(moved.samples) / moved.rate
    return Signals(moved, time, position, torque, np.full(moved.samples, ankles.STIFFNESS))


def tried(fault: Fault, name: str | None, words: tuple[str, ...], seed: tuple[int, ...]) -> dict[str, Any]:
    """One record: whether it was refused, whether it is wrong with a straight face, and what was said."""
    random = np.random.default_rng(seed)
    of = fault(random, record(random))
    try:
        recording = recording_from_arrays(of.time, of.position, of.torque, command=of.command)
        pipeline = ankles.pipeline(recording.sample_rate)
        pipeline = replace(pipeline, limits=replace(pipeline.limits, joint_name=name), drive=of.drive)
        estimates = estimate(pipeline, recording)[0]
    except ValueError as error:
        return {"refused": 1.0, "wrong": 0.0, "named": any(word in str(error) for word in words), "off": [0.0] * 3}
    low, high = estimates.interval()
    truth = np.tile([ankles.INERTIA, ankles.DAMPING, 0.0], (len(low), 1))
    before, rate = np.concatenate([np.zeros(1), np.cumsum(of.stiffness)]), of.motion.rate
    first = np.round(estimates.start * rate).astype(int).clip(0, len(of.time) - 1)
    last = np.round(estimates.end * rate).astype(int).clip(max=len(of.time))
    truth[:, 2] = (before[last] - before[first]) / np.maximum(last - first, 1)
    wrong = False
    for k, parameter in enumerate(NAMES):
        on = estimates.trusted_in(parameter)
        inside = int(((low[on, k] <= truth[on, k]) & (truth[on, k] <= high[on, k])).sum())
        wrong |= int(on.sum()) >= FEWEST and float(binom.cdf(inside, int(on.sum()), 0.95)) < CHANCE
    said = " ".join([*estimates.notes, *estimates.verdicts.reason, *map(str, estimates.verdicts.complaint().split())])
    said += " ".join(estimates.lacking.values()) + estimates.verdicts.complaint()
    off = np.nanmedian(estimates.value[:, :3] / truth, axis=0) - 1
    return {
        "refused": float(1 - estimates.trusted.mean()),
        "wrong": float(wrong),
        "named": any(word in said for word in words),
        "off": off.tolist(),
    }


def table(cells: Mapping[str, list[dict[str, Any]]]) -> str:
    lines = [
        f"{len(next(iter(cells.values())))} records a row.",
        "",
        "| what is wrong | windows trusted % | wrong with a straight face % | named % | off %, 90 % of records within "
        "(inertia / damping / stiffness) |",
        "| --- | --- | --- | --- | --- |",
    ]
    for name, rows in cells.items():
        trusted, wrong, named = (100 * np.mean([one[key] for one in rows]) for key in ("refused", "wrong", "named"))
        off = 100 * np.quantile(np.abs([one["off"] for one in rows]), 0.9, axis=0)
        lines.append(
            f"| {name} | {100 - trusted:.0f} | {wrong:.1f} | {named:.0f} | {' / '.join(f'{x:.3g}' for x in off)} |"
        )
    counts = Counter({name: sum(one["wrong"] for one in rows) for name, rows in cells.items()})
    worst, most = counts.most_common(1)[0]
    return "\n".join([*lines, "", f"Most that are wrong: {most:.0f}, {worst}."]) + "\n"


if __name__ == "__main__":
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    arguments.add_argument("--records", type=int, default=RECORDS, help="of every row")
    records = arguments.parse_args().records
    cells = {
        name: [tried(fault, joint, words, (3000 + k, n)) for n in range(records)]
        for k, (name, (fault, joint, words)) in enumerate(FAULTS.items())
    }
    (FOLDER / "broken_signals.json").write_text(json.dumps(cells) + "\n")
    (FOLDER / "broken_signals.md").write_text(table(cells))
    print(table(cells))
