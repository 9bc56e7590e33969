"""Windows that share their sums are as good as windows that are decomposed one by one."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from jaximp import windows
from jaximp.windows import SlidingFit, sliding_least_squares, sliding_theta

Numbers = NDArray[np.float64]


@pytest.fixture(autouse=True)
def shared_sums(monkeypatch: pytest.MonkeyPatch) -> None:
    """Also for few windows, where one would not take them."""
    monkeypatch.setattr(windows, "FROM_CHUNKS", 0)


def one_by_one(*arguments: object, **settings: object) -> SlidingFit:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(windows, "FROM_CHUNKS", 10**18)
        return sliding_least_squares(*arguments, **settings)  # type: ignore[arg-type]


def recording(n: int, p: int = 3, outputs: tuple[int, ...] = (), seed: int = 0) -> tuple[Numbers, Numbers]:
    random = np.random.default_rng(seed)
    W = random.normal(size=(n, *outputs, p)) @ random.normal(size=(p, p)) * np.geomspace(30, 0.3, p)
    return W, W @ np.arange(1.0, p + 1) + 0.1 * random.normal(size=(n, *outputs))


def assert_same(fit: SlidingFit, expected: SlidingFit, torque: Numbers, rtol: float = 1e-9) -> None:
    for name in SlidingFit.__annotations__:
        reference = np.asarray(getattr(expected, name), float)
        atol = 1e-12 * np.nanmax(np.abs(reference), initial=0.0)
        if name == "residual_rms":  # a square root: where nothing is left, half of the digits are
            atol = 1e-8 * float(np.sqrt(np.mean(torque**2)))
        np.testing.assert_allclose(getattr(fit, name), reference, rtol, atol, err_msg=name)


@pytest.mark.parametrize(
    ("n", "window", "step", "p", "outputs"),
    [
        pytest.param(1500, 100, 1, 3, (), id="every window"),
        pytest.param(1500, 97, 1, 4, (), id="of a prime length"),
        pytest.param(1200, 5, 1, 3, (), id="shorter than a block"),
        pytest.param(1200, 3, 1, 3, (), id="as short as can be"),
        pytest.param(900, 64, 5, 3, (), id="some rows apart"),
        pytest.param(4000, 300, 47, 2, (), id="many rows apart"),
        pytest.param(900, 20, 31, 3, (), id="with gaps between them"),
        pytest.param(700, 700, 3, 3, (), id="the whole recording"),
        pytest.param(600, 50, 1, 1, (), id="one column"),
        pytest.param(600, 50, 3, 2, (), id="two columns"),
        pytest.param(500, 40, 1, 3, (2,), id="two outputs"),
        pytest.param(500, 41, 7, 3, (3,), id="three outputs, some samples apart"),
    ],
)
def test_windows_are_those_of_the_qr_decomposition(
    n: int, window: int, step: int, p: int, outputs: tuple[int, ...]
) -> None:
    W, y = recording(n, p, outputs)
    valid = np.random.default_rng(3).random(y.shape) < 0.9
    for mask in (None, valid)[: 1 + (window > 10)]:
        expected = one_by_one(W, y, window, step, valid=mask)
        fit = sliding_least_squares(W, y, window, step, valid=mask)
        assert_same(fit, expected, y)
        np.testing.assert_allclose(sliding_theta(W, y, window, step, valid=mask), expected.theta, 1e-9)
