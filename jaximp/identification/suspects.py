"""What a model may lack, as further columns of the torque of one joint: who is asked, and in which columns."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise

import numpy as np
from jax import Array

from jaximp import signals
from jaximp.identification.filter_settings import Filters
from jaximp.identification.pipeline import Pipeline
from jaximp.identification.rows import measured_motion
from jaximp.models.base import Model
from jaximp.numerics.compilation import compiled
from jaximp.types import AnyArray, Numbers, Recording

REFLEX_DELAY, MUSCLE = 0.03, (0.0, 0.015, 0.03, 0.06, 0.12)
"""How long the rectified velocity takes to the muscle, and time constants of its torque, which builds up as behind a
critically damped low-pass of second order [s]; in both directions."""
SLOW = 0.3
"""Velocity below which dry friction builds up, as a share of its root mean square."""
YIELDING = (0.01, 0.04)
"""Time constants of what yields between the position and the torque [s]."""
PLAYS = (0.1, 0.25, 0.6)
"""Half widths of plays, as shares of the root mean square of the motion."""
PIECE = 4096
"""Samples whose torque is worked out at once."""
WIDEST_BAND = 0.9
"""Of derivatives of rows, as a share of half their rate."""


@dataclass(frozen=True)
class Motion:
    """Of one joint, behind the position's filter, at every sample."""

    t: Numbers
    q: Numbers
    dq: Numbers
    ddq: Numbers
    jerk: Numbers
    snap: Numbers
    rate: float
    torque: Numbers
    """That of the model; nothing where its parameters are not known."""

    def later(self, x: Numbers, seconds: float) -> Numbers:
        """What x was so long ago."""
        lag = round(seconds * self.rate)
        return np.concatenate([np.zeros(lag), x[: len(x) - lag]])

    def twitch(self, x: Numbers, seconds: float) -> Numbers:
        """The torque of a muscle that is told x; of no seconds, x itself."""
        from scipy.signal import lfilter

        if not seconds:
            return x
        a = np.exp(-1 / (seconds * self.rate))
        return np.asarray(lfilter([(1 - a) ** 2], [1, -2 * a, a * a], x))


@dataclass(frozen=True)
class Suspect:
    """A group of columns, and what it stands for."""

    what: str
    remedy: str
    columns: Callable[[Motion], list[Numbers]]


def yielding(x: Numbers, seconds: float, rate: float) -> Numbers:
    """x behind a first-order lag."""
    from scipy.signal import lfilter

    a = np.exp(-1 / (seconds * rate))
    return np.asarray(lfilter([1 - a], [1, -a], x))


def behind_play(q: Numbers, half: float) -> Numbers:
    """What follows q through a play of so much to either side: the play operator, at first in its middle.

    From one turning point of q to the next it is q less the play on the way up, q plus the play on the way down, or
    what it was at the turning point, whichever lies farther on the way.

    **Source:** Krasnosel'skii and Pokrovskii 1989, Systems with hysteresis.
    """
    found, last = np.empty_like(q), q[0]
    behind_turns = np.flatnonzero(np.diff(np.sign(np.diff(q)))) + 2
    for first, end in pairwise([0, *behind_turns.tolist(), len(q)]):
        up = q[end - 1] >= q[max(first - 1, 0)]
        found[first:end] = np.maximum(last, q[first:end] - half) if up else np.minimum(last, q[first:end] + half)
        last = found[end - 1]
    return found


