"""The papers' figures and tables come out, and say what they should."""

import json
from pathlib import Path

import numpy as np
import pytest

from jaximp.studies import tout2023


def test_tout2023_is_reproduced(tmp_path: Path) -> None:
    tout2023.reproduce(tmp_path)
    figures = {path.stem for path in tmp_path.glob("*.png")}
    assert figures == {"figure_2a", "figure_2b", "figure_3a", "figure_3b", "figure_3c"}
    tables = json.loads((tmp_path / "tables.json").read_text())
    assert tables["paper"]["convergence_s"]["model 2, sliding window"] == 2.0
    measured = tables["measured"]
    for length, spread in (("1 s", 4e-5), ("2 s", 1e-5), ("4 s", 1e-5)):
        window = measured["fig2a_windows"][length]
        assert window["before_mean"] == pytest.approx(1e-3, rel=0.02)
        assert window["after_mean"] == pytest.approx(2e-3, rel=0.02)
        assert window["after_sd"] < spread
    # Forgetting less, recursive least squares stays further from the new value.
    after = [measured["fig2a_recursive"][f"RLS {n:g}"]["after_mean"] for n in tout2023.FORGETTING]
    assert np.all(np.diff(after[1:]) < 0)
    assert after[-1] < 1.7e-3
    # Method 2 fails as in the paper, the others agree.
    methods = measured["fig2b_methods"]
    assert methods["method 2"]["before_sd"] > 100 * methods["method 1"]["before_sd"]
    assert methods["method 2"]["median_condition"] > 1e3
    for n in (1, 3, 4):
        assert methods[f"method {n}"]["after_mean"] == pytest.approx(2e-3, rel=0.01)
    vaf = measured["fig3c_vaf_percent"]
    assert vaf["model 2, sliding window"] > vaf["model 1, sliding window"] > 90
    assert "| VAF, model 2, sliding window | 77.0 % |" in (tmp_path / "tables.md").read_text()


@pytest.mark.parametrize(
    ("values", "settled", "expected"),
    [
        ([2, 2, 2, 1, 1, 1, 1], 2.0, 0.0),
        ([2, 2, 2, 2, 1, 1, 1], 2.0, 1.0),
        ([2, 2, 2, 1, 2, 1, 1], 0.0, 0.0),
        ([2, 2, 2, 1, 2, 1, 1], 1.0, 2.0),
        ([2, 2, 2, 2, 2, 2, 1], 1.0, None),
        ([2, 2, 2, 2, np.nan, 1, 1], 1.0, 2.0),
    ],
)
def test_convergence_time(values: list[float], settled: float, expected: float | None) -> None:
    track = tout2023.Track("x", np.arange(7.0) + 1.5, np.array(values, float))
    found = tout2023.convergence_time(track, 4.5, settled)
    assert found == expected
