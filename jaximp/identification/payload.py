"""The load at the end of a robot of n joints, from recordings without and with it.

A load that is fixed to the last link has ten inertial parameters, and its columns are those of the last link: what it
adds to the base parameters of the robot is `B` times the ten. Methods 1 to 4 tell it from the robot. Standard errors
come from the scores, with all that they have in common over time (`block_errors`). They hold what is not known of the
robot and of the gains behind the torques.

**Source:** Khalil, Gautier and Lemoine 2007, *Identification of the payload inertial parameters of industrial
manipulators*; Tout et al. 2023, II.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaximp.identification.additions import Separated, from_the_rest, gains_of, together
from jaximp.identification.block_errors import SINGULAR, BlockFit, block_fit
from jaximp.identification.pipeline import Pipeline
from jaximp.identification.prepared import without_unknown_delay
from jaximp.identification.quantities import Quantities, freedom
from jaximp.identification.rows import Rows, measure, regress
from jaximp.identification.separation import OTHER_MOTION
from jaximp.models.chain import Chain
from jaximp.models.determined import determined, sizes_of_body
from jaximp.models.spatial import PARAMETERS
from jaximp.recordings.join import part_of
from jaximp.results import Parameter
from jaximp.types import AnyArray, Numbers, Recording, listed

LOAD_METHODS = {
    1: "the robot first, then the load from what is left of the torque",
    2: "the robot without and with the load, and the difference of its links' parameters",
    3: "the difference of the torques on the same motion",
    4: "robot and load together, from all recordings",
}
FARTHEST = 2.0
"""Seconds by which two recordings of one motion may begin apart."""
COMPARED = 2000
"""Samples by which the beginnings of two recordings are compared."""

Several = Recording | Sequence[Recording]


@dataclass(frozen=True, eq=False)
class Payload(Quantities):
    """Ten inertial parameters of a load: `load.mass`, `load.mc_x` (mass times centre of mass) to `load.mc_z`, and
    `load.Ixx` to `load.Izz` about the origin of the `frame`; NaN for those that move no torque."""

    frame: str
    """Link of the URDF in whose frame they stand: the chain's tip."""
    method: int
    gain_covariance: Numbers | None
    """(n, n) of the relative errors of the gains that the errors hold; None where the torques are taken as exact."""
    gain_stderr: Numbers
    """(10,) the part of the standard errors that comes from the gains."""
    left: Numbers
    """(n,) root mean square of what robot and load leave of each torque [N m or N]."""
    notes: tuple[str, ...]
    """What is to be known of the estimate, in words."""
    recording_notes: tuple[str, ...]
    """What reading the recordings changed or noticed."""

    @property
    def mass(self) -> Parameter:
        """[kg], with `value`, `stderr` and `interval()`."""
        return self["load.mass"]

    @property
    def centre(self) -> Quantities:
        """Three coordinates of the centre of mass in the `frame` [m]."""
        names = tuple(f"load.centre_{axis}" for axis in "xyz")
        return self._derived(names, ("m",) * 3, lambda x: x[1:4] / x[0])

    @property
    def inertia_about_centre(self) -> Quantities:
        """Six elements of the inertia about the centre of mass, in axes parallel to those of the `frame` [kg m^2]."""
        names = tuple(f"load.{name}_at_centre" for name in list(PARAMETERS)[4:])
        return self._derived(names, ("kg m^2",) * 6, _about_centre)

    @property
    def determined(self) -> NDArray[np.bool_]:
        """(10,) which parameters the recordings determine: half of the interval is at most a quarter of the parameter,
        or for first moments and products of inertia of what they can be (`models.determined`)."""
        low, high = self.interval()
        # Mass and moments are at least where their intervals begin.
        return determined(low, high, sizes_of_body(low))

    def in_words(self) -> list[str]:
        """The mass, the centre of mass, what is determined, and what the mass cannot tell."""
        lines = [f"mass {_spoken(self, 0, 1.0, 'kg')}"]
        centre = self.centre
        coordinates = [f"{axis} {_spoken(centre, k, 1e3, 'mm')}" for k, axis in enumerate("xyz")]
        lines.append(f"centre of mass in the frame of {self.frame}: {', '.join(coordinates)}")
        which, names = self.determined, [name.removeprefix("load.") for name in self.names]
        for words, those in (("determined", which), ("not determined", ~which)):
            if those.any():
                lines.append(f"{words}: {listed([n for n, yes in zip(names, those, strict=True) if yes])}")
        return [*lines, *self.notes]

    def _derived(
        self, names: tuple[str, ...], units: tuple[str, ...], function: Callable[[AnyArray], AnyArray]
    ) -> Quantities:
        """By the derivative along each of the ten, which a step of 1e-30 along the imaginary axis gives to all digits.
        Nothing is known of them where the mass may be zero."""
        x = self.theta if self.theta[0] > 2 * self.stderr[0] else np.full(10, np.nan)
        with np.errstate(invalid="ignore"):
            slope = np.stack([np.imag(function(x + 1e-30j * one)) / 1e-30 for one in np.eye(10)], axis=1)
        slope = np.where(np.isnan(slope).any(axis=1)[:, None], np.nan, slope)
        covariance = slope @ np.nan_to_num(self.covariance) @ slope.T
        used = self.dof[np.isfinite(slope).all(axis=1) @ (np.nan_to_num(slope) != 0) > 0]
        dof = np.full(len(names), np.min(np.nan_to_num(used, nan=np.inf), initial=np.inf))
        return Quantities(names, units, np.real(function(x)), covariance, dof)


