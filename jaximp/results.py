"""What every result offers: its parameters by name, with interval and unit; as a table; as a figure.

Results of windows hold M estimates of each parameter, others hold one.
"""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from jaximp.types import Numbers, nearest

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr


class Column(NamedTuple):
    """One column of a table of results; a name means one thing in all of them."""

    name: str
    unit: str
    values: Any
    """One number or text per row."""


@dataclass(frozen=True, eq=False)
class Parameter:
    """One parameter of a result."""

    result: Result
    name: str

    @property
    def _place(self) -> int:
        return self.result.names.index(self.name)

    @property
    def unit(self) -> str:
        return self.result.units[self._place]

    @property
    def value(self) -> Numbers:
        """(M,) or ()."""
        return np.asarray(self.result.value)[..., self._place]

    @property
    def stderr(self) -> Numbers:
        """(M,) or (), in the unit of the value."""
        return np.asarray(self.result.stderr)[..., self._place]

    def interval(self, level: float = 0.95) -> tuple[Numbers, Numbers]:
        """(M,) or (): lower and upper end of the interval that holds the truth with probability `level`."""
        low, high = self.result.interval(level)
        return low[..., self._place], high[..., self._place]

    def __repr__(self) -> str:
        if np.ndim(self.value):
            return f"{self.name} in {len(self.value)} windows [{self.unit}]"
        return f"{self.name} {float(self.value):.4g} ± {float(self.stderr):.2g} {self.unit}"


class Result:
    """Estimates of named parameters.

    A kind of result says what its `names`, `units`, `value`, `stderr`, `dof` and `columns` are; all else follows.
    """

    # Not annotated as fields: some kinds of result store them, others work them out.
    if TYPE_CHECKING:

        @property
        def names(self) -> tuple[str, ...]: ...
        @property
        def units(self) -> tuple[str, ...]: ...

    @property
    def value(self) -> Numbers:
        """(M, p) or (p,) estimates."""
        raise TypeError(f"{type(self).__name__} has no values")

    @property
    def stderr(self) -> Numbers:
        """(M, p) or (p,) standard errors."""
        raise TypeError(f"{type(self).__name__} has no standard errors")

    def interval(self, level: float = 0.95) -> tuple[Numbers, Numbers]:
        """(M, p) or (p,): lower and upper ends of the intervals that hold the truth with probability `level`."""
        raise TypeError(f"{type(self).__name__} has no intervals")

    def columns(self) -> list[Column]:
        """The result as a table: a row for each window, or one."""
        raise TypeError(f"{type(self).__name__} has no table")

    def __getitem__(self, name: str) -> Parameter:
        """One parameter: `result["stiffness"].value`, `.stderr`, `.interval(0.95)`, `.unit`.

        **Raises:** `KeyError` with the nearest name there is.
        """
        if name not in self.names:
            raise KeyError(f"there is no parameter '{name}': {nearest(name, list(self.names))}")
        return Parameter(self, name)

    def to_pandas(self) -> pd.DataFrame:
        """The table as a data frame; `frame.attrs["units"]` has the unit of every column. Needs pandas."""
        pandas = _needed("pandas", "to_pandas")
        columns = self.columns()
        frame: pd.DataFrame = pandas.DataFrame({column.name: np.atleast_1d(column.values) for column in columns})
        frame.attrs["units"] = {column.name: column.unit for column in columns}
        return frame

    def to_xarray(self) -> xr.Dataset:
        """The table as a data set over windows; every variable has its unit in `attrs["units"]`. Needs xarray."""
        xarray = _needed("xarray", "to_xarray")
        variables = {
            column.name: ("window", np.atleast_1d(column.values), {"units": column.unit}) for column in self.columns()
        }
        times = {name: variables.pop(name) for name in ("start_s", "end_s") if name in variables}
        dataset: xr.Dataset = xarray.Dataset(variables, coords=times)
        return dataset

    def plot(self) -> Any:
        """The figure that shows the result at a glance: a `Figure` of matplotlib's."""
        # The figures stand above the numbers: they register themselves for the kinds of result that they know.
        return import_module(f"{__package__}.plots.registry").figure_of(self)


def _needed(library: str, method: str) -> Any:
    try:
        return import_module(library)
    except ImportError:
        raise ImportError(f"{method} needs {library}: pip install {library}") from None
