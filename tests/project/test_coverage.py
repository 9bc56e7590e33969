"""A small run of the calibration experiment, which the textbook's standard errors would fail."""

import importlib.util

import numpy as np
import pytest

from paths import ROOT

RECORDS = 400


@pytest.mark.slow
def test_intervals_hold_the_truth_and_the_textbooks_do_not(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(ROOT / "experiments")
    path = ROOT / "experiments" / "coverage.py"
    spec = importlib.util.spec_from_file_location("coverage_experiment", path)
    assert spec is not None
    assert spec.loader is not None
    experiment = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(experiment)
    experiment.RECORDS = RECORDS
    ways = experiment.run(True, 40, np.random.default_rng(7))
    for level in (0.5, 0.8, 0.95):
        allowed = 3.5 * np.sqrt(level * (1 - level) / RECORDS)
        for name, cells in ways["filtered once"].items():
            assert abs(cells[f"{level:.0%}"] - level) < allowed, (name, level)
        for cells in ways["filtered once, textbook"].values():
            assert cells[f"{level:.0%}"] < level - allowed
    bias = {way: cells["inertia"]["bias_in_standard_deviations"] for way, cells in ways.items()}
    assert bias["filtered in the window"] > 1
    assert bias["filtered in the window, ends dropped"] < 0.5
    assert bias["filtered once"] < 0.5
