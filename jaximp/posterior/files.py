"""Posteriors on disk: the chain of a run that may be interrupted, and ArviZ's InferenceData as NetCDF.

A file is either whole or not there: it is written beside its place and takes its name when it is finished.
"""

from __future__ import annotations

import os
import tempfile
import warnings
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from jaximp.posterior.draws import Posterior, PosteriorMany
from jaximp.types import AnyArray, Numbers

GROUP = "mcmc"
"""The group of the HDF5 file in which emcee looks for a chain."""
SAME = 1e-8
"""Relative tolerance: a file's log density is the same as this run's if both agree so well at the start of every
walker."""
BEGUN = 1e-3
"""Tolerance in standard deviations: starts that differ by less are taken as the same start, which an optimiser found a
second time."""


@dataclass
class Chain:
    """A run of emcee so far, with what tells whether a file holds this run or another."""

    names: tuple[str, ...]
    settings: str
    """The moves of the walkers, in words."""
    centre: Numbers
    """(p,) centre of the independent proposals."""
    spread: Numbers
    """(p, p) covariance of the independent proposals."""
    start: Numbers
    """(walkers, p) the parameters at which the walkers began."""
    start_density: Numbers
    """(walkers,) the log density at the start of each walker."""
    random_state: tuple[Any, ...]
    """The state of numpy's `RandomState` after the last step."""
    steps: list[Numbers] = field(default_factory=list)
    """The parameters of all steps, in blocks of (steps, walkers, p)."""
    densities: list[Numbers] = field(default_factory=list)
    """The log densities of all steps, in blocks of (steps, walkers)."""
    accepted: list[Numbers] = field(default_factory=list)
    """How many proposals each walker accepted, in blocks of (walkers,)."""
    lengths: list[int] = field(default_factory=list)
    """How many steps each block has."""

    def __len__(self) -> int:
        return sum(len(block) for block in self.steps)

    @property
    def last(self) -> tuple[Numbers, Numbers]:
        """The last position of the walkers, and the log density there."""
        return (self.steps[-1][-1], self.densities[-1][-1]) if self.steps else (self.start, self.start_density)

    def append(self, steps: Numbers, densities: Numbers, accepted: Numbers, random_state: tuple[Any, ...]) -> None:
        self.steps.append(steps)
        self.densities.append(densities)
        self.accepted.append(accepted)
        self.lengths.append(len(steps))
        self.random_state = random_state

    def acceptance(self, n: int) -> Numbers:
        """(walkers,) accepted share of the proposals of the blocks up to step n."""
        ends = np.cumsum(self.lengths)
        until = max(1, int(np.searchsorted(ends, n, "right")))
        return np.sum(self.accepted[:until], axis=0) / ends[until - 1]

    def first(self, n: int) -> tuple[Numbers, Numbers]:
        """The first n steps and their log densities."""
        return np.concatenate(self.steps)[:n], np.concatenate(self.densities)[:n]


def resume_chain(path: Path, fresh: Chain, evaluate: Callable[[Numbers], Numbers]) -> Chain:
    """The chain that a file holds if it is that of `fresh`, which is returned where there is no file.

    **Raises:** ValueError for a file of anything else, which is only read.
    """
    if not path.exists():
        if not path.parent.is_dir():
            raise ValueError(f"{path} cannot be written: there is no folder {path.parent}")
        return fresh
    try:
        chain = _read_chain(path)
    except (OSError, KeyError, ValueError, TypeError):
        raise ValueError(f"{path} holds no chain of this program: choose another file") from None
    another = "choose another file, or delete this one"
    if chain.names != fresh.names:
        raise ValueError(f"{path} is of a model with the parameters {', '.join(chain.names)}: {another}")
    if chain.settings != fresh.settings:
        raise ValueError(f"{path} was made with {chain.settings}, not with {fresh.settings}: {another}")
    if not np.allclose(evaluate(chain.start), chain.start_density, rtol=SAME, atol=SAME):
        raise ValueError(f"{path} is of other data or another model, its log density differs: {another}")
    unit = np.sqrt(np.diag(chain.spread))
    apart = (chain.start - fresh.start) / unit, (chain.spread - fresh.spread) / np.outer(unit, unit)
    if max(np.abs(part).max() for part in apart) > BEGUN:
        raise ValueError(f"{path} was begun elsewhere: {another}")
    return chain


