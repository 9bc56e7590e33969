"""Gains of a robot's drives from a load that is known.

Motor currents say nothing of newton metres until something is weighed: every estimate scales with the gains. With a
known load on the last link the currents `i = Y theta / K` determine them. (To fit `K i = Y theta` with weights by what
is left collapses: with all gains at zero nothing is left.) Rows are compressed joint by joint; what remains is a small
problem in the robot's parameters, the load's and the logarithms of the gains.

**Source:** Gautier and Briot 2014, *Global identification of joint drive gains and dynamic parameters of robots*.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from jaxtyping import ArrayLike, Num

from jaximp.identification.block_errors import Scatter, require_rank, scatter
from jaximp.identification.payload import (
    Several,
    TenParameters,
    common_error,
    listed_recordings,
    load_columns,
    required_chain,
    rows_of,
)
from jaximp.identification.pipeline import Pipeline
from jaximp.identification.quantities import Quantities
from jaximp.identification.rows import Rows
from jaximp.identification.weighted import ROUNDS, SETTLED, sizes_of_joints, triangles_of
from jaximp.models.chain import Chain
from jaximp.types import Numbers, Recording

EXACT = 1e-6
"""What is known without error counts as known to this share of itself."""
NOTHING_LEFT = 1e-9
"""Share of a current below which what is left of it is rounding."""


@dataclass(frozen=True, eq=False)
class DriveGains(Quantities):
    """What makes torques of the currents of n joints [N m/A or N/A]. (Where the recordings already hold torques by
    nominal gains, these are the factors by which they are off.)"""

    residual: Numbers
    """(n,) root mean square of what is left of the currents, in their unit."""

    @property
    def relative_covariance(self) -> Numbers:
        """(n, n) of the relative errors, as `Recording.gain_covariance` has it: normal errors as wide at 95 % as those
        of Student's t here."""
        from scipy.special import ndtri, stdtrit

        wider = stdtrit(self.dof, 0.975) / ndtri(0.975) / self.theta
        return np.asarray(self.covariance * np.outer(wider, wider))

    @property
    def gain_error(self) -> dict[str, float | list[float]]:
        """The same for a job file, in per cent: what the gains have in common, and what each has by itself."""
        relative = self.relative_covariance
        common = common_error(relative)
        each = np.sqrt(np.maximum(np.diagonal(relative) - common**2, 0))
        return {"common": float(100 * common), "each": (100 * each).tolist()}

    def in_words(self) -> list[str]:
        """A line for each gain, and two for the `torque` of a job."""
        error, rows = self.gain_error, zip(self.names, self.theta, *self.interval(), self.units, strict=True)
        lines = [f"{name}: {value:.4g} {unit} ({low:.4g} to {high:.4g})" for name, value, low, high, unit in rows]
        each = ", ".join(f"{one:.2g}" for one in np.atleast_1d(error["each"]))
        gains = ", ".join(f"{one:.5g}" for one in self.theta)
        return [*lines, f"gain = [{gains}]", f"gain_error = {{ common = {error['common']:.2g}, each = [{each}] }}"]

    def applied(self, recording: Recording) -> Recording:
        """A recording of currents as one of torques, which knows what is not known of the gains.

        **Raises:** `ValueError` for a recording of other joints.
        """
        if recording.n_joints != len(self.theta):
            raise ValueError(f"{recording.name} has {recording.n_joints} joints, the gains are of {len(self.theta)}")
        note = f"torques by gains from a known load, whose common scale is known to {self.gain_error['common']:.2g} %"
        return replace(
            recording,
            torque=recording.torque * self.theta,
            gain_covariance=self.relative_covariance,
            notes=(*recording.notes, note),
        )


