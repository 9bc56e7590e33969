"""The sample recording: it is what its script makes, and its job finds the truth that the script holds."""

from __future__ import annotations

import runpy

import numpy as np
import pytest
from scipy.stats import t as student

from jaximp.identification.estimates import Estimates
from jaximp.jobs.job import read_job
from jaximp.jobs.run import identify
from paths import ROOT

FOLDER = ROOT / "examples"
ANKLE = runpy.run_path(str(FOLDER / "make_ankle.py"))


@pytest.fixture(scope="module")
def estimates() -> Estimates:
    return identify(read_job(FOLDER / "ankle.toml"))[0]


def test_the_recording_is_what_the_script_makes() -> None:
    written = np.loadtxt(FOLDER / "ankle.csv", delimiter=",", skiprows=1)
    # Another processor may round the last digit otherwise.
    np.testing.assert_allclose(written, ANKLE["recording"](), atol=1.01 * ANKLE["ENCODER_STEP"])
    assert (FOLDER / "ankle.csv").stat().st_size < 600_000


@pytest.mark.parametrize("half", [0, 1], ids=["before", "after"])
def test_the_truth_is_found_on_both_sides_of_the_change(half: int, estimates: Estimates) -> None:
    inside = estimates.start >= ANKLE["CHANGE"] if half else estimates.end < ANKLE["CHANGE"]
    assert np.count_nonzero(inside) > 200
    assert np.asarray(estimates.verdicts.trusted)[inside].all()
    stiffness = ANKLE["STIFFNESS"][half]
    truth = np.array([ANKLE["INERTIA"], ANKLE["DAMPING"], stiffness, -stiffness * ANKLE["EQUILIBRIUM"]])
    theta, stderr = (np.asarray(x)[inside] for x in (estimates.fit.theta, estimates.fit.stderr))
    reach = student.ppf(0.975, np.asarray(estimates.fit.dof)[inside])[:, None] * stderr
    assert (np.abs(theta - truth) <= reach).mean() > 0.9
    np.testing.assert_allclose(theta.mean(axis=0), truth, rtol=0.03)


def test_no_window_over_the_change_passes_for_a_stiffness(estimates: Estimates) -> None:
    well_inside = (estimates.start < ANKLE["CHANGE"] - 0.2) & (estimates.end > ANKLE["CHANGE"] + 0.2)
    assert np.count_nonzero(well_inside) > 10
    assert not np.asarray(estimates.verdicts.trusted)[well_inside].any()


def test_most_windows_are_trusted(estimates: Estimates) -> None:
    assert np.mean(estimates.verdicts.trusted) > 0.85