def _read_chain(path: Path) -> Chain:
    import h5py

    with h5py.File(path, "r") as file:
        group = file[GROUP]
        state = [group.attrs[f"random_state_{k}"] for k in range(5)]
        return Chain(
            names=tuple(str(name) for name in group.attrs["names"]),
            settings=str(group.attrs["settings"]),
            centre=group["centre"][...],
            spread=group["spread"][...],
            start=group["start"][...],
            start_density=group["start_density"][...],
            random_state=(str(state[0]), state[1], int(state[2]), int(state[3]), float(state[4])),
            steps=[group["chain"][...]] if len(group["chain"]) else [],
            densities=[group["log_prob"][...]] if len(group["chain"]) else [],
            accepted=list(group["accepted_by_block"][...]),
            lengths=[int(n) for n in group["blocks"][...]],
        )


def write_chain(path: Path, chain: Chain) -> None:
    """Write a chain in emcee's layout, for `emcee.backends.HDFBackend`, with what a resumed run needs beside it."""
    import h5py

    n, p = chain.start.shape
    whole, densities = chain.first(len(chain)) if chain.steps else (np.zeros((0, n, p)), np.zeros((0, n)))
    accepted = np.stack(chain.accepted) if chain.accepted else np.zeros((0, n))

    def write(draft: Path) -> None:
        with h5py.File(draft, "w") as file:
            group = file.create_group(GROUP)
            group.attrs.update({"version": "3", "nwalkers": n, "ndim": p, "has_blobs": False, "iteration": len(whole)})
            group.attrs["names"], group.attrs["settings"] = list(chain.names), chain.settings
            for k, part in enumerate(chain.random_state):
                group.attrs[f"random_state_{k}"] = part
            arrays: dict[str, Any] = {"chain": whole, "log_prob": densities, "accepted": accepted.sum(axis=0)}
            own = {"centre": chain.centre, "spread": chain.spread, "start": chain.start}
            own |= {
                "start_density": chain.start_density,
                "accepted_by_block": accepted,
                "blocks": np.array(chain.lengths, int),
            }
            for name, array in (arrays | own).items():
                group.create_dataset(name, data=array)

    _whole(path, write)


def _whole(path: Path, write: Callable[[Path], object]) -> None:
    """Write beside `path`, then take its name: a reader finds the old file or the new one."""
    try:
        handle, name = tempfile.mkstemp(prefix=f".{path.name}.", dir=path.parent or ".")
    except OSError as error:
        raise ValueError(f"{path} cannot be written: {error.strerror}; choose another file") from None
    os.close(handle)
    draft = Path(name)
    try:
        write(draft)
        draft.chmod(0o666 & ~_umask())
        os.replace(draft, path)
    finally:
        with suppress(OSError):
            draft.unlink()


def _umask() -> int:
    value = os.umask(0)
    os.umask(value)
    return value