def identify_gains(
    pipeline: Pipeline,
    alone: Several,
    loaded: Several,
    mass: float,
    mass_error: float = 0.0,
    centre: Num[ArrayLike, "3"] | Sequence[float] | None = None,
    centre_error: float = 0.0,
    same_friction: bool = False,
) -> DriveGains:
    """Gains from recordings without and with a load of known mass, for which the robot need not be known.

    **Arguments:**

    - `pipeline` whose model is a `Chain`; `alone` and `loaded` recordings, as for `identify_payload`, whose torques are
      the currents as they were recorded. They may stand in A or be made torques by nominal gains, which also helps
      where drives differ by more than some three times.
    - `mass` [kg] of the load, and its standard error; `centre` of mass in the frame of the chain's tip [m], where it is
      known, and the standard error of each coordinate.
    - `same_friction`: whether friction and constants are the same with the load. By default each has its own: gears
      rub more under a load, and less when they are warm.

    **Raises:** `ValueError` in one line for a mass that is not above zero, currents of the wrong sign, and recordings
    that do not determine all gains.
    """
    for name, value, least in (
        ("mass", mass, 0.0),
        ("mass_error", mass_error, None),
        ("centre_error", centre_error, None),
    ):
        if not np.isfinite(value) or value < 0 or value == least:
            raise ValueError(
                f"{name} is {value}: it must be finite and {'above zero' if least == 0 else 'zero or more'}"
            )
    chain = required_chain(pipeline)
    empty, full = (rows_of(pipeline, listed_recordings(several)) for several in (alone, loaded))
    ten = TenParameters.of(np.asarray(full.W), full.valid, load_columns(chain))
    rows = _all_together(chain, ten, empty, full, same_friction)
    known = _known(ten, rows.W.shape[-1], mass, mass_error, centre, centre_error)
    z, gains, size = _solve(rows, known)
    n, errors = len(gains), _scatter(rows, known, z, gains, size)
    C, dof = errors.covariance[-n:, -n:], errors.dof(np.eye(len(z) + n)[-n:])
    names = tuple(f"joint{k + 1}.gain" for k in range(n))
    units = tuple("N m/A" if kind == "revolute" else "N/A" for kind in chain.joint_kinds)
    return DriveGains(names, units, gains, C * np.outer(gains, gains), dof, size)


class _Known(NamedTuple):
    """`rows @ z` is `values`, in units of what is not known of them."""

    rows: Numbers
    values: Numbers


def _all_together(chain: Chain, ten: TenParameters, empty: Rows, full: Rows, same_friction: bool) -> Rows:
    """Columns of links and rotors, of friction (twice, unless it is the same), and of the load, of all rows."""
    at_joints = [n.startswith("joint") and not n.endswith("rotor_inertia") for n in chain.names]
    friction = np.array(at_joints) & (not same_friction)
    without, with_load = np.asarray(empty.W), np.asarray(full.W)

    def zeros(W: Numbers, count: int) -> Numbers:
        return np.zeros((*W.shape[:2], count))

    extra, d = int(friction.sum()), ten.columns.shape[1]
    upper = [without, zeros(without, extra + d)]
    lower = [np.where(friction, 0, with_load), with_load[..., friction], with_load @ ten.columns]
    W = np.concatenate([np.concatenate(upper, axis=-1), np.concatenate(lower, axis=-1)])
    torque, valid, time = (np.concatenate([getattr(x, k) for x in (empty, full)]) for k in ("torque", "valid", "time"))
    return Rows(W, torque, valid, time)


def _known(
    ten: TenParameters, columns: int, mass: float, mass_error: float, centre: object, centre_error: float
) -> _Known:
    """The mass, and the first moments by the mass. Where no torque shows the mass by itself, the moments alone."""
    place = None if centre is None else np.asarray(centre, float)
    if place is not None and (place.shape != (3,) or not np.isfinite(place).all()):
        raise ValueError(f"centre is {centre}: give three finite coordinates [m] in the frame of the tip")
    rows, values, errors = [], [], []
    if ten.known[0]:
        rows, values, errors = [ten.back[0]], [mass], [max(mass_error, EXACT * mass)]
    for k, at in enumerate([] if place is None else place.tolist()):
        if ten.known[1 + k]:
            rows.append(ten.back[1 + k] - (at * ten.back[0] if ten.known[0] else 0))
            values.append(0.0 if ten.known[0] else mass * at)
            of_mass = 0.0 if ten.known[0] else at * mass_error
            errors.append(max(np.hypot(mass * centre_error, of_mass), EXACT * mass))
    if not rows:
        raise ValueError("the mass of a load moves no torque of this robot by itself: give its centre of mass, too")
    placed = np.zeros((len(rows), columns))
    placed[:, columns - ten.back.shape[1] :] = rows
    return _Known(placed / np.array(errors)[:, None], np.array(values) / np.array(errors))


