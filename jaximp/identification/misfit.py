"""What a model lacks: further columns, tested in white rows over the whole record, and what is said of it."""

from __future__ import annotations

from collections.abc import Callable, Container, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaximp.identification.pipeline import Pipeline
from jaximp.identification.rows import Rows
from jaximp.identification.separation import Regression, Separation, Whiten
from jaximp.identification.suspects import (
    DRIVE,
    OF_MUSCLES,
    ROBOT,
    has_muscles,
    of_arm,
    of_one_joint,
    of_robot,
    owner,
    remedy,
    untagged,
    what,
)
from jaximp.identification.whitening import White
from jaximp.least_squares.disjoint import DisjointFit
from jaximp.models.base import Role
from jaximp.trust.score_tests import ALIKE, ERRORS, SHARE, Bands, Misfit, noticed, score_groups, significant
from jaximp.types import AnyArray, Numbers, Recording, listed

LATE = ("delay", "clock")
"""Their weights are those of a jerk."""
AT_ENDS = ("clock",)
"""What moves parameters most in the first and the last window, to both sides, and not on the mean."""
LEAVES = 0.1
"""A group that explains what is found leaves another one such a share of its own evidence at most: those that are
right left 6 %, those that only looked like it 10 to 170 %, in simulated records of 60 s."""
USUAL = (0.05, 0.95)
"""Quantiles of the torque between which a sensor's scale is compared."""
HIDES = {"lag": "stiffness"}
"""Whatever yields in series with a joint makes its stiffness smaller, by as much as no column shows."""

MOST_NAMED = 5
"""Parameters that a note names."""
FAINT = 0.01
"""Where another weight of the frequencies alone moves a parameter by such a share, what is hidden may move it by
`SHARE`: stiffness that relaxes mostly below the motion's frequencies does."""


FEWEST_WINDOWS = 6
"""In a shorter record a machine's parameters are taken as those of the record: windows with parameters of their own
would leave nothing to test with."""


def find_misfits(
    pipeline: Pipeline, recording: Recording, rows: Rows, white: White, theta: Numbers, own: Numbers | None = None
) -> tuple[Misfit, ...]:
    """Test all suspects of one joint, or of an arm, whose parameters are some theta (p,).

    **Arguments:** `rows` as they were filtered, and `white`; `own` columns (N, p) of the motion of one joint that its
    reference does not explain, where it has one.
    """
    if recording.n_joints > 1:
        tests = Tests.of(pipeline, white, rows.valid, of_arm(pipeline, recording, rows.W, theta))
        if not has_muscles(pipeline.model) and len(tests.torque) < FEWEST_WINDOWS * tests.window:
            tests = tests.with_other(window=len(tests.torque))
        return tuple(_as_delayed(_one_after_another(tests)))
    counts = np.ravel(rows.valid)
    W, torque = (np.reshape(x, (len(counts), -1))[counts] for x in (white.W, white.torque))
    whole = np.linalg.lstsq(W, torque[:, 0])[0]
    suspects = [*of_one_joint(pipeline, recording, whole), *([] if own is None else [(DRIVE, own)])]
    groups = ((name, {0: columns}) for name, columns in suspects)
    tests = Tests.of(pipeline, white, rows.valid, groups)
    explained = np.reshape(rows.W, (len(counts), -1))[counts] @ whole
    tested = [_with_ambiguity(one, explained) for one in _with_left(tests, tests())]
    return _of_joint(pipeline, tested, theta, _half(pipeline, recording))


def _with_ambiguity(misfit: Misfit, torque: Numbers) -> Misfit:
    """Of a sensor, by the spread of its local scale over the model's torque, but for its rarest values."""
    if untagged(misfit.group)[0] != "sensor":
        return misfit
    low, high = np.quantile(torque, USUAL)
    T = np.linspace(low, high, 21)
    return replace(misfit, ambiguity=float(np.ptp(1 + 2 * misfit.weights[0] * T + 3 * misfit.weights[1] * T**2)))


def _half(pipeline: Pipeline, recording: Recording) -> float:
    """[s] from the middle of the recording to that of its first window."""
    return float(recording.time[-1] - recording.time[0] - pipeline.window.length) / 2


