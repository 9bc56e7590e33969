"""How fast parameters move, and where they jump: what the likelihood says of it.

A parameter that does not move is known from the whole record; one that moves is known from a stretch around each
instant, the longer the slower it moves. The length of this stretch, its memory, tells how fast it moves in a way that
depends on no unit. All lengths are tried, from a few points of the grid to the whole record, and none (the parameter
stays where it is); of smooth motion also all times in which slopes die away, and of parameters that depend on what is
measured how far their curves wander. Jumps are added where the likelihood of one at any point demands it. Around the
best model others are drawn, and weighted by their likelihood: what is not known of the drift is in the bands.

**Source:** collapsed sampling of jumps: Gerlach, Carter and Kohn 2000; importance resampling: Rubin 1987.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from numpy.typing import NDArray

from jaximp.numerics.compilation import compiled
from jaximp.tracking.blocks import Blocks
from jaximp.tracking.state_space import Motion, evidence, forward, shocks
from jaximp.types import Numbers

SHORTEST, PER_OCTAVE = 4.0, 2
"""Shortest memory, in points of the grid, and how many lengths are tried of which one is twice as long as the other."""
STAYS = 0.5
"""Probability, before anything is measured, that a parameter stays where it is."""
SPREADS = np.append(0.0, 2.0 ** np.arange(-7.0, 1.5, 0.5))
"""What is tried for how far a curve wanders from one of its coefficients to the next, in the parameter's scale."""
JUMPS = 1.0
"""How many jumps a record is expected to have, of all parameters together, before anything is measured."""
MOST_JUMPS = 16
ROUNDS = 3
"""How often the drift sizes of all parameters are looked at in turn, at most."""
LANES, DRAWN = 20, 120
"""Models that are compared side by side, and how many are drawn around the best."""
NONE = -1


@dataclass(frozen=True)
class Model:
    """One of the models of a record, or several side by side, (..., L)."""

    rate: Numbers
    """(p, L) inverse of the memory [1/points of the grid]; zero for parameters that stay."""
    at: NDArray[np.int64]
    """(J, L) points before which a parameter jumps; `NONE` for no jump."""
    which: NDArray[np.int64]
    """(J, L) the parameter."""

    decay: Numbers
    """(L,) inverse of the time in which slopes die away [1/points of the grid]; zero where they last."""
    spread: Numbers
    """(V, L) how far each of V curves wanders from one coefficient to the next."""

    def __getitem__(self, lanes: NDArray[np.int64]) -> Model:
        return Model(*(x[..., lanes] for x in vars(self).values()))

    def motion(self, information: Numbers, order: int, coefficients: Sequence[int] = ()) -> Motion:
        """The same in steps, see `step_of`. Slopes may begin with what they become within a memory, or in the end."""
        step = step_of(self.rate, information[:, None], order)
        walk, slope = (step**2, 0 * step) if order == 0 else (0 * step, step)
        memory = 1 / np.where(self.rate > 0, self.rate, 1)  # where a parameter stays its slopes do not matter
        left = np.exp(-self.decay + 0 * step)
        begins = 1 / np.maximum(1 / memory, 1 - left**2)
        spread = np.repeat(self.spread, coefficients, axis=0) if coefficients else None
        steps = Motion(walk, slope, begins, self.at, self.which, order, left if order else None, spread)
        return jax.tree.map(jnp.asarray, steps)

    def finer(self, every: int, inside: NDArray[np.int64]) -> Model:
        """On a grid with `every` points for one, jumps being at the points `inside` (J, L)."""
        at = np.where(self.at == NONE, NONE, self.at * every + inside)
        return replace(self, rate=self.rate / every, at=at, decay=self.decay / every)


def step_of(rate: Numbers, information: Numbers, order: int) -> Numbers:
    """Standard deviation of the steps with which a random walk, integrated so often, has this memory: the smoother's
    variance is that of so many points.

    **Arguments:** inverse of the memory; `information` of a point.

    **Source:** the variance `mean of 1/(information + f^(2m)/step^2)` over frequencies f of a spline of order m = order
    + 1 (Wahba 1990), which is `1/(information memory)`.
    """
    m = order + 1
    return np.asarray((2 * m * np.sin(np.pi / (2 * m)) * rate) ** m / np.sqrt(information))


