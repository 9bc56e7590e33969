"""Small runs of the calibration experiment: posteriors hold the truth as often as they say."""

from __future__ import annotations

import importlib

import numpy as np
import pytest

from factories.densities import Numbers
from paths import ROOT


@pytest.mark.slow
def test_posteriors_hold_the_truth_and_the_textbooks_do_not(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(ROOT / "experiments")
    experiment = importlib.import_module("calibration")
    random = np.random.default_rng(11)
    ways = {"rig": experiment.rig(True, 40, random, records=400), "arm": experiment.arm(random, records=400)}
    for name, found in ways.items():
        for parameter, cell in found["whitened"].items():
            for level in (0.5, 0.8, 0.95):
                allowed = 3.5 * np.sqrt(level * (1 - level) / 400)
                assert abs(cell[f"{level:.0%}"] - level) < allowed, (name, parameter, level)
            assert cell["p of even ranks"] > 1e-4
    for cell in ways["rig"]["textbook"].values():
        assert cell["95%"] < 0.9
        assert cell["p of even ranks"] < 1e-4


@pytest.mark.slow
def test_samplers_rank_the_truth_where_the_exact_posterior_has_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """Ranks among draws scatter about the exact probabilities as those of independent draws would."""
    monkeypatch.syspath_prepend(ROOT / "experiments")
    experiment = importlib.import_module("calibration")
    random, truth = np.random.default_rng(3), np.array([0.1, 1.5, 20.0, 0.0, np.log(0.3)])
    W = random.normal(size=(16, 24, 4)) * [10, 1, 0.1, 1]
    y = W @ truth[:4] + 0.3 * random.normal(size=(16, 24))
    triangles = [np.linalg.qr(np.column_stack(rows), mode="r") for rows in zip(W, y, strict=True)]
    below = np.stack([experiment.exact(R, 24.0, truth) for R in triangles])
    drawn = experiment.sampled([experiment.rig_density(R, 24.0) for R in triangles], truth, random)

    def scatter(u: Numbers) -> float:
        return float(np.mean((u - below) ** 2 / (below * (1 - below) / experiment.DRAWS + experiment.DRAWS**-2.0)))

    for way, (u, refused) in drawn.items():
        assert refused == 0, way
        assert 0.6 < scatter(u) < 1.5, way
    # as if every row were two that are independent
    assert scatter(np.stack([experiment.exact(np.sqrt(2) * R, 48.0, truth) for R in triangles])) > 1.5
