"""The robot nearest to an estimate, and what all robots within its errors have in common: small semidefinite programs.

cvxpy states them and CLARABEL solves them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from importlib.util import find_spec
from typing import Any

import numpy as np
from jaxtyping import Num

from jaximp.consistency.cone import BASIS, Posed, pose
from jaximp.models.chain import Chain
from jaximp.models.determined import determined, sizes_of_chain
from jaximp.models.spatial import NEVER_NEGATIVE
from jaximp.results import Column, Result
from jaximp.types import AnyArray, Numbers, Progress, nearest

MARGIN = 1e-4
"""Smallest eigenvalue of a link's matrix, as a share of the URDF's: a hundredth of its width."""
WEAK = 1e-3
"""What a link costs that differs from the URDF's by its own size, in squared standard errors."""
NOTHING = 1e-6
"""Share of a parameter's natural size below which an end of its range is zero, up to the solver's errors."""
LARGE, LARGER, GROWS = 1e2, 1e4, 1.2
"""Where the solver finds no end, links are limited to so many times the URDF's moments: what grows by this factor from
the one to the other has none."""

TIGHT = 1e-11
"""Of the solver where a weak cost is to be seen."""
SOLVED = ("optimal", "optimal_inaccurate")

Masses = Mapping[str, tuple[float, float]]
"""Least and most mass [kg] of links by name (`link2`), and of all of them together (`total`)."""


@dataclass(frozen=True, eq=False)
class ConsistentFit(Result):
    """Standard parameters of the robot that is nearest to an estimate."""

    names: tuple[str, ...]
    """Of the P standard parameters."""
    units: tuple[str, ...]
    standard: Numbers
    """(P,) every link of them is a real body; what no motion shows is as near to the URDF's as can be."""
    base: Numbers
    """(p,) base parameters of these."""
    distance: float
    """From the estimate, in its standard errors: the root of `d' C^-1 d`. Near zero if the estimate is a robot's."""
    reference: Numbers
    """(P,) the URDF's own values."""
    notes: tuple[str, ...]

    @property
    def value(self) -> Numbers:
        return self.standard

    def columns(self) -> list[Column]:
        return [Column(*one) for one in zip(self.names, self.units, self.standard, strict=True)]


@dataclass(frozen=True, eq=False)
class Ranges:
    """Between which values standard parameters lie, over all robots within an estimate's errors."""

    names: tuple[str, ...]
    units: tuple[str, ...]
    low: Numbers
    """(k,) smallest values; -inf where there is none."""
    high: Numbers
    """(k,) largest values; inf where there is none."""
    determined: AnyArray
    """(k,) whether the data determine the parameter: half of the interval is at most a quarter of its middle, or for
    first moments and products of inertia of what they can be by the URDF (`models.determined`)."""
    level: float
    distance: float
    """Of the nearest robot from the estimate, in standard errors."""
    notes: tuple[str, ...]

    def columns(self) -> list[Column]:
        return [
            Column("parameter", "", list(self.names)),
            Column("unit", "", list(self.units)),
            Column("low", "", self.low),
            Column("high", "", self.high),
            Column("determined", "", self.determined),
        ]

    def in_words(self) -> list[str]:
        """A line for each, such as `mass of link 1: 0 to 51 kg: not determined`; masses come first."""
        order = sorted(range(len(self.names)), key=lambda k: not self.names[k].endswith(".mass"))
        return [*self.notes, *(self._line(k) for k in order)]

    def _line(self, k: int) -> str:
        low, high, unit = self.low[k], self.high[k], self.units[k]
        if np.isnan(low) or np.isnan(high):
            text = "no answer from the solver"
        elif np.isinf(low) and np.isinf(high):
            text = "anything"
        elif np.isinf(high):
            text = f"{low:.3g} {unit} or more"
        elif np.isinf(low):
            text = f"{high:.3g} {unit} or less"
        else:  # so that the width has two figures
            digits = max(0, 1 - int(np.floor(np.log10(high - low)))) if high > low else 6
            text = f"{low:.{digits}f} to {high:.{digits}f} {unit}"
        return f"{spoken(self.names[k])}: {text}{'' if self.determined[k] else ': not determined'}"


def spoken(name: str) -> str:
    """`link1.mass` as `mass of link 1`."""
    owner, _, what = name.partition(".")
    kind = owner.rstrip("0123456789")
    return f"{what.replace('_', ' ') if kind == 'joint' else what} of {kind} {owner[len(kind) :]}"