SUSPECTS: Mapping[str, Suspect] = {
    "reflex": Suspect(
        "a stretch reflex",
        "try model.human.reflex = true",
        lambda m: [
            m.twitch(stretch, seconds)
            for stretch in (np.maximum(m.later(sign * m.dq, REFLEX_DELAY), 0) for sign in (1, -1))
            for seconds in MUSCLE
        ],
    ),
    "stiffness": Suspect(
        "a stiffness that depends on the angle",
        "move less far, or around one angle at a time",
        lambda m: [(q := m.q - m.q.mean()) ** 2, q**2 * q],
    ),
    "friction": Suspect(
        "dry friction",
        "model it (coulomb), or leave out slow samples (window.min_velocity)",
        lambda m: [np.sign(m.dq), np.tanh(m.dq / (SLOW * np.sqrt(np.mean(m.dq**2)) + 1e-300))],
    ),
    "play": Suspect(
        "play (backlash) between position and torque",
        "take the play out of the drive or the cuff, or measure the position behind it",
        lambda m: [behind_play(m.q, share * float(np.std(m.q))) - m.q for share in PLAYS],
    ),
    "delay": Suspect(
        "a delay between torque and position",
        "check the clocks and filters of both channels",
        lambda m: [m.jerk],
    ),
    "lag": Suspect(
        "something that yields or filters between position and torque (a cuff, an amplifier), or noise of the position",
        "measure the position where the torque acts, and use one filter for both channels",
        lambda m: [m.snap, *(yielding(m.ddq, seconds, m.rate) for seconds in YIELDING)],
    ),
    "clock": Suspect(
        "clocks of position and torque that drift apart",
        "sample both channels by one clock, or resample one of them to the clock of the other",
        lambda m: [(m.t - m.t.mean()) * m.jerk],
    ),
    "inertia": Suspect(
        "an inertia that depends on the angle",
        "move less far, or around one angle at a time",
        lambda m: [(q := m.q - m.q.mean()) ** 2 * m.ddq + q * m.dq**2, q * m.ddq + m.dq**2 / 2],
    ),
    "sensor": Suspect(
        "a torque sensor whose scale is not constant (soft saturation)",
        "calibrate the sensor and its amplifier over the range of the torques, or use less of it",
        lambda m: [m.torque**2, m.torque**3],
    ),
    "drift": Suspect(
        "a steady change inside the windows",
        "shorten window.length",
        lambda m: [(m.t - m.t.mean()) * m.q, (m.t - m.t.mean()) * m.dq],
    ),
}
"""Tested on one joint, by name. A new one is a row here; of arms also in `OF_JOINTS`, and in `OF_MUSCLES` if a machine
cannot have it. `misfit` knows delay, lag and clock by name."""


# --- arms: every joint by itself, and what moves both --------------------------------------------------------------


@dataclass(frozen=True)
class Explained:
    """The torque of one joint by the model, with its derivatives, at every row."""

    torque: Numbers
    slope: Numbers
    curvature: Numbers
    rate: float
    """Of the rows [Hz]."""


@dataclass(frozen=True)
class OfTorque:
    """A group of columns that are made of the torque itself, as whatever stands between torque and motion makes them
    of many columns at once."""

    what: str
    remedy: str
    columns: Callable[[Explained], list[Numbers]]


def _reworded(name: str, remedy: str) -> Suspect:
    return Suspect(SUSPECTS[name].what, remedy, SUSPECTS[name].columns)