class KnownRobot(NamedTuple):
    """A robot by its recordings, for loads to come."""

    chain: Chain
    theta: Numbers
    """(p,) base parameters, in the order of `chain.names`."""
    covariance: Numbers
    """(p, p) without errors of the gains, for variances of a few sums: it may be singular."""
    size: Numbers
    """(n,) what the model leaves of each torque [N m or N]."""
    by_joint: Numbers
    """(p, n) what the torques of each joint made of the parameters; they add up."""
    gain_covariance: Numbers | None
    """(n, n) of the relative errors of the gains, where the recordings state them."""


def identify_robot(pipeline: Pipeline, alone: Several) -> KnownRobot:
    """All base parameters with their covariance, from recordings of the robot without a load.

    **Raises:** `ValueError` as `identify_payload`.
    """
    chain, several = required_chain(pipeline), listed_recordings(alone)
    fit = block_fit(rows_of(pipeline, several))
    return KnownRobot(chain, fit.theta, fit.scatter.covariance, fit.size, fit.by_joint, gains_of(several))


def identify_payload(pipeline: Pipeline, alone: Several, loaded: Several, method: int = 4) -> Payload:
    """The load by one of four methods (Khalil, Gautier and Lemoine 2007).

    **Arguments:**

    - `pipeline` whose model is a `Chain` and whose filters all recordings pass, `Pipeline(rate, chain, filter=...)`.
    - `alone`, the recording of the robot without the load, or several; `loaded`, that with the load, or several.
    - `method`: 1, the robot first, then the load from what is left of the torque. 2, robot without and with the load
      by themselves, and what the parameters of its links differ by; friction and constants may differ as they like.
      3, the difference of the torques on the same motion, of which the robot's model takes off what the motions differ
      by; recordings may begin up to 2 s apart. 4, all together.

    Where the recordings state errors of their gains (`gain_error`), the load's errors hold them.

    **Raises:** `ValueError` in one line for another model, an unknown method, a chain without a tip, recordings that do
    not determine the robot, and two motions where method 3 needs one.
    """
    if method not in LOAD_METHODS:
        raise ValueError(f"method is {method!r}: choose 1, 2, 3 or 4")
    chain, without, with_load = required_chain(pipeline), listed_recordings(alone), listed_recordings(loaded)
    columns, gains = load_columns(chain), gains_of(with_load)
    empty, full = (rows_of(pipeline, several) for several in (without, with_load))
    ten = TenParameters.of(np.asarray(full.W), full.valid, columns)
    if method == 1:
        found = _robot_first(ten, block_fit(empty), full)
    elif method == 2:
        found = _difference_of_parameters(chain, ten, block_fit(empty), full)
    elif method == 3:
        found = _same_motion(pipeline, ten, block_fit(empty), without, with_load)
    else:
        found = together(empty, full, full.W @ ten.columns)[0]
    return _payload(chain, method, ten, found, gains, without, with_load)


# --- rows -------------------------------------------------------------------------------------------------------------


def required_chain(pipeline: Pipeline) -> Chain:
    """**Raises:** `ValueError` for a model that is no robot from a URDF, or one of which no end is known."""
    chain = pipeline.model
    if not isinstance(chain, Chain):
        raise ValueError("a payload is that of a robot from a URDF: give a pipeline whose model is a Chain")
    if chain.stribeck_unknown:
        raise ValueError("Stribeck's curves are not looked for beside a load: identify the robot alone, and give them")
    if not pipeline.once:
        raise ValueError("a load is identified from whole recordings: leave out filter.mode, or set it to 'once'")
    require_end(chain)
    return chain


def require_end(chain: Chain) -> None:
    """**Raises:** `ValueError` for a chain of which no end that moves is known."""
    if chain.tip is None or chain.tree.tip_body < 0:
        raise ValueError(f"{chain.robot}: which link bears the load? Set tip to a link that moves")


