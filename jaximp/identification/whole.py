"""Parameters of a recording as one window, whatever its windows are."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaximp.identification.common_errors import common_covariance
from jaximp.identification.prepared import Prepared
from jaximp.identification.solving import place_windows
from jaximp.identification.weighted import covariance_of
from jaximp.least_squares.window import SlidingFit
from jaximp.types import Numbers


class Whole(NamedTuple):
    """Of p parameters."""

    theta: Numbers
    """(p,) estimates."""
    covariance: Numbers
    """(p, p), with what is not known of gains and of Stribeck's curves."""
    dof: float
    """Degrees of freedom."""


def of_whole_recording(prepared: Prepared, theta: Numbers) -> Numbers:
    """(p,) the parameters of the recording as one window, from `theta` (M, p) of its windows where that is one."""
    if len(theta) == 1:
        return np.asarray(theta[0])
    W, torque, valid = solved_rows(prepared)
    return np.asarray(np.linalg.lstsq(W[valid], torque[valid])[0])


def whole_recording(prepared: Prepared, fit: SlidingFit) -> Whole:
    """With what the parameters' errors have in common, from scores as they are (`weighted.covariance_of`).

    **Arguments:** the one window's `fit`.

    **Raises:** `ValueError` where there are several windows, or where the recording does not determine all parameters.
    """
    theta = np.asarray(fit.theta)
    if len(theta) != 1:
        raise ValueError(
            f"there are {len(theta)} windows, but one estimate of the whole recording is needed: leave out the length "
            "in [window]"
        )
    if not np.isfinite(theta).all():
        raise ValueError(
            "the recording does not determine all parameters: it needs a motion that excites every joint, or a "
            "smaller model"
        )
    covariance, dof = covariance_of(*solved_rows(prepared))
    place = place_windows(prepared.pipeline, prepared.rows)
    return Whole(theta[0], covariance + common_covariance(prepared, prepared.rows, fit, place)[0], dof)


def solved_rows(prepared: Prepared) -> tuple[Numbers, Numbers, NDArray[np.bool_]]:
    """(S, n, p) and (S, n): the rows that estimates come from, and which of them count."""
    generalised = len(prepared.white) == 1 and not prepared.pipeline.ordinary
    rows = prepared.weighted or (prepared.white[0] if generalised else prepared.rows)
    valid = np.asarray(prepared.rows.valid)
    valid = valid.reshape(len(valid), -1)
    return np.reshape(rows.W, (*valid.shape, -1)), np.reshape(rows.torque, valid.shape), valid
