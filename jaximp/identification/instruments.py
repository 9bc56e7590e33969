"""What moves a joint: motion that is imposed, or a free joint, which the noise of its own torque moves too.

Least squares take motion that noise made for one of the experiment: of a free joint they are biased towards minus the
impedance of whatever else holds it. The part of the motion that follows a commanded torque (or a position that a
controller was asked for) knows nothing of that noise.

**Instrumental variables.** With Z the model's columns of that part of the motion, and W those of all of it, they solve
Z'(y - W theta) = 0. The same theta solves least squares of y - (W - Z) theta on Z: rows of a motion that is imposed, by
which noise is estimated and tests are made as in any other recording. Every window then solves the first equation.

**Without a reference** noise e moves the joint by -e / (I s^2 + B s + K) at most, if nothing else holds it. With N the
columns of that motion, least squares are off by (W'W)^-1 N'e.

**Source:** two-stage least squares (Theil 1953); in rows whose noise is white (Young 1976, refined instrumental
variables); the test of Durbin, Wu and Hausman by added columns W - Z (Hausman 1978, 2.2); strength by Cragg and Donald
1993, with the limit of Staiger and Stock 1997.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import equinox as eqx
import numpy as np
from numpy.typing import NDArray

from jaximp import signals
from jaximp.identification.misfit import Tests
from jaximp.identification.pipeline import FREELY, IMPOSED, Pipeline
from jaximp.identification.rows import Rows, measure, measured_motion, regress
from jaximp.identification.suspects import behind_filters
from jaximp.identification.whitening import White, whiten
from jaximp.least_squares.window import SlidingFit
from jaximp.models.base import Joints, Model
from jaximp.trust.score_tests import ERRORS, SHARE, Misfit, significant
from jaximp.types import Numbers, Recording

LONGEST, FEWEST = 4.0, 8
"""Seconds of a piece of which spectra are made at most, and how many lie in half a record, half overlapping."""
CHANCE, SILENT = 0.01, 1e-6
"""Frequencies are left out where noise would share as much in so many of all cases, or where the reference has such a
share of its largest density: its windows leak."""
WEAK = 10.0
"""Instruments with a smaller F in the first stage are weak."""
ROUNDS = 2
"""How often the noise is estimated again with the parameters that its last estimate gave."""
DEPENDENT = 1e-9
"""Smallest eigenvalue of columns of unit size."""
LATER = (0.01, 0.02, 0.04)
"""How much later the motion is looked at [s]."""
RARELY, CLEARLY_MORE = 1e-3, 1.1
"""Good records show as much with this probability; and by so much later motion explains more than any suspect: noise
of the torque that moves the joint 1.1 to 6 times as much, a delay or a cuff at most 1.03 times."""
FAR = 0.2
"""A bias to first order is no bound if it is a larger share of any parameter."""
KINDS = ("inertia", "damping", "stiffness")
MOVED = "the joint is free, and noise of its torque may move it"
REMEDY = "map a command or reference column, which instrumental variables need, or impose the motion"
FREE = (
    "the joint is free and no command or reference is mapped: least squares take motion that its own torque makes for"
    " that of the experiment"
)


@dataclass(frozen=True)
class Drive:
    """What is known of what moves one joint."""

    source: str | None = None
    """The channel that its instruments come from: `command` or `reference`."""
    strength: float = np.inf
    """Least F of the first stage, of any combination of columns, over the whole record."""
    W: Numbers | None = None
    """(N, p) columns of the motion as it was, where the rows are those of the part that the reference explains."""
    torque: Numbers | None = None
    """(N,) beside it [N m]."""
    own: Numbers | None = None
    """(N, p) columns of what the reference does not explain of the motion, where the rows are those of all of it."""
    off: Numbers | None = None
    """(p,) by how much parameters may be off, since the joint is free and nothing is known of its own motion; NaN where
    that cannot be told."""
    failed: str = ""
    """Why there are no instrumental variables of a free joint that has a reference."""
    note: str = ""

    def off_by(self, names: Sequence[str], size: Numbers, errors: Numbers) -> dict[str, str]:
        """Parameters that cannot be trusted because the joint is free, and by how much they may be off, in words.

        **Arguments:** usual `size` (p,) of the parameters, and the standard `errors` (p,) of their means.
        """
        found = {}
        for name, off, whole, error in zip(names, self.off if self.off is not None else (), size, errors, strict=False):
            if np.isnan(off):
                found[name] = f"how far {name} is off cannot be told"
            elif abs(off) > max(SHARE * whole, ERRORS * error):
                found[name] = f"{name} may be off by up to {off / whole:+.0%}"
        return found


def source_of(recording: Recording) -> str | None:
    """Which channel says what was asked of the joint."""
    return next((name for name in ("command", "reference") if getattr(recording, name) is not None), None)


def explained_motion(recording: Recording, source: str) -> Numbers:
    """(N, n) the part of every joint's position that follows its own reference.

    Each half of the record is explained with the frequency response of the other half: what its noise made of the
    response has then nothing to do with its own noise. Where position and reference share little the response is
    shrunk, so that its errors add no motion.
    """
    r, q = (signals.fill_gaps(x, recording.valid) for x in (getattr(recording, source), recording.position))
    return np.stack([_explained(*pair, recording.sample_rate) for pair in zip(r.T, q.T, strict=True)], axis=1)


def _explained(r: Numbers, q: Numbers, rate: float) -> Numbers:
    from scipy.signal import fftconvolve

    half = len(q) // 2
    segment = 2 * max(2, int(min(LONGEST * rate, 2 * half / (FEWEST + 1))) // 2)
    parts = slice(half), slice(len(q) - half, None)
    first, second = (fftconvolve(r - r.mean(), _response(r[k], q[k], segment), mode="same") for k in parts)
    middle = ((np.arange(len(q)) - half) / segment + 0.5).clip(0, 1)
    return np.asarray(q.mean() + second + (first - second) * np.sin(np.pi / 2 * middle) ** 2)


def _response(r: Numbers, q: Numbers, segment: int) -> Numbers:
    """(segment + 1,) of the position to an impulse of the reference, to both sides of it."""
    from scipy.signal import csd, welch

    of = {"nperseg": segment, "detrend": "constant"}
    power, answer, both = welch(r, **of)[1], welch(q, **of)[1], csd(r, q, **of)[1]
    pieces = max(2, 2 * len(r) // segment - 1)
    product = power * answer
    shared = np.abs(both) ** 2 / np.where(product > 0, product, np.inf)
    # Of the square of the response so much is its error: Wiener's filter leaves the rest.
    error = (1 - shared) / ((pieces - 1) * np.where(shared > 0, shared, np.inf))
    related = (shared > 1 - CHANCE ** (1 / (pieces - 1))) & (power > SILENT * power.max())
    kept = np.where(related, (1 - error).clip(0, 1), 0.0)
    response = np.fft.irfft(kept * both / np.where(power > 0, power, np.inf), segment)
    around = np.roll(response, segment // 2)
    return np.append(around, 0.0)


def find_drives(
    pipeline: Pipeline, recording: Recording, rows: Rows, joints: Sequence[tuple[int, slice] | None]
) -> tuple[Rows, tuple[Drive, ...], Recording | None]:
    """Rows of the motion that is explained, what is known of what moves each of the `joints` (`columns_by_joint`), and
    the recording with that motion, where every joint has instruments."""
    source, free = source_of(recording), pipeline.drive == FREELY
    if pipeline.drive == IMPOSED or (source is None and not free):
        return rows, (), None
    explained = None if source is None else exogenous(recording, source)
    Z = None if explained is None else np.asarray(regress(measure(pipeline, explained))[0].W)
    whole, drives = (rows.W, rows.torque, rows.noisy), []
    for place in joints:
        one = rows if place is None else rows.of_joint(*place)
        own = pipeline if place is None else replace(pipeline, model=_side_by_side(pipeline.model)[place[0]])
        if Z is None or source is None:
            drives.append(may_be_off(own, one))
            continue
        of_reference = Z if place is None else Z[:, place[0], place[1]]
        if not free:
            drives.append(Drive(source, own=np.asarray(one.W) - of_reference))
            continue
        found, drive = moved_by_itself(own, one, of_reference, source)
        drives.append(drive)
        if drive.W is not None:
            whole = _with_joint(whole, found, place)
    W, torque, noisy = whole
    if not all(drive.W is not None for drive in drives):
        explained = None
    return replace(rows, W=W, torque=torque, noisy=noisy), tuple(drives), explained


def _side_by_side(model: Model) -> tuple[Model, ...]:
    assert isinstance(model, Joints)
    return model.models


def _with_joint(whole: tuple[Any, Any, Any], found: Rows, place: tuple[int, slice] | None) -> tuple[Any, Any, Any]:
    """Columns, torque and noise of all joints with those of one."""
    new = found.W, found.torque, found.noisy
    if place is None:
        return new
    j, columns = place
    W, torque, noisy = (np.array(x) for x in whole)
    W[:, j, columns], torque[:, j], noisy[:, j, columns] = new
    return W, torque, noisy


def exogenous(recording: Recording, source: str) -> Recording:
    """With the part of the motion that a channel explains, in which there is no noise of the position."""
    position = np.where(recording.valid[:, None], explained_motion(recording, source), np.nan)
    return replace(recording, position=position, position_noise=np.zeros(recording.n_joints), stated_noise=None)


def moved_by_itself(pipeline: Pipeline, rows: Rows, Z: Numbers, source: str) -> tuple[Rows, Drive]:
    """Rows and instruments of one free joint, by the columns `Z` (N, p) of what its reference explains.

    Where these are weak the rows stay as they are, and nothing can be trusted.
    """
    W, y, counts = (np.asarray(x) for x in (rows.W, rows.torque, rows.valid))
    theta, strength, found = instrumental(W[counts], y[counts], Z[counts]), 0.0, rows
    for _ in range(ROUNDS):
        if theta is None:
            break
        found = replace(rows, W=Z, torque=y - (W - Z) @ theta, noisy=np.zeros_like(Z))
        white = whiten(pipeline, found)
        of_motion = white.apply(np.concatenate([W, y[:, None]], axis=1), counts)[counts]
        instruments = np.asarray(white.W)[counts]
        strength = strength_of(of_motion[:, :-1], instruments, white.every)
        theta = instrumental(of_motion[:, :-1], of_motion[:, -1], instruments)
    if theta is None or strength < WEAK:
        why = f"the {source} explains too little of the motion for instrumental variables (F = {strength:.2g})"
        return rows, Drive(source, strength, failed=why)
    found = replace(found, torque=y - (W - Z) @ theta)
    return found, Drive(source, strength, W, y, note=_compared(pipeline, rows, W - Z, theta, source))


def _compared(pipeline: Pipeline, rows: Rows, own: Numbers, theta: Numbers, source: str) -> str:
    """By how much least squares would be off, if `theta` (p,) is right."""
    by = f"the joint is free: estimates are instrumental variables by the {source}"
    tests = Tests.of(pipeline, whiten(pipeline, rows), rows.valid, [("drive", {0: own})])()
    if not tests:
        return by
    move, error = tests[0].move, tests[0].stderr
    far = (np.abs(move) > ERRORS * error) & (np.abs(move) > SHARE * np.abs(theta)) & (theta != 0)
    shares = [f"{pipeline.model.names[k]} by {-move[k] / theta[k]:+.0%}" for k in np.flatnonzero(far)]
    if not shares:
        return f"{by}; least squares find the same, within {SHARE:.0%} or error"
    return f"{by}; least squares would be off: {', '.join(shares)}"


def instrumental(W: Numbers, y: Numbers, Z: Numbers) -> Numbers | None:
    """(p,) with which instruments Z (N, p) have nothing in common with what is left of y (N,); None where they are too
    few."""
    size = np.sqrt((Z**2).sum(axis=0))
    if not (size > 0).all() or np.linalg.svd(Z / size, compute_uv=False)[-1] < DEPENDENT:
        return None
    return np.asarray(np.linalg.solve((Z / size).T @ W, (Z / size).T @ y))


def strength_of(W: Numbers, Z: Numbers, every: int) -> float:
    """Least eigenvalue of the first stage's F, of rows (N, p) of which `every` neighbours say as much as one."""
    from scipy.linalg import eigh

    size = np.sqrt((W**2).sum(axis=0))
    W = W / np.where(size > 0, size, 1)
    explained = Z @ np.linalg.lstsq(Z, W)[0]
    left = W - explained
    moving = (left**2).sum(axis=0) > DEPENDENT
    if not moving.any():
        return np.inf
    p = int(moving.sum())
    of_noise = left[:, moving].T @ left[:, moving] + DEPENDENT * np.eye(p)
    freedom = len(W) / every - W.shape[1]
    least = eigh(explained[:, moving].T @ explained[:, moving], of_noise, eigvals_only=True)[0]
    return float(least * freedom / p)


