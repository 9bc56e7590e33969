"""Which figure shows a result at a glance."""

from __future__ import annotations

from functools import singledispatch
from typing import Any

from matplotlib.figure import Figure

from jaximp.design.excitation import Design
from jaximp.identification.estimates import Estimates
from jaximp.identification.payload import Payload
from jaximp.models.chain import Chain
from jaximp.perturbation.impedance import ArmImpedance
from jaximp.perturbation.trials_result import TrialsResult
from jaximp.plots.arm import ellipses
from jaximp.plots.estimates import parameters_over_time
from jaximp.plots.excitation import design
from jaximp.plots.impedance import impedance_methods
from jaximp.plots.posterior import bands, corner
from jaximp.plots.robots import load_by_method, parameters_against_urdf
from jaximp.posterior.arm import ArmInference
from jaximp.posterior.draws import Posterior
from jaximp.posterior.inference import Inference


@singledispatch
def figure_of(result: Any) -> Figure:
    """The figure that shows a result at a glance. A new kind of result registers its own: `@figure_of.register`.

    **Raises:** `TypeError` for what has no figure.
    """
    known = ", ".join(kind.__name__ for kind in figure_of.registry if kind is not object)
    raise TypeError(f"there is no figure of a {type(result).__name__}: give one of {known}")


@figure_of.register
def _(result: Estimates) -> Figure:
    one_robot = isinstance(result.model, Chain) and len(result.end) == 1
    return parameters_against_urdf(result) if one_robot else parameters_over_time(result.summarised())


@figure_of.register
def _(result: Payload) -> Figure:
    return load_by_method([result])


@figure_of.register
def _(result: ArmImpedance) -> Figure:
    return ellipses(result.arm.geometry, result.angles, {result.title: result.at_hand})


@figure_of.register
def _(result: TrialsResult) -> Figure:
    return impedance_methods(result.estimates)


@figure_of.register
def _(result: Posterior) -> Figure:
    return corner(result)


@figure_of.register
def _(result: Inference) -> Figure:
    whole, windows = result.summarised
    if windows is None or not result.good.any():
        return corner(whole)
    return bands(result.end, windows, trusted=result.good)


@figure_of.register
def _(result: ArmInference) -> Figure:
    return corner(result.posterior)


@figure_of.register
def _(result: Design) -> Figure:
    return design(result)
