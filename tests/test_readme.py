"""The README's first example runs as it stands and finds what it says."""

import re
from pathlib import Path

import numpy as np


def test_the_first_example_runs() -> None:
    text = (Path(__file__).parents[1] / "README.md").read_text()
    code = re.findall(r"```python\n(.*?)```", text, re.DOTALL)[0]
    assert text[: text.index("```python")].count("\n") < 25
    names: dict[str, object] = {}
    exec(code, names)
    stiffness = np.asarray(names["fit"].theta)[:, 2]  # type: ignore[attr-defined]
    np.testing.assert_allclose(stiffness[:9], 20, rtol=0.03)
    np.testing.assert_allclose(stiffness[-9:], 30, rtol=0.03)