def to_inference_data(posterior: Posterior | PosteriorMany, windows: AnyArray | None = None) -> Any:
    """ArviZ's InferenceData (before its version 1) or the DataTree that took its place, with the same groups.

    `posterior` holds a variable for each parameter, with dimensions chain and draw (and window), its unit as attribute;
    `sample_stats` the log density `lp` and each chain's accepted share `acceptance_rate`. Attributes say how it was
    sampled and why it cannot be trusted, if so.

    **Arguments:** `windows` (M,) a coordinate for posteriors of many windows, such as the time at their ends [s].
    """
    import xarray as xr

    many = isinstance(posterior, PosteriorMany)
    order = (1, 2, 0) if many else (0, 1)
    chains, density = np.asarray(posterior.chains), np.asarray(posterior.log_density)
    acceptance = np.asarray(posterior.acceptance).T
    dims = ("chain", "draw", "window") if many else ("chain", "draw")
    coords = {"chain": np.arange(density.shape[-2]), "draw": np.arange(density.shape[-1])}
    if many:
        coords["window"] = np.arange(len(density)) if windows is None else np.asarray(windows)
    why = [line for line in posterior.why if line] if isinstance(posterior, PosteriorMany) else posterior.why
    about = {"sampler": posterior.sampler, "inference_library": "jaximp"}
    about |= {"why_not_trusted": "; ".join(why) if isinstance(why, list) else why}
    variables = {
        name: (dims, chains[..., k].transpose(order), {"units": posterior.units[k]})
        for k, name in enumerate(posterior.names)
    }
    stats = {
        "lp": (dims, density.transpose(order), {"long_name": "log density up to a constant"}),
        "acceptance_rate": (("chain", "window")[: acceptance.ndim], acceptance, {"units": "1"}),
    }
    groups = {
        "posterior": xr.Dataset(variables, coords, about),
        "sample_stats": xr.Dataset(stats, coords, about),
    }
    arviz = _arviz()
    if "InferenceData" in vars(arviz):  # from version 1 on asking for it makes a warning
        return arviz.InferenceData(**groups)
    return xr.DataTree.from_dict(groups)


def save_posterior(path: str | Path, posterior: Posterior | PosteriorMany, windows: AnyArray | None = None) -> None:
    """Write NetCDF that `arviz.from_netcdf` reads; see `to_inference_data`.

    **Raises:** ValueError where the file cannot be written.

    **Example:**

    ```pycon
    >>> import tempfile
    >>> from pathlib import Path
    >>> log_density = lambda theta: -0.5 * ((theta - 2) ** 2).sum()
    >>> found = jaximp.sample_posterior(log_density, np.zeros(1), names=["stiffness"], units=["N m/rad"], ess=200)
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     jaximp.save_posterior(Path(folder, "draws.nc"), found)
    ...     print(jaximp.load_posterior(Path(folder, "draws.nc")).names)
    ...
    ('stiffness',)

    ```
    """
    data = to_inference_data(posterior, windows)
    _whole(Path(path), lambda draft: data.to_netcdf(str(draft), engine="h5netcdf"))


def load_posterior(path: str | Path) -> Posterior:
    """One posterior from a file that `save_posterior` wrote, with its diagnostics computed anew.

    **Raises:** ValueError where there is no such file, or it holds something else.

    **Example:**

    ```pycon
    >>> import tempfile
    >>> from pathlib import Path
    >>> log_density = lambda theta: -0.5 * ((theta - 2) ** 2).sum()
    >>> found = jaximp.sample_posterior(log_density, np.zeros(1), names=["stiffness"], units=["N m/rad"], ess=200)
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     jaximp.save_posterior(Path(folder, "draws.nc"), found)
    ...     print(jaximp.load_posterior(Path(folder, "draws.nc")).names)
    ...
    ('stiffness',)

    ```
    """
    import xarray as xr

    from jaximp.posterior.draws import make_posterior

    try:
        with xr.open_dataset(path, group="posterior", engine="h5netcdf") as data, warnings.catch_warnings():
            names: Sequence[str] = [str(name) for name in data.data_vars]
            chains = np.stack([data[name].transpose("chain", "draw").values for name in names], axis=-1)
            units = [str(data[name].attrs.get("units", "1")) for name in names]
            sampler = str(data.attrs.get("sampler", ""))
        with xr.open_dataset(path, group="sample_stats", engine="h5netcdf") as data:
            density, acceptance = data["lp"].values, data["acceptance_rate"].values
    except (OSError, KeyError, ValueError):
        raise ValueError(f"{path} is no file with one posterior: write one with save_posterior") from None
    return make_posterior(chains, names, units, log_density=density, acceptance=acceptance, sampler=sampler)


def _arviz() -> Any:
    """Imported here only: once a day it warns that its next version will differ, which `to_inference_data` knows."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FutureWarning)
        import arviz
    return arviz