def _with_left(tests: Tests, found: Sequence[Misfit]) -> list[Misfit]:
    """With what is left beside the groups that are suspected."""
    suspected = {one.group for one in _suspected(found)}
    return [replace(one, left=tests.left_by(one)) if one.group in suspected else one for one in found]


def _of_joint(pipeline: Pipeline, found: Iterable[Misfit], theta: Numbers, seconds: float) -> tuple[Misfit, ...]:
    """With the moves by what comes late. **Arguments:** `seconds` from the record's middle to its first window's."""
    roles = pipeline.model.roles
    of_jerk = _as_clocks(list(found), seconds)
    late = [_undelayed(one, roles, theta) if untagged(one.group)[0] in LATE else one for one in of_jerk]
    return tuple(_as_delayed(late))


@dataclass(frozen=True)
class RobotTests:
    """What a robot's model lacks in the recording of the robot alone, with all of it as one window."""

    columns: Mapping[str, NDArray[np.floating]]
    """(N, g) of all suspects in this recording, behind the filters."""
    weights: Mapping[str, NDArray[np.floating]]
    """(r, g) with which the robot's own parameters imitate the columns that its model lacks."""
    note: str
    """What is missing, in words."""

    @classmethod
    def of(cls, pipeline: Pipeline, recording: Recording, alone: Regression, whiten: Whiten) -> RobotTests:
        """**Arguments:** the `recording` of the robot alone, and as `alone` its rows.

        The noise is what the suspects leave of the torque too: friction that is missing turns as slowly as slow noise,
        and would hide behind it.
        """
        columns = {name: one for name, one in of_one_joint(pipeline, recording) if name not in OF_MUSCLES}
        white = whiten(np.concatenate([np.asarray(alone.robot), *columns.values()], axis=1), alone.torque, alone.valid)
        tests = Tests.of(pipeline, white, alone.valid, ((name, {0: one}) for name, one in columns.items()))
        tests = tests.with_other(W=tests.W[:, : alone.robot.shape[1]], window=len(tests.torque), moved_in=None)
        lacking, W = _clear(tests()), tests.W[tests.valid]
        weights = {one.group: np.linalg.lstsq(W, tests.groups[one.group][tests.valid])[0] for one in lacking}
        names = " or ".join(what(one.group) for one in lacking)
        return cls(columns, weights, f"the model of the robot lacks {names}" if lacking else "")


def find_human_misfits(
    pipeline: Pipeline,
    recording: Recording,
    found: Separation,
    theta: Numbers,
    of_method: Callable[[tuple[AnyArray, AnyArray], AnyArray], Mapping[int, AnyArray]],
    robot: RobotTests,
) -> tuple[Misfit, ...]:
    """Test the human's model in the white rows of a method, and what the robot's lacks for what it does to the human.

    **Arguments:** the `recording` of the robot with the human; `theta` (h,) near which the human's parameters lie;
    `of_method`, which knows what columns that the robot lacks leave in the rows (`robot_columns` of the method).
    """
    assert found.white is not None
    n, human = len(found.torque), list(found.human)

    def groups() -> Iterator[tuple[str, Mapping[int, Numbers]]]:
        for name, columns in of_one_joint(pipeline, recording):
            if name in robot.weights:
                acting = of_method((robot.columns[name], columns), robot.weights[name])
                yield of_robot(name), {output: one[:n] for output, one in acting.items()}
            else:
                yield name, {-1: columns[:n]}

    tests = Tests.of(pipeline, found.white, found.valid, groups())
    tested = _with_left(tests, tests())
    own = (replace(one, move=one.move[human], stderr=one.stderr[human]) for one in tested)
    return _of_joint(pipeline, own, theta, _half(pipeline, recording))