def listed_recordings(several: Several) -> list[Recording]:
    return [several] if isinstance(several, Recording) else list(several)


def rows_of(pipeline: Pipeline, several: Sequence[Recording]) -> Rows:
    """Filtered rows of all recordings, one behind the other; no filter crosses from one into the next.

    **Raises:** `ValueError` as `Pipeline.check`.
    """
    parts = []
    for one in several:
        own = pipeline.of_length(len(one))
        own.check(one)
        parts.append(regress(measure(own, without_unknown_delay(own, one)))[0])
    joined = [np.concatenate([np.asarray(getattr(part, key)) for part in parts]) for key in ("W", "torque", "valid")]
    shape = joined[1].shape[0], -1
    W, torque, valid = (
        joined[0].reshape(*np.reshape(joined[1], shape).shape, -1),
        *(x.reshape(shape) for x in joined[1:]),
    )
    return Rows(W, torque, valid, np.concatenate([part.time for part in parts]))


def load_columns(chain: Chain) -> Numbers:
    """(p, 10) what the parameters of a load, in the frame of the tip, add to the base parameters of a chain."""
    first = 10 * chain.tree.tip_body
    return np.asarray(chain.base.map, float)[:, first : first + 10] @ chain.load_in_link


class TenParameters(NamedTuple):
    """What the motion shows of a load's ten parameters: `load = back @ u`, of which `u` (d,) is seen in the torque."""

    columns: Numbers
    """(p, d) what `u` adds to the robot's parameters."""
    back: Numbers
    """(10, d)"""
    known: NDArray[np.bool_]
    """(10,) which of the ten `u` determines."""

    @classmethod
    def of(cls, W: Numbers, valid: NDArray[np.bool_], columns: Numbers) -> TenParameters:
        """**Arguments:** rows `W` (S, n, p) of the robot with the load; `columns` (p, 10) by `load_columns`."""
        R: Numbers = np.linalg.qr(np.where(valid[..., None], W @ columns, 0).reshape(-1, 10))[1]
        length = np.linalg.norm(R, axis=0)
        alive = length > SINGULAR * length.max()
        _, sizes, V = np.linalg.svd(np.where(alive, R / np.where(alive, length, 1), 0))
        V = V[sizes > SINGULAR * sizes[0]].T
        back = V / np.where(alive, length, 1)[:, None]
        return cls(columns @ back, back, alive & ((V**2).sum(axis=1) > 1 - SINGULAR))


# --- four methods -----------------------------------------------------------------------------------------------------


def _robot_first(ten: TenParameters, robot: BlockFit, full: Rows) -> Separated:
    return from_the_rest(full.W @ ten.columns, full, full.W, robot)[0]


def _difference_of_parameters(chain: Chain, ten: TenParameters, robot: BlockFit, full: Rows) -> Separated:
    """By the links' parameters alone: a load changes friction, too, and nobody knows how."""
    with_load = block_fit(full)
    links = np.array([not name.startswith("joint") or name.endswith("rotor_inertia") for name in chain.names])
    spread = sum(np.linalg.inv(fit.information)[np.ix_(links, links)] for fit in (robot, with_load))
    columns = ten.columns[links]
    weighted = np.linalg.solve(spread, columns)
    G = np.zeros((ten.columns.shape[1], len(links)))
    G[:, links] = np.linalg.solve(columns.T @ weighted, weighted.T)
    by_joint = G @ (with_load.by_joint - robot.by_joint)
    return Separated(G @ (with_load.theta - robot.theta), ((G, with_load), (-G, robot)), by_joint, with_load.size)


def _same_motion(
    pipeline: Pipeline, ten: TenParameters, robot: BlockFit, without: list[Recording], with_load: list[Recording]
) -> Separated:
    if len(without) > 1 or len(with_load) > 1:
        raise ValueError("method 3 compares two recordings of one motion: give one without and one with the load")
    alone, loaded, apart = _aligned(without[0], with_load[0])
    empty, full = rows_of(pipeline, [alone]), rows_of(pipeline, [loaded])
    moved_by, valid = np.asarray(full.W) - np.asarray(empty.W), full.valid & empty.valid
    differs, own = (_rms((x @ robot.theta)[valid]) for x in (moved_by, np.asarray(full.W)))
    if differs > OTHER_MOTION * own:
        raise ValueError(
            f"method 3 needs one motion twice, but the robot's own torque differs by {differs / own:.0%} between "
            f"{alone.name} and {loaded.name}: take method 1, 2 or 4"
        )
    note = f"by the robot's model the motions differ by {differs / own:.1%} of its torque, which was taken off"
    shift = f"{loaded.name} begins {apart:.3g} s later in the motion than {alone.name}" if apart else ""
    rows = Rows(full.W, np.asarray(full.torque) - np.asarray(empty.torque), valid, full.time)
    return from_the_rest(full.W @ ten.columns, rows, moved_by, robot, tuple(filter(None, [shift, note])))[0]