def rate_of(step: Numbers, information: Numbers, order: int) -> Numbers:
    """The inverse of `step_of`; NaN remains."""
    m = order + 1
    return np.asarray((step * np.sqrt(information)) ** (1 / m) / (2 * m * np.sin(np.pi / (2 * m))))


_evidence = compiled(evidence)


@compiled
def _log_odds(blocks: Blocks, motion: Motion) -> Array:
    """(G, p) of a jump in front of each point, for the first of the models; see `Shocks`."""
    found, before = forward(blocks.rows, motion)
    scale = (found.squares + blocks.left) / blocks.freedom(len(motion.walk))
    return shocks(blocks.rows, motion, before).log_odds(scale)[..., 0]


@dataclass(frozen=True)
class Drawn:
    """Models of a record, with what each of them weighs."""

    models: Model
    log_weight: Numbers
    """(L,) logarithm of the likelihood times what a model's probability is over that of drawing it."""
    scale: Numbers
    """(L,) square of the noise's scale."""

    @property
    def weight(self) -> Numbers:
        """(L,) they sum to one."""
        return np.exp(_normalised(self.log_weight))

    @property
    def log_evidence(self) -> float:
        """Logarithm of the likelihood in the mean over all models."""
        return float(np.logaddexp.reduce(self.log_weight) - np.log(len(self.log_weight)))

    @property
    def noise(self) -> float:
        """Scale of the noise."""
        return float(np.sqrt(self.weight @ self.scale))

    def some(self, count: int) -> NDArray[np.int64]:
        """(count,) of them, each as often as it weighs."""
        even = (np.arange(count) + 0.5) / count
        return np.minimum(np.searchsorted(np.cumsum(self.weight), even), len(self.weight) - 1)