@dataclass(frozen=True)
class Tests:
    """White rows, those of all outputs in a row, and further columns through the same filters."""

    W: Numbers
    torque: Numbers
    valid: NDArray[np.bool_]
    groups: Mapping[str, Numbers]
    window: int
    every: int
    fit: DisjointFit | None = None
    """Of these rows in windows side by side, where it is known."""
    moved_in: tuple[Numbers, Mapping[str, Numbers]] | None = None
    """Columns and groups as they were filtered, where parameters move by those (`Pipeline.ordinary`)."""

    @classmethod
    def of(
        cls, pipeline: Pipeline, white: White, valid: AnyArray, groups: Iterable[tuple[str, Mapping[int, Numbers]]]
    ) -> Tests:
        """**Arguments:** `valid` (N, *n); `groups` of columns (N, g), by the output on whose torque they act."""
        W, torque = np.asarray(white.W), np.asarray(white.torque)
        outputs = 1 if torque.ndim == 1 else torque.shape[1]
        counts = np.asarray(valid, bool).reshape(-1, outputs)
        whole, filtered = {}, {}
        for name, by_output in groups:
            columns, plain = np.zeros((2, *counts.shape, next(iter(by_output.values())).shape[1]))
            for j, acting in by_output.items():
                columns[:, j] = white.apply(acting, counts[:, j], j)
                plain[:, j] = np.where(counts[:, j, None], acting, 0) / (
                    1 if white.counted is None else white.counted[j]
                )
            whole[name], filtered[name] = (x.reshape(-1, columns.shape[-1]) for x in (columns, plain))
        W, window = W.reshape(-1, W.shape[-1]), pipeline.window_rows * outputs
        moved_in = None if white.as_filtered is None else (np.reshape(white.as_filtered, W.shape), filtered)
        return cls(W, torque.ravel(), counts.ravel(), whole, window, white.every, white.windows, moved_in)

    def __call__(self) -> list[Misfit]:
        """Test every group."""
        given = (self.valid, self.window, self.every, self.fit, self.moved_in)
        return score_groups(self.W, self.torque, self.groups, *given)

    def left_by(self, best: Misfit) -> float:
        """Most evidence of another group that is significant with the best one in the model."""
        rest = self.with_other(torque=self.torque - self.groups[best.group] @ best.weights, moved_in=None)
        others = score_groups(rest.W, rest.torque, rest.groups, rest.valid, rest.window, rest.every, beside=best.group)
        return max((one.evidence for one in significant(others)), default=0.0)

    def with_other(self, **rows: Any) -> Tests:
        """With other rows or windows, whose fit is not known yet."""
        return replace(self, fit=None, **rows)

    def without(self, found: Sequence[Misfit]) -> Tests:
        """Of the groups of other joints, with all that these groups of one joint explain taken off the torque."""
        joint = untagged(found[0].group)[1]
        gone = {one.group for one in found}
        others = {
            name: columns
            for name, columns in self.groups.items()
            if name not in gone and (joint is None or untagged(name)[1] != joint)
        }
        columns = np.concatenate([self.groups[name] for name in sorted(gone)], axis=1)
        (together,) = replace(self, groups={"together": columns}, moved_in=None)()
        return self.with_other(torque=self.torque - columns @ together.weights, groups=others)


def _one_after_another(tests: Tests) -> list[Misfit]:
    """Every joint may lack something of its own: groups of other joints are tested beside those that explain most,
    which their columns may only imitate."""
    found: dict[str, Misfit] = {}
    names = list(tests.groups)
    while tests.groups:
        these = tests()
        found |= {one.group: one for one in these}
        best = _clear(these)
        if not best:
            break
        joint = untagged(best[0].group)[1]
        tests = tests.without([one for one in best if untagged(one.group)[1] == joint])
    return [found[name] for name in names if name in found]


def is_delay(group: str) -> bool:
    """Of whatever joint."""
    return untagged(group)[0] == "delay"


def _as_delayed(misfits: Sequence[Misfit]) -> list[Misfit]:
    """To slow motion whatever yields is a delay: that tells what it does to the parameters, its own weights do not."""
    late = {one.group.replace("delay", "lag"): one for one in misfits if is_delay(one.group)}
    return [
        replace(one, move=late[one.group].move, stderr=late[one.group].stderr) if one.group in late else one
        for one in misfits
    ]


def _as_clocks(misfits: Sequence[Misfit], seconds: float) -> list[Misfit]:
    """Clocks that drift apart delay the torque at the record's ends, where they move parameters as a delay does."""
    delays = {one.group.replace("delay", "clock"): one for one in misfits if is_delay(one.group)}
    return [
        _as_clock(one, delays[one.group], seconds) if one.group in delays and delays[one.group].weights[0] else one
        for one in misfits
    ]


def _as_clock(clock: Misfit, delay: Misfit, seconds: float) -> Misfit:
    passed = delay.move * seconds / delay.weights[0]
    move, stderr = passed * clock.weights[0], np.abs(passed) * clock.weights_stderr[0]
    return replace(clock, weights=clock.weights * seconds, move=move, stderr=stderr)