def _aligned(alone: Recording, loaded: Recording) -> tuple[Recording, Recording, float]:
    """Both recordings from where they show the same motion, equally long, and how much later the second began [s]."""

    def distance(shift: int) -> float:
        n = min(len(alone) - max(shift, 0), len(loaded) + min(shift, 0))
        apart = alone.position[max(shift, 0) :][:n:every] - loaded.position[max(-shift, 0) :][:n:every]
        known = apart[np.isfinite(apart)]
        return float(np.mean(known**2)) if len(known) else np.inf

    every = max(1, min(len(alone), len(loaded)) // COMPARED)
    reach = min(round(FARTHEST * alone.sample_rate), min(len(alone), len(loaded)) // 2)
    shift = min(range(-reach, reach + 1), key=distance)
    starts = max(shift, 0), max(-shift, 0)
    n = min(len(alone) - starts[0], len(loaded) - starts[1])
    first, second = (
        part_of(one, k / len(one), (k + n) / len(one)) for one, k in zip((alone, loaded), starts, strict=True)
    )
    return first, second, shift / alone.sample_rate


def _rms(x: Numbers) -> float:
    return float(np.sqrt(np.mean(x**2))) if len(x) else 0.0


# --- the result -------------------------------------------------------------------------------------------------------


def _payload(
    chain: Chain,
    method: int,
    ten: TenParameters,
    found: Separated,
    gains: Numbers | None,
    without: list[Recording],
    with_load: list[Recording],
) -> Payload:
    assert chain.tip is not None
    moves = ten.back @ found.by_joint
    of_gains = np.zeros((10, 10)) if gains is None else moves @ gains @ moves.T
    covariance, theta, of_fits = of_gains.copy(), ten.back @ found.u, []
    for rows, fit in found.sources:
        part = ten.back @ rows
        of_fit = part @ fit.scatter.covariance @ part.T
        of_fits.append((np.diagonal(of_fit), fit.scatter.dof(part)))
        covariance += of_fit
    dof = freedom((np.diagonal(of_gains), np.inf), *of_fits)
    unknown = ~ten.known
    theta[unknown] = covariance[unknown] = covariance[:, unknown] = np.nan
    gain_stderr = np.where(unknown, np.nan, np.sqrt(np.maximum(np.diagonal(of_gains), 0)))
    notes = [LOAD_METHODS[method], *found.notes, _of_gains(gains, gain_stderr[0], np.sqrt(covariance[0, 0]))]
    noticed = tuple(f"{one.name}: {note}" for one in (*without, *with_load) for note in one.notes)
    names, units = tuple(f"load.{name}" for name in PARAMETERS), tuple(PARAMETERS.values())
    of_load = (chain.tip, method, gains, gain_stderr, found.left, tuple(notes), noticed)
    return Payload(names, units, theta, covariance, np.where(unknown, np.nan, dof), *of_load)


def common_error(gains: Numbers) -> float:
    """What the relative errors of all gains have in common, as one standard deviation."""
    n = len(gains)
    apart = (gains.sum() - np.trace(gains)) / (n * (n - 1)) if n > 1 else float(gains[0, 0])
    return float(np.sqrt(max(apart, 0.0)))


def _of_gains(gains: Numbers | None, of_gains: float, whole: float) -> str:
    """What the mass owes to the gains."""
    hidden = "without a known load nothing in these recordings can tell it"
    if gains is None:
        return (
            "the torques are taken as exact; if they are currents times gains, the mass carries the gains' common "
            f"scale: {hidden}"
        )
    better = f": {hidden} better" if of_gains**2 > 0.5 * whole**2 else ""
    return f"the mass carries the gains' common scale, which is known to {100 * common_error(gains):.2g} %{better}"


def _about_centre(x: AnyArray) -> AnyArray:
    """The inertia of real or complex parameters."""
    mass, (a, b, c) = x[0], x[1:4]
    shift = np.array([b**2 + c**2, -a * b, a**2 + c**2, -a * c, -b * c, a**2 + b**2])
    return x[4:] - shift / mass


def _spoken(of: Quantities, k: int, factor: float, unit: str) -> str:
    """A number and its interval with as many digits as its error has."""
    value = factor * of.theta[k]
    if not np.isfinite(value):
        return "not determined"
    low, high = (factor * end[k] for end in of.interval())
    digits = max(0, 1 - int(np.floor(np.log10(high - low)))) if high > low else 3
    return f"{value:.{digits}f} {unit} ({low:.{digits}f} to {high:.{digits}f})"
