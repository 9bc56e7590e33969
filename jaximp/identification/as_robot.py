"""Whether what was identified can be a robot, and that of the URDF: bodies, reach, another recording."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np

from jaximp.consistency.barrier import distance_to_robots
from jaximp.consistency.cone import pose
from jaximp.identification.estimates import Estimates
from jaximp.identification.prepared import Prepared
from jaximp.identification.whole import solved_rows
from jaximp.models.chain import Chain
from jaximp.trust.window_rules import OF_LINKS
from jaximp.types import Numbers

LUCK = 4.0
"""By so many standard deviations the squared distance of a true robot may lie above its mean."""
FAR = 1.0
"""Beyond the URDF's limits, in widths of the range between them: that is no longer a limit set too narrowly."""
BEYOND = 0.1
"""From here on it is said."""
AGAINST = -0.5
"""Correlation over the poses of what gravity does to a joint, by the estimate and by the URDF."""
HEAVY = 0.1
"""Share of a joint's torque that gravity must make by the URDF, if it is to be compared."""
POSES = 200


def judged_as_robot(prepared: Prepared, estimates: Estimates, theta: Numbers) -> Estimates:
    """With what the rules look at of a robot from a URDF. The estimates of anything else stay as they are.

    **Arguments:** `theta` (p,) of the recording as a whole.
    """
    chain = prepared.model
    if not isinstance(chain, Chain):
        return estimates
    out_of_reach, note = _reach(chain, prepared.recording.position)
    held_out = estimates.held_out
    look = partial(
        replace,
        of_robot=True,
        unreal=_unreal(prepared, chain),
        unforeseen=0.0 if held_out is None else held_out.total**2,
        opposed=_opposed(prepared, chain, theta),
        out_of_reach=out_of_reach,
    )
    measured = tuple(look(one) for one in estimates.measured)
    return replace(estimates, measured=measured, notes=(*estimates.notes, *filter(None, [note])))


def _unreal(prepared: Prepared, chain: Chain) -> float:
    """By what share the squares of all rows grow that the best model leaves, if it must be that of a robot; zero where
    a true model, too, would have estimates so far from any robot."""
    W, torque, valid = solved_rows(prepared)
    A, b = W[valid], torque[valid]
    size = np.sqrt((A**2).sum(axis=0))
    spare = len(b) - A.shape[1]
    if spare <= 0 or not (size > 0).all() or np.linalg.matrix_rank(A / size) < A.shape[1]:
        return 0.0
    theta, (squares,) = np.linalg.lstsq(A / size, b)[:2]
    covariance = np.linalg.inv((A / size).T @ (A / size)) / np.outer(size, size) * squares / spare
    distance = distance_to_robots(pose(chain, theta / size, covariance))
    usual = A.shape[1] + LUCK * np.sqrt(2 * A.shape[1])
    return distance**2 / spare if distance**2 > usual else 0.0


def _opposed(prepared: Prepared, chain: Chain, theta: Numbers) -> str:
    """Which joint carries its weight the other way round than by the URDF's own masses, however wrong these are."""
    position = prepared.recording.position
    poses = position[np.isfinite(position).all(axis=1)][:: -(-len(position) // POSES)]
    still = np.zeros_like(poses)
    W = np.asarray(chain.observation_matrix(poses, still, still))
    of_bodies = np.array([role.kind in OF_LINKS for role in chain.roles])
    found, expected = W @ (of_bodies * theta), W @ (of_bodies * chain.parameters)
    sizes = [np.sqrt((x**2).sum(axis=0)) for x in (found, expected)]
    heavy = sizes[1] > HEAVY * np.sqrt(np.nanmean(prepared.recording.torque**2, axis=0) * len(poses))
    alike = np.where(heavy, (found * expected).sum(axis=0) / np.where(heavy, sizes[0] * sizes[1], 1.0), 1.0)
    worst = int(alike.argmin())
    if not alike[worst] < AGAINST:
        return ""
    return (
        f"gravity moves {chain.joint_names[worst]} the other way round than by the masses of the URDF: the correlation "
        f"of both torques is {alike[worst]:.2f}"
    )


def _reach(chain: Chain, position: Numbers) -> tuple[str, str]:
    """Which joint is so far out that it cannot be; or, as a note, which ones are beyond the URDF's limits."""
    lower, upper = chain.limits.lower, chain.limits.upper
    position = np.asarray(chain.limited_positions(position))
    with np.errstate(invalid="ignore"):
        least, most = np.nanmin(position, axis=0), np.nanmax(position, axis=0)
        beyond = np.nan_to_num(np.maximum(lower - least, most - upper) / (upper - lower), neginf=0.0)
    worst = int(beyond.argmax())
    if not beyond[worst] > BEYOND:
        return "", ""
    end = most[worst] if most[worst] - upper[worst] >= lower[worst] - least[worst] else least[worst]
    text = (
        f"{chain.joint_names[worst]} was recorded at {end:.3g}, but the URDF lets it move from {lower[worst]:.3g} to "
        f"{upper[worst]:.3g} only"
    )
    return (text, "") if beyond[worst] > FAR else ("", text)
