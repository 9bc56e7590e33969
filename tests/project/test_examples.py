"""The sample recording: it is what its script makes, and its job finds the truth that the script holds."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import t as student

from jaximp.identification.estimates import Estimates
from jaximp.jobs.job import read_job
from jaximp.jobs.run import identify
from jaximp.simulation import ankle
from paths import ROOT

FOLDER = ROOT / "examples"


@pytest.fixture(scope="module")
def estimates() -> Estimates:
    return identify(read_job(FOLDER / "ankle.toml"))[0]


def test_the_demo_runs_the_same_job() -> None:
    assert (FOLDER / "ankle.toml").read_text(encoding="utf-8") == ankle.JOB


def test_the_recording_is_what_the_script_makes() -> None:
    written = np.loadtxt(FOLDER / "ankle.csv", delimiter=",", skiprows=1)
    # Another processor may round the last digit otherwise.
    np.testing.assert_allclose(written, ankle.ankle_recording(), atol=1.01 * ankle.ENCODER_STEP)
    assert (FOLDER / "ankle.csv").stat().st_size < 600_000


@pytest.mark.parametrize("half", [0, 1], ids=["before", "after"])
def test_the_truth_is_found_on_both_sides_of_the_change(half: int, estimates: Estimates) -> None:
    inside = estimates.start >= ankle.CHANGE if half else estimates.end < ankle.CHANGE
    assert np.count_nonzero(inside) > 200
    assert np.asarray(estimates.verdicts.trusted)[inside].all()
    stiffness = ankle.STIFFNESS[half]
    truth = np.array([ankle.INERTIA, ankle.DAMPING, stiffness, -stiffness * ankle.EQUILIBRIUM])
    theta, stderr = (np.asarray(x)[inside] for x in (estimates.fit.theta, estimates.fit.stderr))
    reach = student.ppf(0.975, np.asarray(estimates.fit.dof)[inside])[:, None] * stderr
    assert (np.abs(theta - truth) <= reach).mean() > 0.9
    np.testing.assert_allclose(theta.mean(axis=0), truth, rtol=0.03)


def test_no_window_over_the_change_passes_for_a_stiffness(estimates: Estimates) -> None:
    well_inside = (estimates.start < ankle.CHANGE - 0.2) & (estimates.end > ankle.CHANGE + 0.2)
    assert np.count_nonzero(well_inside) > 10
    assert not np.asarray(estimates.verdicts.trusted)[well_inside].any()


def test_most_windows_are_trusted(estimates: Estimates) -> None:
    assert np.mean(estimates.verdicts.trusted) > 0.85