def _undelayed(misfit: Misfit, roles: Sequence[Role], theta: Numbers) -> Misfit:
    """With the move to the parameters without the delay.

    A torque that is late by d has, to first order, a jerk's weight -d inertia, and in place of the inertia and the
    damping what is d damping and d stiffness less.
    """
    place = {role.kind: k for k, role in enumerate(roles) if role.kind in ("inertia", "damping", "stiffness")}
    if "inertia" not in place:
        return misfit
    moved = theta + misfit.move
    late = -misfit.weights[0] / theta[place["inertia"]] if theta[place["inertia"]] else 0.0
    move = misfit.move.copy()
    for of, by in (("damping", "stiffness"), ("inertia", "damping")):
        if of in place and by in place:
            move[place[of]] += late * (moved[place[by]] if by == "stiffness" else theta[place[by]] + move[place[by]])
    relative = np.max(misfit.stderr / np.where(misfit.move != 0, np.abs(misfit.move), np.inf), initial=0.0)
    return replace(misfit, move=move, stderr=relative * np.abs(move))


def sizes(usual: Numbers, roles: Sequence[Role]) -> Numbers:
    """(p,) with which moves of parameters of this usual size are compared; what couples two joints may be small, and
    counts by the geometric mean of both joints' own."""
    own = {(role.kind, role.element): size for role, size in zip(roles, usual, strict=True)}
    found = usual.copy()
    for k, (kind, element) in enumerate(roles):
        if len(element) == 2:
            joints = [own.get((kind, (j, j)), 0.0) for j in element]
            found[k] = max(usual[k], np.sqrt(joints[0] * joints[1]))
    return found


@dataclass(frozen=True)
class Known:
    """What bounds moves that no added column shows."""

    errors: Numbers | float = 0.0
    """(p,) of each parameter's mean over the record."""
    bands: Bands | None = None

    def within_reach(self, misfit: Misfit, size: Numbers) -> NDArray[np.bool_]:
        """(p,) parameters that as much torque as this misfit's would move by more than `SHARE` of their size if it
        looked like them."""
        return np.sqrt(misfit.statistic) * self.errors > SHARE * size

    def depend(self, count: int) -> NDArray[np.bool_]:
        """(p,) of so many parameters those that differ with the frequencies that count, beyond error and `FAINT`."""
        if self.bands is None:
            return np.zeros(count, bool)
        difference = np.abs(self.bands.ordinary - self.bands.generalised)
        return difference > np.maximum(ERRORS * self.bands.stderr, FAINT * np.abs(self.bands.generalised))


NOTHING_KNOWN = Known()


def off_by(
    misfits: Sequence[Misfit],
    names: Sequence[str],
    size: Numbers,
    kinds: Sequence[str] = (),
    known: Known = NOTHING_KNOWN,
) -> dict[str, float]:
    """Parameters that what is missing moves beyond error and `SHARE` of their `size` (p,), by what share; NaN where it
    may move them so far, but how far cannot be told.

    A parameter that the best suspect hides is spared only where as much torque could not move it far, and where it does
    not depend on the frequency. Where no suspect explains what is found, all parameters are spared only so.

    **Arguments:** `kinds` (p,) of the parameters' roles; what is `known` of moves that no column shows.
    """
    found: dict[str, float] = {}
    suspected = _suspected(misfits)
    for one in suspected:
        if one.ambiguity > 2 * SHARE:
            return dict.fromkeys(names, np.nan)
        for k, name in enumerate(names):
            share, error = (x[k] / size[k] if size[k] > 0 else 0.0 for x in (one.move, ERRORS * one.stderr))
            if abs(share) > max(error, SHARE):
                found.setdefault(name, float(share))
            elif error > SHARE:
                found.setdefault(name, np.nan)
    if not suspected:
        return found
    best, moves = suspected[0], bool(found)
    reach, hidden = known.within_reach(best, size), HIDES.get(untagged(best.group)[0])
    hides = np.array([kind == hidden for kind in kinds], bool) if kinds else np.zeros(len(names), bool)
    may_be_off = hides & (moves | reach | known.depend(len(names)))
    if not explains(best):
        may_be_off |= reach
    return found | {name: np.nan for name, may in zip(names, may_be_off, strict=True) if may and name not in found}