OF_JOINTS: Mapping[str, Suspect] = {
    "reflex": _reworded("reflex", "perturb less, or more briefly than a reflex takes"),
    "stiffness": SUSPECTS["stiffness"],
    "friction": _reworded(
        "friction", "model it (coulomb = true), or leave out more slow samples (window.min_velocity)"
    ),
    "play": SUSPECTS["play"],
    "viscous": Suspect("viscous friction", "model it (viscous = true)", lambda m: [m.dq]),
    "rotor": Suspect("a motor's inertia", "model it (rotor = true), and leave out lengths", lambda m: [m.ddq]),
    "offset": Suspect("a constant torque", "model it (offset = true)", lambda m: [np.ones_like(m.t)]),
    "drift": SUSPECTS["drift"],
}
"""Who is asked of each joint of an arm; its column acts on the torque of this joint alone."""
OF_MUSCLES = ("reflex", "stiffness", "play")
"""Who is asked where joints have muscles, as a model with stiffness says."""
OF_TORQUES: Mapping[str, OfTorque] = {
    name: OfTorque(SUSPECTS[name].what, SUSPECTS[name].remedy, columns)
    for name, columns in {
        "delay": lambda e: [e.slope],
        "lag": lambda e: [e.curvature, *(yielding(e.torque, seconds, e.rate) - e.torque for seconds in YIELDING)],
    }.items()
}
"""Who is asked of each joint of an arm, by the torque that the model gives it."""
GRAVITY = Suspect("gravity of another kind", "look at gravity, zero and lengths in model.arm", lambda m: [])
SCALE = Suspect(
    "one scale of both joints' torques",
    "check units, gear ratios and torque constants of both joints",
    lambda m: [],
)
"""Who is asked of both joints together."""
DRIVE = "drive"
OWN_MOTION = Suspect(
    "the motion that the joint's own torque makes",
    "say model.drive = 'free': estimates are then instrumental variables by that channel",
    lambda m: [],
)
"""Who is asked where a command or reference is known: the columns of the motion that it does not explain."""
WORDS: Mapping[str, Suspect | OfTorque] = {
    **OF_JOINTS,
    **SUSPECTS,
    "gravity": GRAVITY,
    "scale": SCALE,
    DRIVE: OWN_MOTION,
}


ROBOT = "robot"


def tag(name: str, joint: int) -> str:
    """The name of a group of one joint of several, counted from zero."""
    return f"joint {joint + 1}: {name}"


def of_robot(name: str) -> str:
    """The name of a group of the robot that holds a human."""
    return f"{ROBOT}: {name}"


def untagged(group: str) -> tuple[str, int | None]:
    """Name, and joint counted from zero (of one joint of several), of a group."""
    whose, _, name = group.rpartition(": ")
    return name, int(whose.split()[-1]) - 1 if whose.startswith("joint") else None


def owner(group: str) -> str:
    """Whose a group is: `joint 2`, `robot`, or nobody's where there is one joint."""
    return group.rpartition(": ")[0]


def what(group: str) -> str:
    """What a group stands for, in words: `dry friction of joint 2`."""
    whose, _, name = group.rpartition(": ")
    owner = f"the {ROBOT}" if whose == ROBOT else whose
    return f"{WORDS[name].what} of {owner}" if owner else WORDS[name].what


def remedy(group: str) -> str:
    """Against what a group stands for."""
    name, joint = untagged(group)
    return (WORDS if joint is None else {**WORDS, **OF_JOINTS})[name].remedy


# --- columns -------------------------------------------------------------------------------------------------------


def has_muscles(model: Model) -> bool:
    """Whether a model is of more than a machine or a limp arm."""
    return any(role.kind == "stiffness" for role in model.roles)


def of_one_joint(
    pipeline: Pipeline, recording: Recording, theta: Numbers | None = None
) -> Iterator[tuple[str, Numbers]]:
    """Columns (N, g) of all `SUSPECTS` that a joint like the model's may have, behind the filters.

    **Arguments:** parameters `theta` (p,), near which it lies; without them the torque's sensor is not asked.
    """
    (motion,), model = motions(pipeline, recording), pipeline.model
    left_out = set() if has_muscles(model) else set(OF_MUSCLES)
    if theta is None:
        left_out.add("sensor")
    else:
        motion = replace(motion, torque=_torque(model, motion, theta))
    asked = {name: one for name, one in SUSPECTS.items() if name not in left_out}
    by_group = [suspect.columns(motion) for suspect in asked.values()]
    together = behind_filters(pipeline.filters, [column for group in by_group for column in group])
    ends = np.cumsum([len(group) for group in by_group])
    yield from zip(asked, np.split(together, ends[:-1], axis=1), strict=True)