def _solve(rows: Rows, known: _Known) -> tuple[Numbers, Numbers, Numbers]:
    """Linear parameters (P,), gains (n,), and what is left of each current (n,)."""
    from scipy.optimize import least_squares

    W, current, valid = (np.asarray(x) for x in (rows.W, rows.torque, rows.valid))
    n, P = current.shape[1], W.shape[-1]
    triangles = triangles_of(W, current, valid)
    count, least = valid.sum(axis=0), NOTHING_LEFT * np.array([np.linalg.norm(R[:, -1]) for R in triangles])

    def residuals(x: Numbers, size: Numbers) -> Numbers:
        parts = [(R[:, :-1] @ x[:P] * np.exp(-x[P + j]) - R[:, -1]) / size[j] for j, R in enumerate(triangles)]
        return np.concatenate([*parts, known.rows @ x[:P] - known.values])

    def slope(x: Numbers, size: Numbers) -> Numbers:
        parts = []
        for j, R in enumerate(triangles):
            part = np.zeros((len(R), P + n))
            part[:, :P] = R[:, :-1] * np.exp(-x[P + j]) / size[j]
            part[:, P + j] = -part[:, :P] @ x[:P]
            parts.append(part)
        return np.concatenate([*parts, np.pad(known.rows, ((0, 0), (0, n)))])

    size = sizes_of_joints(rows)
    x = _start(triangles, known, size)
    for _ in range(ROUNDS):
        require_rank(np.linalg.qr(slope(x, size))[1])
        found = least_squares(residuals, x, slope, method="lm", x_scale="jac", xtol=1e-12, ftol=1e-12, args=(size,))
        x, before = found.x, size
        left = [np.linalg.norm(R[:, :-1] @ x[:P] * np.exp(-x[P + j]) - R[:, -1]) for j, R in enumerate(triangles)]
        size = np.maximum(left, least) / np.sqrt(np.maximum(count, 1))
        if np.abs(size / before - 1).max() < SETTLED:
            break
    return x[:P], np.exp(x[P:]), size


def _start(triangles: Sequence[Numbers], known: _Known, size: Numbers) -> Numbers:
    """All gains alike, by the known load.

    **Raises:** `ValueError` where the load comes out below zero.
    """
    W = np.concatenate([R[:, :-1] / s for R, s in zip(triangles, size, strict=True)])
    y = np.concatenate([R[:, -1] / s for R, s in zip(triangles, size, strict=True)])
    length = np.where((norm := np.linalg.norm(W, axis=0)) > 0, norm, 1)
    z = np.linalg.lstsq(W / length, y)[0] / length
    k = int(np.abs(known.values).argmax())
    scale = known.values[k] / (known.rows[k] @ z)
    if not (np.isfinite(scale) and scale > 0):
        raise ValueError(
            "by these currents the load pulls upwards: look at their signs, and whether the two recordings are not "
            "swapped; where drives differ by more than some three times, give them nominal gains"
        )
    return np.concatenate([scale * z, np.full(len(triangles), np.log(scale))])


def _scatter(rows: Rows, known: _Known, z: Numbers, gains: Numbers, size: Numbers) -> Scatter:
    """Of the linear parameters and the logarithms of the gains, (P + n)."""
    W, current, n = np.asarray(rows.W), np.asarray(rows.torque), len(gains)
    by_links = W / (gains * size)[:, None]
    predicted = by_links @ z
    by_gains = -predicted[..., None] * np.eye(n)
    columns = np.concatenate([by_links, by_gains], axis=-1)
    beforehand = np.pad(known.rows, ((0, 0), (0, n)))
    return scatter(columns, current / size - predicted, np.asarray(rows.valid, bool), beforehand)