def consistent_fit(
    chain: Chain,
    estimate: Num[AnyArray, " p"],
    covariance: Num[AnyArray, "p p"],
    *,
    masses: Masses | None = None,
    weight: float = WEAK,
) -> ConsistentFit:
    """The robot nearest to an estimate of base parameters: every link a real body, no friction below zero.

    Nearest is meant in the metric of the covariance. Among robots that are as near, the one nearest to the URDF's own
    values is taken, in the affine-invariant distance of each link's moments: its `weight` is so small that a link
    may differ by its own size before it moves the estimate by a thirtieth of a standard error. Without it nothing
    would hold the parameters that no motion shows, and a link weighs tons.

    **Arguments:** estimates (p,) of `chain.names` with their covariance (p, p), NaN where there is none; `masses` that
    are known, such as `{"total": (20, 33)}` from a data sheet.

    **Raises:** `ValueError` in one line for shapes that do not fit, a covariance that is not positive definite, masses
    that no robot can have, and without cvxpy.

    **Source:** Sousa and Cortesão 2014 (base parameters within the cone); Wensing, Kim and Slotine 2018, eq. (8); Lee,
    Wensing and Park 2020 (distance).
    """
    posed = pose(chain, estimate, covariance)
    y, distance = nearest_robot(posed, masses, MARGIN, weight)
    standard = posed.standard(y)
    standard[posed.cone.positive] = np.maximum(standard[posed.cone.positive], 0.0)
    base = np.asarray(chain.base.map, float) @ standard
    own = np.asarray(chain.standard_parameters, float)
    return ConsistentFit(posed.cone.names, posed.cone.units, standard, base, distance, own, posed.cone.notes)


def consistent_ranges(
    chain: Chain,
    estimate: Num[AnyArray, " p"],
    covariance: Num[AnyArray, "p p"],
    names: Sequence[str] | None = None,
    *,
    masses: Masses | None = None,
    level: float = 0.95,
    simultaneous: bool = False,
    progress: Progress | None = None,
) -> Ranges:
    """Smallest and largest value of standard parameters over all robots within the errors of an estimate.

    Each interval alone holds its truth with the probability `level`, as intervals of estimates do: robots count whose
    base parameters are no farther from the estimate than the quantile of chi squared with one degree of freedom
    (profile likelihood). With `simultaneous=True` all intervals hold their truth at once with that probability: robots
    count in the whole region of the estimate, with as many degrees of freedom as there are base parameters. Where the
    estimate itself is no robot's, distances count beyond that of the nearest one.

    **Arguments:** as `consistent_fit`; `names` of standard parameters, all by default, such as those of
    `chain.base.standard_names` that end in `.mass`.

    **Raises:** as `consistent_fit`, and `ValueError` for an unknown name or a level that does not lie between 0 and 1.
    """
    from scipy.special import chdtri

    if not 0 < level < 1:
        raise ValueError(f"level is {level}: it must lie between 0 and 1")
    posed = pose(chain, estimate, covariance)
    cone, known = posed.cone, list(posed.cone.names)
    names = tuple(known if names is None else names)
    for name in names:
        if name not in known:
            raise ValueError(f"there is no standard parameter '{name}': {nearest(name, known)}")
    _, distance = nearest_robot(posed, masses, MARGIN, WEAK)
    region = float(chdtri(posed.known, 1 - level)) if posed.known else 0.0
    farther = region if simultaneous else min(region, float(chdtri(1, 1 - level)))
    radius = float(np.sqrt(distance**2 + farther))
    search, ends = _Search(posed, masses, radius), []
    for k, name in enumerate(names):
        row = posed.slope[known.index(name)]
        ends.append((-search.most(-row), search.most(row)))
        if progress is not None:
            progress((k + 1) / len(names))
    index = [known.index(name) for name in names]
    low, high = np.array(ends, float).reshape(-1, 2).T + posed.offset[index]
    natural = np.linalg.norm(cone.scale[index], axis=1)
    low, high = (np.where(abs(x) < NOTHING * natural, 0.0, x) for x in (low, high))
    signed = ~cone.positive[index] & ~np.array([name.rpartition(".")[2] in NEVER_NEGATIVE for name in names], bool)
    low = np.where(signed, low, np.maximum(low, 0.0))
    known_by_data = determined(low, high, sizes_of_chain(chain, np.eye(len(known))[index]))
    units, notes = tuple(cone.units[k] for k in index), list(cone.notes)
    if distance**2 > region:
        notes.append(
            f"no real robot lies within the errors of the estimate: the nearest is {distance:.3g} standard errors "
            "away; errors are claimed too small, or the model lacks something"
        )
    return Ranges(names, units, low, high, known_by_data, level, distance, tuple(notes))