def in_windows_of(
    fit: SlidingFit, W: Numbers, y: Numbers, Z: Numbers, seen: Numbers, valid: NDArray[np.bool_]
) -> SlidingFit:
    """Instrumental variables in the windows of a fit.

    **Arguments:** columns `W` (N, p), torque `y` (N,) and instruments `Z` (N, p) in the rows that were solved, and the
    torque `seen` (N,) that the fit explained by Z. Its standard errors grow by what Z'W and the rest of y make of them.
    """
    p, start, end = W.shape[1], np.asarray(fit.first), np.asarray(fit.last) + 1
    size = np.sqrt((Z[valid] ** 2).mean(axis=0))
    columns = np.where(valid[:, None], np.column_stack([W / size, Z / size, y, seen]), 0)
    products = np.empty((len(start), 2 * p + 2, 2 * p + 2))
    for i in range(2 * p + 2):
        for j in range(i, 2 * p + 2):
            before = np.concatenate([np.zeros(1), np.cumsum(columns[:, i] * columns[:, j])])
            products[:, i, j] = products[:, j, i] = before[end] - before[start]
    theta, stderr = np.array(fit.theta), np.array(fit.stderr)
    known = np.isfinite(theta).all(axis=1) & (stderr > 0).all(axis=1)
    products, of_motion, of_reference = products[known], slice(p), slice(p, 2 * p)
    inverse = np.linalg.pinv(products[:, of_reference, of_motion])
    gram = products[:, of_reference, of_reference]
    found = (inverse @ products[:, of_reference, 2 * p, None])[..., 0]
    left = _left(products, np.arange(p), 2 * p, found)
    left_by_fit = _left(products, np.arange(p, 2 * p), 2 * p + 1, theta[known] * size)
    variance, plain = (np.einsum("kii->ki", x) for x in (inverse @ gram @ inverse.swapaxes(1, 2), np.linalg.pinv(gram)))
    with np.errstate(invalid="ignore", divide="ignore"):
        grown = np.sqrt(variance / plain * (left / left_by_fit)[:, None])
    theta[known], stderr[known] = found / size, stderr[known] * grown
    return eqx.tree_at(lambda f: (f.theta, f.stderr), fit, (theta, stderr))


