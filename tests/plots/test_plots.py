"""Figures: they render, say units, show intervals, and stay small for long recordings."""

from __future__ import annotations

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import matplotlib
import numpy as np
import pytest
from matplotlib.figure import Figure
from numpy.typing import NDArray

from factories.estimates import identified, repeat, without_trust
from jaximp import plots
from jaximp.identification.estimates import Estimates
from jaximp.models import SIX_JOINT_ARM, ArmGeometry, Chain, EndpointImpedance, endpoint_impedance
from jaximp.plots import excitation
from jaximp.plots.style import BLACK, POINTS, draw_line
from jaximp.trust.verdicts import TRUSTED


@pytest.fixture
def estimates() -> Estimates:
    return identified()


FIGURES = {
    "parameters": plots.parameters_over_time,
    "condition": plots.condition_over_time,
    "torque": plots.torque,
    "spectrum": plots.residual_spectrum,
    "by_frequency": plots.by_frequency,
    "window_lengths": lambda estimates: plots.window_lengths([estimates, replace(estimates, window=4.0)]),
    "methods": lambda estimates: plots.methods([replace(estimates, method=1), replace(estimates, method=3)]),
}
UNITS = {
    "parameters": ("(kg m²)", "(N m s/rad)", "(N m/rad)", "(N m)", "middle of the window (s)"),
    "condition": ("(1)", "middle of the window (s)"),
    "torque": ("torque (N m)", "residual (N m)", "time (s)"),
    "spectrum": ("[(N m)²/Hz]", "frequency (Hz)"),
    "by_frequency": ("inertia (kg m²)", "stiffness (N m/rad)", "frequency (Hz)", "95% interval"),
    "window_lengths": ("stiffness (N m/rad)", "window length (s)", "(1)"),
    "methods": ("stiffness (N m/rad)", "middle of the window (s)"),
}


def words_on(figure: Figure) -> str:
    return "\n".join(text.get_text() for text in figure.findobj(matplotlib.text.Text))


@pytest.mark.parametrize("name", FIGURES)
def test_figure_renders_and_says_its_units(name: str, estimates: Estimates) -> None:
    before = dict(matplotlib.rcParams)
    figure = FIGURES[name](estimates)
    assert plots.png(figure).startswith(b"\x89PNG")
    for label in UNITS[name]:
        assert label in words_on(figure)
    assert dict(matplotlib.rcParams) == before


@pytest.mark.parametrize("name", FIGURES)
def test_figure_shows_no_mean_without_any_trusted_window(name: str, estimates: Estimates) -> None:
    figure = FIGURES[name](without_trust(estimates))
    assert "mean over trusted" not in words_on(figure)


@pytest.mark.parametrize("name", FIGURES)
def test_figure_renders_without_any_number(name: str, estimates: Estimates) -> None:
    fit = jax.tree.map(lambda x: jnp.full(x.shape, jnp.nan), estimates.fit)
    nothing = np.full_like(estimates.torque, np.nan)
    empty = replace(without_trust(estimates), fit=fit, torque=nothing, reconstructed=nothing, predicted=nothing)
    assert plots.png(FIGURES[name](replace(empty, held_out_vaf=np.full(len(empty.end), np.nan))))


def test_bands_that_do_not_determine_a_parameter_are_hatched_and_joints_have_rows(estimates: Estimates) -> None:
    (found,) = estimates.frequencies
    value = found.value.copy()
    value[-1, 0] = np.nan
    one = plots.by_frequency(replace(estimates, frequencies=(replace(found, value=value),)))
    assert "not determined" in words_on(one)
    assert "not determined" not in words_on(
        plots.by_frequency(replace(estimates, frequencies=(replace(found, value=0 * found.value),)))
    )
    two = plots.by_frequency(replace(estimates, frequencies=(found.of_joint(0), found.of_joint(1))))
    assert len(two.axes) == 2 * len(one.axes)
    assert "joint2 stiffness (N m/rad)" in words_on(two)
    with pytest.raises(ValueError, match="were not split by frequency"):
        plots.by_frequency(replace(estimates, frequencies=()))


@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=[pytest.mark.slow] if name in ("methods", "window_lengths") else []) for name in FIGURES],
)
def test_long_recordings_are_thinned(name: str, estimates: Estimates) -> None:
    figure = FIGURES[name](repeat(estimates, 50_000, 1_000_000))
    lines = [line for panel in figure.axes for line in panel.get_lines()]
    assert lines
    if name != "spectrum":  # its points are frequencies, an eighth of a stretch without a gap
        assert max(len(line.get_xdata()) for line in lines) <= POINTS


def test_still_phase_is_shaded_and_trusted_windows_have_a_band(estimates: Estimates) -> None:
    counts = estimates.verdicts.counts()
    assert counts[TRUSTED] > 10
    assert sum(counts.values()) - counts[TRUSTED] > 5
    figure = plots.parameters_over_time(estimates)
    for panel in figure.axes:
        assert any(collection.get_hatch() for collection in panel.collections)
    words = words_on(figure)
    assert "95% interval" in words
    assert "mean over trusted" in words