class _Program:
    """The cone in the coordinates of an estimate, for one objective after another."""

    def __init__(
        self,
        posed: Posed,
        masses: Masses | None,
        margin: float,
        radius: float | None = None,
        largest: float | None = None,
    ):
        if find_spec("cvxpy") is None:
            raise ValueError("real bodies are found by semidefinite programs: pip install 'jaximp[robots]'")
        import cvxpy as cp

        self.cp, self.posed = cp, posed
        self.y = y = cp.Variable(len(posed.start))
        cone, constraints = posed.cone, []
        for k in range(cone.n_bodies):
            at = slice(10 * k, 10 * k + 10)
            fixed = np.eye(4) + np.tensordot(posed.start[at], BASIS, 1)
            moving = np.tensordot(posed.map[at].T, BASIS, 1).reshape(-1, 16).T
            link = cp.reshape(moving @ y, (4, 4), order="C") + fixed
            constraints += [link >> margin * np.eye(4)] + [cp.trace(link) <= largest] * (largest is not None)
        if cone.positive.any():
            sizes = np.diag(cone.scale)[cone.positive]
            constraints.append(
                (posed.slope[cone.positive] / sizes[:, None]) @ y + posed.offset[cone.positive] / sizes >= 0
            )
        for row, value, least, most in _limits_of_masses(posed, masses):
            constraints += [row @ y + value >= least] * (least > 0) + [row @ y + value <= most] * bool(
                np.isfinite(most)
            )
        if radius is not None and posed.known:
            constraints.append(cp.norm(y[: posed.known]) <= radius)
        self.constraints = constraints
        self.direction = cp.Parameter(len(posed.start))
        self.linear = cp.Problem(cp.Maximize(self.direction @ y), constraints)

    def most(self, direction: Numbers, accepted: Sequence[str] = ("optimal",)) -> float:
        """Largest product of y and a direction; inf without bound, NaN without an answer that is accepted."""
        length = float(np.linalg.norm(direction))
        if length == 0:
            return 0.0
        self.direction.value = direction / length
        status = _solve(self.cp, self.linear)
        if status == "unbounded":
            return np.inf
        return float(self.linear.value) * length if status in accepted else np.nan


class _Search:
    """Ends of ranges, whether there are any or not."""

    def __init__(self, posed: Posed, masses: Masses | None, radius: float):
        self.free = _Program(posed, masses, 0.0, radius)
        self.make = lambda largest: _Program(posed, masses, 0.0, radius, largest)

    @cached_property
    def limited(self) -> list[_Program]:
        return [self.make(largest) for largest in (LARGE, LARGER)]

    def most(self, direction: Numbers) -> float:
        """As `_Program.most`. What grows without bound but ever slower, such as a first moment with the root of the
        second one, the solver cannot tell: there the limits decide."""
        found = self.free.most(direction)
        if not np.isnan(found):
            return found
        near, far = (program.most(direction, SOLVED) for program in self.limited)
        return np.inf if abs(far) > GROWS * abs(near) else far


def nearest_robot(posed: Posed, masses: Masses | None, margin: float, weight: float) -> tuple[Numbers, float]:
    """(P,) the numbers of the nearest robot, and its distance from the estimate."""
    program = _Program(posed, masses, margin)
    cp, k = program.cp, posed.known
    costs = [
        scale * cp.sum_squares(part) for scale, part in ((1.0, program.y[:k]), (weight, program.y[k:])) if part.size
    ]
    problem = cp.Problem(cp.Minimize(sum(costs)), program.constraints)
    status = _solve(cp, problem, tol_gap_abs=TIGHT, tol_gap_rel=TIGHT)
    if status not in SOLVED:
        raise ValueError(
            f"no robot was found near the estimate (the solver says {status}): widen the masses, and look for "
            "estimates that are far from what a robot can have"
        )
    y = np.asarray(program.y.value, float)
    return y, float(np.linalg.norm(y[:k]))


def _solve(cp: Any, problem: Any, **settings: float) -> str:
    """The status; the solver's own warnings are kept from the terminal."""
    import warnings

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            problem.solve(solver=cp.CLARABEL, **settings)
        except cp.error.SolverError:
            return "failed"
    return str(problem.status)


def _limits_of_masses(posed: Posed, masses: Masses | None) -> list[tuple[Numbers, float, float, float]]:
    """Row, value at zero, least and most of every mass that is limited."""
    slope, offset, n = posed.slope, posed.offset, posed.cone.n_bodies
    links = {f"link{k + 1}": [10 * k] for k in range(n)} | {"total": list(range(0, 10 * n, 10))}
    rows = []
    for name, limits in (masses or {}).items():
        if name not in links:
            raise ValueError(f"masses has '{name}': {nearest(name, list(links))}")
        least, most = limits
        if not 0 <= least <= most or not most > 0:
            raise ValueError(f"masses has {name} = ({least:g}, {most:g}) kg: give the least and the most, from zero up")
        at = links[name]
        rows.append((slope[at].sum(axis=0), float(offset[at].sum()), float(least), float(most)))
    return rows