@dataclass(frozen=True)
class Search:
    """The models of one record, of one kind."""

    blocks: Blocks
    information: Numbers
    """(p,) of a point of the grid."""
    order: int
    """How often a random walk is integrated until it is a parameter."""
    choices: tuple[Numbers, ...]
    """Of each parameter the rates that are tried: the first is zero, but where the rate is given."""
    decays: Numbers
    """What is tried for `Model.decay`: the first is zero."""
    coefficients: tuple[int, ...]
    """How many each of the curves has."""
    jumping: bool
    found: dict[tuple[object, ...], Numbers] = field(default_factory=dict, compare=False, repr=False)
    """What was asked for already: by turns the same models come up again."""

    @property
    def points(self) -> int:
        return len(self.blocks.rows)

    @property
    def log_jump(self) -> float:
        """Logarithm of the probability of a jump of one parameter at one point."""
        return float(np.log(JUMPS / (self.points * max(1, self.moving.sum()))))

    @property
    def moving(self) -> NDArray[np.bool_]:
        """(p,) parameters that may move."""
        return np.array([len(some) > 1 or some[0] > 0 for some in self.choices])

    def log_prior(self, i: int) -> Numbers:
        """Of the choices of parameter i."""
        n = len(self.choices[i])
        return np.log(np.array([1.0]) if n == 1 else np.append(STAYS, np.full(n - 1, (1 - STAYS) / (n - 1))))

    def at_rest(self) -> Model:
        """The model that moves least."""
        none = np.full((MOST_JUMPS, 1), NONE)
        rate, spread = np.array([some[:1] for some in self.choices]), np.zeros((len(self.coefficients), 1))
        return Model(rate, none, np.zeros_like(none), self.decays[:1], spread)

    def motion(self, models: Model) -> Motion:
        """Of models of this record."""
        return models.motion(self.information, self.order, self.coefficients)

    def log_likelihood(self, models: Model) -> tuple[Numbers, Numbers]:
        """(L,) of each model, and the square of the noise's scale."""
        lanes, found = models.rate.shape[1], []
        for first in range(0, lanes, LANES):
            some = np.minimum(np.arange(first, first + LANES), lanes - 1)
            found.append(_evidence(self.blocks.rows, self.motion(models[some])))
        squares, determinant = (
            np.concatenate([np.asarray(getattr(one, name)) for one in found])[:lanes]
            for name in ("squares", "log_determinant")
        )
        left, freedom = float(self.blocks.left), float(self.blocks.freedom(len(self.choices)))
        scale = (squares + left) / freedom
        return determinant - freedom / 2 * np.log(scale), scale

    def log_posterior(self, model: Model) -> float:
        """Of one model."""
        choice = [int(np.argmin(np.abs(some - model.rate[i]))) for i, some in enumerate(self.choices)]
        prior = sum(self.log_prior(i)[k] for i, k in enumerate(choice))
        return float(self.log_likelihood(model)[0][0] + prior + self.log_jump * (model.at != NONE).sum())

    def of_rate(self, model: Model, i: int) -> Numbers:
        """(K,) logarithm of the probability of every choice for parameter i, all else as in the model."""
        rate = np.repeat(model.rate, len(self.choices[i]), axis=1)
        rate[i] = self.choices[i]
        return self._once(i, replace(model[np.zeros(len(rate[i]), int)], rate=rate)) + self.log_prior(i)

    def of_decay(self, model: Model) -> Numbers:
        """(K,) logarithm of the probability of every choice for the decay of slopes, each as probable beforehand."""
        return self._once(-1, replace(model[np.zeros(len(self.decays), int)], decay=self.decays))

    def of_spread(self, model: Model, v: int) -> Numbers:
        """(K,) logarithm of the probability of every choice of how far curve v wanders."""
        spread = np.repeat(model.spread, len(SPREADS), axis=1)
        spread[v] = SPREADS
        found = self._once(-2 - v, replace(model[np.zeros(len(SPREADS), int)], spread=spread))
        return found + np.log(np.append(STAYS, np.full(len(SPREADS) - 1, (1 - STAYS) / (len(SPREADS) - 1))))

    def _once(self, what: int, models: Model) -> Numbers:
        """Logarithm of their likelihood, computed once."""
        key = (what, *(x.tobytes() for x in vars(models).values()))
        if key not in self.found:
            self.found[key] = self.log_likelihood(models)[0]
        return self.found[key]

    def of_jump(self, model: Model) -> Numbers:
        """(1 + p G,) logarithm of the probability of no further jump, and of one of each parameter at each point."""
        key = tuple(x.tobytes() for x in vars(model).values())
        if key not in self.found:
            odds = np.asarray(_log_odds(self.blocks, self.motion(model)))
            odds = np.where(self.moving, odds + self.log_jump, -np.inf)
            odds[0] = -np.inf
            self.found[key] = np.append(0.0, odds.T.ravel())
        return self.found[key]

    def best(self) -> Model:
        """From parameters that stay: their drift first, or their jumps first."""
        drifting = self._settled(self.at_rest())
        if not self.jumping or not self.moving.any():
            return drifting
        ways = [self._with_jumps(self._improved(self.at_rest(), drift=False)), self._with_jumps(drifting)]
        return max(ways, key=self.log_posterior)

    def _with_jumps(self, model: Model) -> Model:
        return self._pruned(self._improved(self._settled(model), drift=True))

    def _settled(self, model: Model, rounds: int = ROUNDS) -> Model:
        """With the most probable rates."""
        moving = np.flatnonzero([len(some) > 1 for some in self.choices])
        for _ in range(rounds):
            before = model
            for v in range(len(self.coefficients)):
                spread = model.spread.copy()
                spread[v] = SPREADS[np.argmax(self.of_spread(model, v))]
                model = replace(model, spread=spread)
            for i in moving.tolist():
                rate = model.rate.copy()
                rate[i] = self.choices[i][np.argmax(self.of_rate(model, i))]
                model = replace(model, rate=rate)
            if len(self.decays) > 1:
                model = replace(model, decay=self.decays[[np.argmax(self.of_decay(model))]])
            if all((a == b).all() for a, b in zip(vars(before).values(), vars(model).values(), strict=True)):
                break
        return model

    def _improved(self, model: Model, drift: bool) -> Model:
        """With jumps one after the other, as long as they pay."""
        for j in np.flatnonzero(model.at[:, 0] == NONE).tolist():
            odds = self.of_jump(model)
            if odds.argmax() == 0:
                break
            model = self.with_jump(model, j, np.array([odds.argmax()]))
            if drift:
                model = self._settled(model, rounds=1)
        return model

    def with_jump(self, model: Model, j: int, place: NDArray[np.int64]) -> Model:
        """Jump j of each model at these places in `of_jump` (L,)."""
        at, which = model.at.copy(), model.which.copy()
        at[j] = np.where(place == 0, NONE, (place - 1) % self.points)
        which[j] = np.where(place == 0, 0, (place - 1) // self.points)
        return replace(model, at=at, which=which)

    def without(self, model: Model, j: int) -> Model:
        """The models without their jump j."""
        return self.with_jump(model, j, np.zeros(model.at.shape[1], int))

    def _pruned(self, model: Model) -> Model:
        """Without jumps that no longer pay."""
        for j in np.flatnonzero(model.at[:, 0] != NONE).tolist():
            odds = self.of_jump(self.without(model, j))
            place = odds.argmax()
            model = self.with_jump(model, j, np.array([place]))
        return self._settled(model)

    def drawn(self, seed: int) -> Drawn:
        """Models around the best one.

        Rates and jumps are drawn one by one, each from its probability with all others as in the best model, evenly.
        """
        random, model = np.random.default_rng(seed), self.best()
        models, log_weight = model[np.zeros(DRAWN, int)], np.zeros(DRAWN)
        for i, some in enumerate(self.choices):
            if len(some) > 1:
                log_prior, log_p = self.log_prior(i), _normalised(self.of_rate(model, i))
                k = _evenly(log_p, random)
                between = 2 ** (random.uniform(-0.5, 0.5, DRAWN) / PER_OCTAVE)
                models.rate[i] = some[k] * between
                log_weight += log_prior[k] - log_p[k]
        if len(self.decays) > 1:
            log_p = _normalised(self.of_decay(model))
            k = _evenly(log_p, random)
            models = replace(models, decay=self.decays[k])
            log_weight += -np.log(len(log_p)) - log_p[k]
        for v in range(len(self.coefficients)):
            log_p = self.of_spread(model, v)
            k = _evenly(_normalised(log_p), random)
            models.spread[v] = SPREADS[k] * 2 ** random.uniform(-0.25, 0.25, DRAWN)
            log_weight += np.log(np.where(k == 0, STAYS, (1 - STAYS) / (len(SPREADS) - 1))) - _normalised(log_p)[k]
        taken = np.flatnonzero(model.at[:, 0] != NONE)
        free = np.setdiff1d(np.arange(MOST_JUMPS), taken)[: int(self.jumping and self.moving.any())]
        for j in (*taken.tolist(), *free.tolist()):
            log_p = _normalised(self.of_jump(self.without(model, j)))
            place = _evenly(log_p, random)
            models = self.with_jump(models, j, place)
            log_weight += np.where(place > 0, self.log_jump, 0) - log_p[place]
        log_likelihood, scale = self.log_likelihood(models)
        return Drawn(models, log_weight + log_likelihood, scale)


def _normalised(log_p: Numbers) -> Numbers:
    return np.asarray(log_p - np.logaddexp.reduce(log_p))


def _evenly(log_p: Numbers, random: np.random.Generator) -> NDArray[np.int64]:
    """(DRAWN,) draws from these probabilities, as even as they can be, in random order."""
    u = (random.permutation(DRAWN) + random.uniform(size=DRAWN)) / DRAWN
    return np.minimum(np.searchsorted(np.cumsum(np.exp(log_p)), u), len(log_p) - 1)


def rates(points: int) -> Numbers:
    """(K,) that are tried: zero, and those of all lengths up to the record."""
    octaves = np.log2(max(points / SHORTEST, 2.0))
    return np.append(0.0, 2.0 ** (np.arange(int(octaves * PER_OCTAVE) + 1) / PER_OCTAVE) / points)


def decays(points: int, order: int) -> Numbers:
    """(K,) that are tried: zero, and where there are slopes one in each octave."""
    return rates(points)[:1] if order == 0 else np.append(0.0, rates(points)[1::PER_OCTAVE])
