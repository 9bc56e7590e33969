"""Verdicts on recursive least squares: the rules of windows, and those that only a memory can break."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Num, Shaped
from numpy.typing import NDArray

from jaximp.least_squares.recursive import RecursiveFit
from jaximp.models.base import Model
from jaximp.trust.criteria import USUAL
from jaximp.trust.limits import TrustLimits
from jaximp.trust.verdicts import NO_DATA, POOR, WEAK, Rule, Verdicts, judge_all
from jaximp.trust.window_rules import RULES, Windows, measure_windows, with_usual
from jaximp.types import AnyArray, Numbers

APART = 2.0
"""Estimates so many memories apart are compared: they share e^-2 of what they know."""
CHANCE = 1e-5
"""Probability below which their difference is a change."""
FORGOTTEN = 5.0
"""Memories after which what was before a change is forgotten."""
MOST_ALIKE = 1.5
"""How many samples of noise may say as much as one: standard errors are too small by the root of it."""
FEWEST = 50
"""Samples of noise that tell whether it is white."""
LAGS = 100
"""Over so many samples noise is compared with itself."""


@dataclass(frozen=True)
class Memory(Windows):
    """What is measured of estimates from memory."""

    length: float = np.inf
    """Samples that it holds, infinite without forgetting."""
    age: Any = 0
    """Samples since the last that the estimate knows."""
    held: Any = False
    moved: Any = 0.0
    """Standard errors by which a parameter has changed, as long as the memory holds what was before; else zero."""
    mover: Any = ""
    """Which one."""
    alike: float = 1.0
    """How many neighbouring samples of noise say as much as one."""


STREAM_RULES: tuple[Rule[Any], ...] = (
    Rule(
        "a memory that motion renews",
        WEAK,
        lambda m, limits: m.held,
        lambda m, limits: f"motion has been too small for {m.age} samples: the estimate is that of before",
        lambda m, limits: "move more, or forget more slowly",
    ),
    Rule(
        "samples in place of those forgotten",
        NO_DATA,
        lambda m, limits: m.age > m.length,
        lambda m, limits: f"nothing was measured for {m.age} samples, more than the {m.length:.0f} of the memory",
    ),
    *RULES,
    Rule(
        "noise that is white",
        POOR,
        lambda m, limits: np.full(np.shape(m.vaf), m.alike > MOST_ALIKE),
        lambda m, limits: (
            f"{m.alike:.2g} samples of noise say as much as one: errors are {np.sqrt(m.alike):.2g} times too small"
        ),
        lambda m, limits: f"keep every {np.ceil(m.alike):.0f}th sample after a low-pass filter, or use windows",
    ),
    Rule(
        "parameters that the memory finds constant",
        POOR,
        lambda m, limits: m.moved > 0,
        lambda m, limits: (
            f"{m.mover} has changed by {m.moved:.2g} standard errors: the memory still holds what was before"
        ),
    ),
)
"""Those of windows stand between what leaves nothing to judge and what makes errors doubtful."""


def judge_recursive(
    fit: RecursiveFit,
    model: Model,
    W: Num[AnyArray, "N p"],
    y: Num[AnyArray, " N"],
    forgetting: float,
    *,
    valid: Shaped[AnyArray, " N"] | None = None,
    every: int = 1,
    column_noise: Num[AnyArray, " p"] | None = None,
    limits: TrustLimits = USUAL,
) -> Verdicts:
    """The verdict on every estimate of `recursive_least_squares`, or on every n-th: the first rule that it breaks.

    **Arguments:** `fit` of `W` (N, p), `y` (N,) [N m], `forgetting` and `valid`; `model` whose regressor W is; `every`
    so many samples, from the first on, one is judged; `column_noise` (p,) root mean square of each column that noise in
    the position alone gives.

    After a change the estimates are a mixture of before and after, whose errors say nothing of that: where estimates
    `APART` memories apart differ, by Student's t, they are doubtful until the memory has forgotten what was before.
    Standard errors take the noise as white: whether it is, the autocorrelation of the innovations says.

    **Source:** beyond Tout et al. 2023, who judge no recursive estimate.
    """
    W, y = np.asarray(W, float), np.asarray(y, float)
    valid = np.ones(len(y), bool) if valid is None else np.asarray(valid, bool)
    valid = valid & np.isfinite(W).all(axis=1) & np.isfinite(y)
    W, y = np.where(valid[:, None], W, 0), np.where(valid, y, 0)
    length = np.inf if forgetting == 1 else 1 / (1 - forgetting)
    moved, mover = _moved(fit, valid, forgetting, length)
    chosen = slice(None, None, every)
    some = RecursiveFit(**{name: np.asarray(value)[chosen] for name, value in vars(fit).items()})
    with np.errstate(divide="ignore", invalid="ignore"):
        scale = np.sqrt((y**2).sum() / (W**2).sum(axis=0))
    noise = np.zeros(W.shape[1]) if column_noise is None else np.asarray(column_noise, float)
    # A memory that fills is judged by what it has.
    measured = measure_windows(some, model.names, model.roles, 0, np.nan_to_num(scale, posinf=0), noise, None, limits)
    memory = Memory(
        **vars(measured),
        length=length,
        age=np.arange(len(y))[chosen] - some.renewed,
        held=some.held,
        moved=moved[chosen],
        mover=np.array(model.names)[mover[chosen]],
        alike=_alike(fit, W, y, valid, moved > 0, length),
    )
    return judge_all(STREAM_RULES, with_usual(memory, limits), limits)


def _moved(
    fit: RecursiveFit, valid: NDArray[np.bool_], forgetting: float, length: float
) -> tuple[Numbers, NDArray[np.int64]]:
    """(N,) see `Memory.moved`, and which parameter that is. Samples that are not valid have the value of the last."""
    moved, mover = np.zeros(len(valid)), np.zeros(len(valid), int)
    theta, stderr, dof, held = (np.asarray(x)[valid] for x in (fit.theta, fit.stderr, fit.dof, fit.held))
    if not APART * length < len(theta) - 1:
        return moved, mover
    from scipy.special import stdtr

    lag = max(1, round(APART * length))
    now, before = slice(lag, None), slice(None, -lag)
    variance = stderr[now] ** 2 + stderr[before] ** 2 - 2 * forgetting**lag * stderr[now] * stderr[before]
    with np.errstate(divide="ignore", invalid="ignore"):
        t = np.abs(theta[now] - theta[before]) / np.sqrt(variance)
    # What was before a rest is forgotten when the memory is filled again.
    rested = np.cumsum(held)
    known = np.isfinite(t).all(axis=1) & (rested[now] == rested[before])
    t = np.where(known[:, None], t, 0)
    freedom = np.where(known, np.minimum(dof[now], dof[before]), 1)
    largest, which = t.max(axis=1), t.argmax(axis=1)
    changed = stdtr(freedom, -largest) < CHANCE / 2 / t.shape[1]
    index = np.arange(len(t))
    last = np.maximum.accumulate(np.where(changed, index, -1))
    remembered = (last >= 0) & (index - last < FORGOTTEN * length)
    place = np.cumsum(valid) - 1 - lag
    some = place >= 0
    moved[some] = np.where(remembered, largest[last], 0)[place[some]]
    mover[some] = which[last][place[some]]
    return moved, mover


def _alike(
    fit: RecursiveFit, W: Numbers, y: Numbers, valid: NDArray[np.bool_], moved: NDArray[np.bool_], length: float
) -> float:
    """How many neighbouring samples of the noise say as much as one, where columns change slowly: twice the sum of the
    autocorrelation of the innovations, up to where it is not above zero. A change before which the memory has `moved`
    makes innovations that are alike, too, and does not count."""
    theta, size, dof = (np.asarray(x)[valid][:-1] for x in (fit.theta, fit.residual_rms, fit.dof))
    with np.errstate(divide="ignore", invalid="ignore"):
        missed = (y[valid][1:] - (W[valid][1:] * theta).sum(axis=1)) / size
    changed = np.concatenate([np.zeros(1), np.cumsum(moved[valid])])
    index = np.arange(len(missed))
    soon = np.minimum(index + 2 + round(min(length, len(missed))), len(changed) - 1)
    known = np.isfinite(missed) & (dof > W.shape[1]) & (changed[soon] == changed[index + 1])
    if known.sum() < FEWEST:
        return 1.0
    x = np.where(known, np.clip(np.where(known, missed, 0), -5, 5), 0)
    lags = min(LAGS, len(x) // 5)
    covariance = np.fft.irfft(np.abs(np.fft.rfft(x, 2 * len(x))) ** 2)[: lags + 1]
    correlation = covariance[1:] / covariance[0] if covariance[0] > 0 else covariance[1:]
    # Of white noise it scatters by one over the root of the samples.
    seen = np.minimum.accumulate(correlation > 2 / np.sqrt(known.sum()))
    return float(1 + 2 * correlation[seen].sum())