def _clear(misfits: Sequence[Misfit]) -> list[Misfit]:
    """Of every joint the group that explains most, and those that explain nearly as much; what explains less is not
    needed, nor what explains less than idle columns would."""
    found = [one for one in significant(misfits) if one.evidence > 0]
    most = {untagged(one.group)[1]: one.evidence for one in reversed(found)}
    return [one for one in found if one.evidence >= ALIKE * most[untagged(one.group)[1]]]


def _suspected(misfits: Sequence[Misfit]) -> list[Misfit]:
    """Of those that are clear the ones that leave nothing to others, if there are any; where none is clear, but one is
    significant, the one that good data would show most rarely."""
    found = _clear(misfits) or sorted(significant(misfits), key=lambda one: one.p)[:1]
    return [one for one in found if explains(one)] or found


def explains(misfit: Misfit) -> bool:
    """Whether hardly anything is left beside it."""
    return misfit.left <= LEAVES * max(misfit.evidence, 0)


def culprits(misfits: Sequence[Misfit]) -> str:
    """What is missing, in words."""
    by_joint: dict[int | None, list[str]] = {}
    for one in _suspected(misfits):
        by_joint.setdefault(untagged(one.group)[1], []).append(what(one.group))
    return " and ".join(" or ".join(names) for names in by_joint.values())


def in_words(misfits: Sequence[Misfit], off: Mapping[str, float]) -> str:
    """Why these parameters cannot be trusted; empty where none is off."""
    if not off:
        return ""
    best = _suspected(misfits)[0]
    known = {name: share for name, share in off.items() if np.isfinite(share)}
    changes = largest_of(known, lambda name, share: f"{name} would change by {_by(best, share)}")
    open_ones = [name for name, share in off.items() if not np.isfinite(share)]
    if len(open_ones) > MOST_NAMED:
        open_ones[MOST_NAMED:] = [f"{len(open_ones) - MOST_NAMED} more"]
    changes += [f"how far {listed(open_ones)} would change cannot be told"] if open_ones else []
    more = "" if explains(best) else "; it lacks more than that"
    return f"the model lacks {culprits(misfits)}: {', '.join(changes)}{more}"


def largest_of(shares: Mapping[str, float], said: Callable[[str, float], str]) -> list[str]:
    """What is said of the parameters with the largest shares, in the order given, and how many more there are."""
    chosen = sorted(shares, key=lambda name: -abs(shares[name]))[:MOST_NAMED]
    words = [said(name, share) for name, share in shares.items() if name in chosen]
    return [*words, f"and {len(shares) - MOST_NAMED} more"] if len(shares) > MOST_NAMED else words


def _by(misfit: Misfit, share: float) -> str:
    if untagged(misfit.group)[0] in AT_ENDS:
        return f"up to {abs(share):.0%} at the ends of the record"
    return f"{share:+.0%}"


def by_bands(bands: Bands | None, names: Sequence[str], units: Sequence[str], ordinary: bool = False) -> dict[str, str]:
    """Parameters that depend on the frequencies that least squares weighs, and how, in words.

    **Arguments:** whether the estimates are `ordinary`, so that the others are those to compare with.
    """
    if bands is None:
        return {}
    other, counts = ("generalised", "less") if ordinary else ("ordinary", "more")
    found, usual = (bands.generalised, bands.ordinary) if ordinary else (bands.ordinary, bands.generalised)
    return {
        name: f"{name} depends on the frequency ({other} least squares, which counts slow motion {counts}, finds "
        f"{found[k]:.3g} and not {usual[k]:.3g} {unit})"
        for k, (name, unit) in enumerate(zip(names, units, strict=True))
        if bands.apart(k)
    }


def missing(misfits: Sequence[Misfit], off: Mapping[str, float]) -> tuple[str, str]:
    """Why these parameters cannot be trusted, and what to do; empty where none is off."""
    return (in_words(misfits, off), remedy(_suspected(misfits)[0].group)) if off else ("", "")