def _torque(model: Model, motion: Motion, theta: Numbers) -> Numbers:
    """(N,) that the model makes of a motion. In pieces of one size, so that recordings of any length share a program;
    before the first sample was, for a model with memory, the end of the recording."""
    n, past = len(motion.q), model.memory
    starts = np.arange(0, n, PIECE)
    index = np.clip(starts[:, None] + np.arange(-past, PIECE), None, n - 1) % n
    pieces = [_torque_of_piece(model, theta, *(x[k] for x in (motion.q, motion.dq, motion.ddq))) for k in index]
    return np.concatenate(pieces)[:n]


@partial(compiled, static_argnums=0)
def _torque_of_piece(model: Model, theta: AnyArray, *motion: AnyArray) -> Array:
    return model.observation_matrix(*motion)[model.memory :] @ theta


def of_arm(
    pipeline: Pipeline, recording: Recording, W: AnyArray, theta: Numbers
) -> Iterator[tuple[str, dict[int, Numbers]]]:
    """Of all suspects of an arm the columns (N, g) of each joint whose torque they act on, behind the filters.

    **Arguments:** `W` (N, n, p) rows as they were filtered, and the parameters `theta` (p,), near which it lies.
    """
    filters, each = pipeline.filters, motions(pipeline, recording)
    muscles = has_muscles(pipeline.model)
    explained = _explained(pipeline, np.asarray(W) @ theta)
    for j, motion in enumerate(each):
        for name, suspect in OF_JOINTS.items():
            if muscles or name not in OF_MUSCLES:
                yield tag(name, j), {j: behind_filters(filters, suspect.columns(motion))}
        for name, by_torque in OF_TORQUES.items():
            yield tag(name, j), {j: np.stack(by_torque.columns(explained[j]), axis=1)}
    if pipeline.model.label == "arm":
        first, both = (each[0].q, each[0].q + each[1].q)
        angles = {0: [np.sin(first), np.cos(first)], 1: [np.zeros_like(first)] * 2}
        columns = {j: [*angles[j], np.sin(both), np.cos(both)] for j in angles}
        shared = (np.abs(W) > 0).any(axis=0).all(axis=0)
        if shared.any():
            yield "scale", {1: np.asarray(W)[:, 1, shared]}
        yield "gravity", {j: behind_filters(filters, columns[j]) for j in columns}


def behind_filters(filters: Filters, columns: list[Numbers]) -> Numbers:
    """(N, g) rows of columns of every sample."""
    together = np.stack(columns)
    if filters.parallel is None:
        return together[:, :: filters.decimate].T
    return np.asarray(signals.filter_zero_phase_decimated(filters.parallel, together, filters.decimate)).T


def motions(pipeline: Pipeline, recording: Recording) -> list[Motion]:
    """Of every joint."""
    from scipy.signal import sosfiltfilt

    filters, rate = pipeline.filters, recording.sample_rate
    position = measured_motion(pipeline.filter, recording).position
    found = []
    for q in position.T:
        if filters.position is not None:
            q = sosfiltfilt(np.array(filters.position), q)
        dq, ddq = signals.differentiate(q, rate, filters.differentiator)
        jerk, snap = signals.differentiate(ddq, rate, filters.differentiator)
        found.append(Motion(recording.time, q, dq, ddq, jerk, snap, rate, np.empty(0)))
    return found


def _explained(pipeline: Pipeline, torque: Numbers) -> list[Explained]:
    """Of rows (N, n) of the torque by the model."""
    filters = pipeline.filters
    rate = pipeline.sample_rate / filters.decimate
    band = min(WIDEST_BAND, (WIDEST_BAND if filters.band is None else filters.band) * filters.decimate)
    by = signals.design_differentiator(band)
    slope, curvature = signals.differentiate(torque, rate, by if len(torque) > 2 * by.half else signals.CENTRAL)
    return [Explained(torque[:, j], slope[:, j], curvature[:, j], rate) for j in range(torque.shape[1])]