def _left(products: Numbers, columns: NDArray[np.int64], torque: int, theta: Numbers) -> Numbers:
    """(K,) sum of squares that parameters leave of a torque, by the sums of products of windows."""
    gram, moment = products[:, columns[:, None], columns], products[:, columns, torque]
    explained = np.einsum("ki,kij,kj->k", theta, gram, theta)
    return np.asarray(products[:, torque, torque] - 2 * (theta * moment).sum(axis=1) + explained)


# ---- Nothing is known of the motion ----------------------------------------------------------------------------------


def may_be_off(pipeline: Pipeline, rows: Rows) -> Drive:
    """By how much least squares of one free joint may be off, if noise of its torque moves it."""
    kinds = [role.kind for role in pipeline.model.roles]
    if pipeline.model.memory or not {"inertia", "damping", "stiffness"} <= set(kinds):
        return Drive(note=f"{FREE}; by how much is worked out for a joint of inertia, damping and stiffness alone")
    W, y, counts = (np.asarray(x) for x in (rows.W, rows.torque, rows.valid))
    white = whiten(pipeline, rows)
    of_white = np.asarray(white.W)[counts]
    found = theta = np.linalg.lstsq(of_white, np.asarray(white.torque)[counts])[0]
    rate, place = pipeline.sample_rate / pipeline.filters.decimate, [kinds.index(k) for k in KINDS]
    for _ in range(ROUNDS):
        left = np.where(counts, y - W @ theta, 0)
        own = np.zeros_like(W)
        own[:, place] = moved_by(left, theta[place], rate)
        both = white.apply(np.concatenate([own, left[:, None]], axis=1), counts)[counts]
        off = np.linalg.solve(of_white.T @ of_white, both[:, :-1].T @ both[:, -1])
        theta = found - off
    off[[k for k, kind in enumerate(kinds) if kind not in KINDS]] = 0.0
    if (np.abs(off[place]) > FAR * np.abs(theta[place])).any():
        off[place] = np.nan
    return Drive(off=off, note=FREE)