def harmless(
    misfits: Sequence[Misfit],
    names: Sequence[str],
    size: Numbers,
    kinds: Sequence[str] = (),
    known: Known = NOTHING_KNOWN,
) -> str:
    """What is missing, but moves no parameter beyond error and `SHARE` if it is that: a note."""
    if not _suspected(misfits) or off_by(misfits, names, size, kinds, known):
        return ""
    looks = f"the model lacks something, which looks like {culprits(misfits)}"
    if not explains(_suspected(misfits)[0]):
        return f"{looks}, but is more than that; it is small, but how far parameters are off cannot be told"
    return (
        f"{looks}; if it is that, no parameter is off by more than {SHARE:.0%} or beyond error; if it is something "
        "else, how far they are off cannot be told"
    )


def open_moves(
    misfits: Sequence[Misfit],
    names: Sequence[str],
    size: Numbers,
    kinds: Sequence[str] = (),
    known: Known = NOTHING_KNOWN,
) -> tuple[Numbers, str]:
    """(p,) by how much parameters that stay trusted are off if it is one of the suspects, which is not certain: the
    largest move beyond its error; and a note on that."""
    off, moves = off_by(misfits, names, size, kinds, known), np.zeros(len(names))
    for one in _suspected(misfits):
        moves = np.maximum(moves, np.where(np.abs(one.move) > ERRORS * one.stderr, np.abs(one.move), 0))
    moves = np.where([name in off for name in names], 0, moves)
    shares = {name: x / s for name, x, s in zip(names, moves, size, strict=True) if x > 0 and s > 0}
    noticeable = {name: share for name, share in shares.items() if share >= FAINT}
    if not noticeable:
        return moves, ""
    shown = ", ".join(largest_of(noticeable, lambda name, share: f"{name} by {share:.1%}"))
    return moves, f"standard errors have grown by what the model may lack, which would move {shown}"


def unnoticed(
    misfits: Sequence[Misfit],
    names: Sequence[str],
    size: Numbers,
    kinds: Sequence[str] = (),
    spared: Container[str] = (),
) -> str:
    """How late the torque might come, and how far each parameter might be off, without any test noticing it: twice the
    largest error of a move.

    **Arguments:** `spared` names of which nothing is said.
    """
    if not misfits:
        return ""
    size = np.array([np.inf if name in spared or not s > 0 else s for name, s in zip(names, size, strict=True)])
    shares = ERRORS * np.array([one.stderr for one in misfits]) / size
    worst = misfits[int(np.argmax(shares.max(axis=1)))]
    most = {name: float(part) for name, part in zip(names, shares.max(axis=0), strict=True) if part > SHARE}
    blinded = largest_of(most, lambda name, part: f"{name} by {_share(part)}")
    said = [_unnoticed_delay(misfits, size, kinds)]
    said += [f"{what(worst.group)}, say, could move {', '.join(blinded)} unnoticed"] if blinded else []
    return f"this motion cannot show everything: {'; '.join(filter(None, said))}" if any(said) else ""


def _unnoticed_delay(misfits: Sequence[Misfit], size: Numbers, kinds: Sequence[str]) -> str:
    """The longest delay that every second record would not show, of the joint that shows it least; empty where it moves
    no parameter by more than `SHARE`.

    To slow motion a spring k in series is a delay of 2 damping / k; it hides stiffness / k of the stiffness.
    """
    of, errors = dict(zip(kinds, size, strict=False)), noticed(misfits)
    late: dict[str, float] = {}
    for one in misfits:
        if is_delay(one.group) and owner(one.group) != ROBOT and (errors * one.stderr > SHARE * size).any():
            column = 1.0 if owner(one.group) else of.get("inertia", np.inf)  # of an arm the torque's own slope
            late[one.group] = errors * float(one.weights_stderr[0]) / column
    if not late or not max(late.values()):
        return ""
    group = max(late, key=late.__getitem__)
    whose = f" of {owner(group)}" if owner(group) else ""
    text = f"a delay{whose} of up to {1e3 * late[group]:.2g} ms would go unnoticed"
    if not owner(group) and np.isfinite([of.get(kind, np.inf) for kind in ("damping", "stiffness")]).all():
        hidden = late[group] * of["stiffness"] / (2 * of["damping"])
        if hidden > SHARE:
            whole = f"up to {hidden:.0%} of the stiffness" if hidden < 1 else "all of the stiffness"
            text += f", and so would what yields as much and hides {whole}"
    return text


def _share(part: float) -> str:
    return f"{part:.0%}" if part < 1 else "more than itself"