def test_a_wild_window_does_not_squash_the_others(estimates: Estimates) -> None:
    wild = int(np.flatnonzero(~estimates.verdicts.trusted)[0])
    fit = eqx.tree_at(lambda fit: fit.theta, estimates.fit, jnp.asarray(estimates.fit.theta).at[wild].set(1e12))
    limits = [panel.get_ylim() for panel in plots.parameters_over_time(replace(estimates, fit=fit)).axes]
    assert limits == [panel.get_ylim() for panel in plots.parameters_over_time(estimates).axes]


def test_envelope_keeps_a_spike() -> None:
    y: NDArray[np.float64] = np.zeros(100_000)
    y[54_321] = 7.0
    panel = Figure().subplots()
    draw_line(panel, np.arange(len(y), dtype=float), y)
    assert panel.get_lines()[0].get_ydata().max() == 7.0


@pytest.mark.parametrize(
    ("value", "text"),
    [(63.2862, "63.29"), (6.334e-5, "6.334×10⁻⁵"), (-2.5e12, "−2.5×10¹²"), (0.0, "0"), (float("nan"), "–")],
)
def test_numbers_are_written_for_people(value: float, text: str) -> None:
    assert plots.number(value) == text


def test_ellipses_stand_at_the_hand_with_scale_bars() -> None:
    geometry, q = ArmGeometry((0.29, 0.34)), np.array([0.5, 1.5])
    xi, D, K = np.array([0.268, 0.084, 0.074]), np.array([[2.4, 1.2], [1.2, 1.4]]), np.array([[29, 14], [14, 17.0]])
    truth = endpoint_impedance(geometry, q, xi, D, K)
    unknown = EndpointImpedance(truth.inertia, truth.damping, jnp.full((2, 2), jnp.nan))
    figure = plots.ellipses(
        geometry, q, {"one": unknown, "two": endpoint_impedance(geometry, q, xi, D, 1.3 * K)}, truth
    )
    assert plots.png(figure).startswith(b"\x89PNG")
    for label in ("inertia", "damping", "stiffness", " kg", " N s/m", " N/m", "x (m)", "y (m)", "truth", "two"):
        assert label in words_on(figure)
    middles = [np.mean(line.get_xydata()[:-1], axis=0) for panel in figure.axes for line in panel.get_lines()[1:4]]
    known = [middle for middle in middles if np.isfinite(middle).all()]
    assert len(known) == 8
    np.testing.assert_allclose(known, np.broadcast_to(geometry.forward(q), (8, 2)), atol=1e-9)
    nothing = EndpointImpedance(*(jnp.full((2, 2), jnp.nan),) * 3)
    assert plots.png(plots.ellipses(geometry, q, {"nothing": nothing}))


def test_a_robot_is_drawn_where_its_joints_are() -> None:
    arm = Chain.from_urdf(SIX_JOINT_ARM, tip="tool")
    motion = np.linspace(0, 1, 30)[:, None] * np.array([0.3, 0.5, 0.7, 0.1, 0.2, 0.4])
    for q in (None, motion[-1], motion):
        figure = plots.robot(arm, q)
        assert plots.png(figure).startswith(b"\x89PNG")
        tip = next(line for line in figure.axes[0].get_lines() if line.get_label() == "tip")
        expected = arm.forward_kinematics(np.zeros(6) if q is None else np.atleast_2d(q)[0])[1]
        np.testing.assert_allclose(np.ravel(tip.get_data()), np.asarray(expected)[[0, 2]], atol=1e-12)
    assert "path of the tip" in words_on(figure)


def test_what_was_measured_shows_under_a_model_that_hardly_differs(estimates: Estimates) -> None:
    upper = plots.torque(estimates).axes[1]
    lines = {str(line.get_label()): line for line in upper.get_lines()}
    model = lines["model, fitted"]
    assert lines["measured"].get_linewidth() > 3 * model.get_linewidth()
    assert lines["measured"].get_color() != model.get_color()


def test_a_clock_that_began_long_before_is_said_to_be_the_recordings(estimates: Estimates) -> None:
    late = replace(estimates, time=estimates.time + 1723.0)
    assert "time by the recording's clock (s)" in words_on(plots.torque(late))
    assert "recording's clock" not in words_on(plots.torque(estimates))


def test_limits_of_joints_that_differ_have_the_colors_of_their_joints() -> None:
    axis = Figure().subplots()
    excitation._limits(axis, np.array([1.0, 2.0, np.inf, 2.5]))
    joints = [excitation._line(j)[0] for j in (0, 1, 3)]
    assert [line.get_color() for line in axis.get_lines()] == joints
    alike = Figure().subplots()
    excitation._limits(alike, np.array([1.0, 1.0]))
    assert [line.get_color() for line in alike.get_lines()] == [BLACK]