def belongs_with_later_motion(
    pipeline: Pipeline, recording: Recording, rows: Rows, white: White, misfits: Sequence[Misfit]
) -> bool:
    """Whether what is left of one joint's torque has more to do with where the joint goes than with any suspect.

    A motion that is imposed knows nothing of the torque's noise before or after; what comes late or yields explains as
    much by itself. **Arguments:** what the model may lack, `misfits`.
    """
    if not significant(misfits):
        return False
    q = measured_motion(pipeline.filter, recording).position[:, 0]
    ahead = [round(seconds * recording.sample_rate) for seconds in LATER]
    later = behind_filters(pipeline.filters, [np.append(q[k:], np.full(k, q[-1])) for k in ahead])
    found = Tests.of(pipeline, white, rows.valid, [("later motion", {0: later})])()
    most = max(one.evidence for one in misfits)
    return bool(found) and found[0].p < RARELY and found[0].evidence > CLEARLY_MORE * max(most, 0)


def moved_by(torque: Numbers, theta: Numbers, rate: float) -> Numbers:
    """(N, 3) acceleration, velocity and position of a joint of inertia, damping and stiffness `theta` (3,), which
    nothing else holds and which makes this torque (N,) of its own."""
    s = 2j * np.pi * np.fft.rfftfreq(2 * len(torque), 1 / rate)
    answer = -np.fft.rfft(torque, 2 * len(torque)) / (theta[0] * s**2 + theta[1] * s + theta[2])
    return np.stack([np.fft.irfft(answer * s**k)[: len(torque)] for k in (2, 1, 0)], axis=1)
