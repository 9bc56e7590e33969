"""Filters and windows that a job leaves to what suits its recording; recordings in memory without a job."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import jaximp
from factories.joints import JOB, joint
from jaximp.batch.plan import of_recordings
from jaximp.identification.filter_settings import FilterSettings
from jaximp.jobs.job import WindowJob, parse_job
from jaximp.jobs.run import CHOSEN, complete, identify_recording
from jaximp.models import HumanJoint

TIME = np.arange(4000) / 250.0
BARE = '[recording]\nfile = "in the test"\n[model]\nhuman = true\n'


def job(text: str) -> WindowJob:
    found = parse_job(text)
    assert isinstance(found, WindowJob)
    return found


@pytest.mark.parametrize(
    ("tables", "left_out"),
    [
        ("", ("filter", "window")),
        ("[filter]\n", ("window",)),
        ("[window]\nmin_velocity = 0.1\n", ("filter", "window")),
        ("[window]\nlength = 2\n", ("filter",)),
        ("[track]\n", ("filter",)),
        ("[filter]\n[window]\nlength = 2\n", ()),
    ],
)
def test_what_a_job_leaves_out_is_known(tables: str, left_out: tuple[str, ...]) -> None:
    assert job(BARE + tables).left_out == left_out


def test_a_batch_must_be_told() -> None:
    with pytest.raises(ValueError, match=r"leaves out \[filter\] and \[window\], and a batch treats all"):
        of_recordings(job(BARE))


def test_cut_offs_are_proposed_and_said() -> None:
    recording = joint(TIME)
    given, noted = complete(job(BARE + "[window]\nlength = 2\nmin_velocity = 0.1\n"), recording)
    assert given.left_out == ()
    assert given.filter.decimation_cutoff is not None
    assert given.filter.position_cutoff == pytest.approx(2 * given.filter.decimation_cutoff, rel=0.1)
    assert given.window.min_velocity == 0.1
    assert noted.notes[-1].startswith(CHOSEN)
    assert f"decimation_cutoff = {given.filter.decimation_cutoff:g}" in noted.notes[-1]
    assert complete(given, recording) == (given, recording)


@pytest.mark.slow
@pytest.mark.compiles
def test_a_job_without_windows_runs_as_proposed() -> None:
    recording = joint(TIME)
    found = identify_recording(job(BARE + "[filter]\nposition_cutoff = 20\ndecimation_cutoff = 10\n"), recording)[0]
    chosen = f"\n[window]\nlength = {found.window:g}\n"
    assert any(note.startswith(CHOSEN) and chosen.split("\n", 2)[2].strip() in note for note in found.notes)
    written = job(BARE + "[filter]\nposition_cutoff = 20\ndecimation_cutoff = 10" + chosen)
    again = identify_recording(written, recording)[0]
    np.testing.assert_array_equal(found.value, again.value)


def test_a_recording_in_memory_needs_no_job() -> None:
    recording, text = joint(TIME), JOB.replace("length = 1", "length = 2")
    expected = identify_recording(replace(job(text), filter=FilterSettings(20.0, 8, 10.0)), recording)[0]
    found = jaximp.identify(
        recording, model=HumanJoint(), window_s=expected.window, position_cutoff=20.0, decimation_cutoff=10.0
    )
    assert isinstance(found, list)
    np.testing.assert_allclose(found[0]["stiffness"].value.mean(), expected["stiffness"].value.mean(), rtol=1e-3)


def test_what_is_missing_beside_a_recording_is_said() -> None:
    recording = joint(TIME)
    with pytest.raises(ValueError, match="needs a model"):
        jaximp.identify(recording)
    with pytest.raises(ValueError, match="window_s is -1"):
        jaximp.identify(recording, model=HumanJoint(), window_s=-1)
    with pytest.raises(ValueError, match="pass it alone"):
        jaximp.identify(job(BARE), model=HumanJoint())
