"""The `[trials]` table of a job: where recorded trials of an arm are, and how they are to be read.

```toml
[trials]
files = "movements/*.csv"            # one file a trial: a name, a pattern, a folder, or a list of these
# file = "movements.parquet"         # or all in one file, told apart by a column
# trial = "trial"
time = "time_s"                      # columns as in [recording]; or sample_rate = 4000
position = ["x", "y"]                # m, of the hand
torque = ["fx", "fy"]                # N, of the handle on the hand
command = ["px", "py"]               # N, the perturbing force: zero in unperturbed trials
method = "feedback_jerk"             # or several: the first makes the report, the others stand beside it
[trials.handle]
mass = [5, 5]                        # kg, of the admittance
damping = [20, 20]                   # N s/m
[trials.posture]                     # perturbed postures, from which the inertia comes; or model.arm.inertia
file = "postures.parquet"            # what is not given here is as above
reference = ["rx", "ry"]             # m, that the handle was asked to follow; or command
```
"""

from __future__ import annotations

import glob
import inspect
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

from jaximp.jobs.settings import check_keys, settings
from jaximp.models.kinematics import ArmGeometry
from jaximp.perturbation.reading import TASKS, read_trials
from jaximp.perturbation.trials import VOLUNTARY_DELAY, Handle, Trials
from jaximp.recordings.load import load_recording, load_trial_table
from jaximp.recordings.mapping import check_mapping
from jaximp.recordings.readers.formats import FORMATS
from jaximp.types import Recording, nearest

STATIC_WINDOW = 0.4
"""Time after the onset of a perturbed posture from which the inertia is estimated [s]."""
_POSTURE = ("files", "file", "trial", "onset", "window")
"""Keys of `[trials.posture]` beside the columns."""
_ASKED = ("command", "reference")
"""Columns that say what was asked for: `[trials.posture]` names its own, or takes that of `[trials]`."""
_FIXED = ("joint", "gear_ratio", "name", "force")
"""Keys of `load_recording` that have no meaning for a hand in a plane."""


@dataclass(frozen=True)
class HandleSettings:
    """`[trials.handle]`: the admittance of the handle, as in `Handle`."""

    mass: list[float]
    """Mass that the admittance simulates along both axes [kg]."""
    damping: list[float]
    """Its damping along both axes [N s/m]."""
    own_mass: float = 0.0
    """Mass between force sensor and hand [kg]."""

    def make(self) -> Handle:
        return Handle(tuple(self.mass), tuple(self.damping), self.own_mass)


@dataclass(frozen=True)
class TriggerSettings:
    """`[trials.trigger]`: the place at which perturbations begin."""

    axis: int
    """The axis along which the hand passes that place: 1 or 2."""
    position: float
    """Where the hand was on that axis when perturbations began [m]."""


@dataclass(frozen=True)
class TrialsSettings:
    """`[trials]`."""

    task: str = "movement"
    """One of `reading.TASKS`."""
    method: str | list[str] = "output_error"
    """`output_error`, `feedback_jerk`, `gomi_kawato` or `erden_billard`, or a list of several: the first makes the
    report, the others stand beside it."""
    window: float = VOLUNTARY_DELAY
    """Time after the onset from which the impedance is estimated [s]."""
    cutoff: list[float] | None = None
    """Cut-off frequencies along both axes [Hz], which `feedback_jerk` needs where there are no unperturbed trials."""
    onset: float | list[float] | None = None
    """When the perturbation begins [s], in each trial's own time; `nan` for an unperturbed trial. By default it is
    found in the command."""
    trigger: TriggerSettings | None = None
    """The place at which perturbations begin, by which unperturbed trials are aligned; by default it is found."""
    handle: HandleSettings | None = None
    """The admittance of the handle, which `output_error` and `feedback_jerk` must know."""
    files: str | list[str] | None = None
    """One file a trial: a name, a pattern, a folder, or a list of these."""
    file: str | None = None
    """The file that holds all trials, in place of `files`."""
    trial: str = "trial"
    """The column of `file` that tells the trials apart."""
    mapping: Mapping[str, Any] = field(default_factory=dict)
    """Columns: keywords of `load_recording`."""
    geometry: ArmGeometry | None = None
    """From `[model.arm]`: positions out of its reach are refused."""
    folder: Path = Path()
    """Where relative names start."""
    posture: TrialsSettings | None = None
    """`[trials.posture]`: trials of the static task, for the inertia."""

    @property
    def methods(self) -> tuple[str, ...]:
        """All of them, the main one first."""
        return (self.method,) if isinstance(self.method, str) else tuple(self.method)

    def known_handle(self) -> Handle | None:
        return None if self.handle is None else self.handle.make()

    def paths(self) -> list[Path]:
        """Every file, in order; patterns and folders bring theirs in the order of the numbers in their names.

        **Raises:** `ValueError` for a pattern or a folder without files, and `FileNotFoundError`.
        """
        if self.file is not None:
            return [self.folder / self.file]
        names = [self.files] if isinstance(self.files, str) else self.files or []
        return [path for name in names for path in _matching(self.folder, name)]

    def recordings(self) -> list[Recording]:
        """One for each trial, as measured.

        **Raises:** as `load_recording`.
        """
        if self.file is not None:
            return load_trial_table(self.folder / self.file, self.trial, joint="prismatic", **self.mapping)
        return [load_recording(path, joint="prismatic", **self.mapping) for path in self.paths()]

    def load(self, smooth: bool = True) -> tuple[Trials, Trials | None, tuple[str, ...]]:
        """Perturbed and unperturbed trials, and notes in plain words: see `read_trials`.

        **Raises:** as that and `load_recording`.
        """
        trigger = None if self.trigger is None else (self.trigger.axis - 1, self.trigger.position)
        return read_trials(
            self.recordings(), self.task, window=self.window, onset=self.onset, trigger=trigger,
            handle=self.known_handle(), geometry=self.geometry, smooth=smooth,
        )  # fmt: skip


def trials_settings(table: Any, folder: Path, geometry: ArmGeometry | None) -> TrialsSettings:
    """`[trials]` from TOML, with every key and value checked.

    **Raises:** `ValueError` that names the key and the remedy.
    """
    if not isinstance(table, dict):
        raise ValueError("[trials] must be a table")
    if "force" in table:
        raise ValueError("[trials] calls the force on the hand 'torque', as [recording] does: rename 'force'")
    columns = [key for key in list(inspect.signature(load_recording).parameters)[1:] if key not in _FIXED]
    made_here = ("mapping", "geometry", "folder", "posture")
    own = [setting.name for setting in fields(TrialsSettings) if setting.name not in made_here]
    check_keys(table, [*own, *columns, "posture"], "[trials]")
    mapping = {key: value for key, value in table.items() if key in columns}
    check_mapping(mapping, "[trials]")
    plain = settings(TrialsSettings, {key: value for key, value in table.items() if key in own}, "trials")
    made = replace(plain, mapping=mapping, geometry=geometry, folder=folder)
    _check_files(made, table, "trials")
    _check_values(made)
    if "posture" in table:
        made = replace(made, posture=_posture_settings(table["posture"], made, columns))
    return made


def _posture_settings(table: Any, trials: TrialsSettings, columns: list[str]) -> TrialsSettings:
    """`[trials.posture]`; columns (and the column of the trial) that it does not name are those of `[trials]`."""
    where = "[trials.posture]"
    if not isinstance(table, dict):
        raise ValueError(f"{where} must be a table")
    if trials.task == "posture":
        raise ValueError(f"{where} belongs to movements: leave out trials.task, or {where}")
    check_keys(table, [*_POSTURE, *columns], where)
    mapping = {key: value for key, value in table.items() if key in columns}
    instead = dict.fromkeys(_ASKED, _ASKED) | {"sample_rate": ("time",), "time": ("sample_rate",)}
    replaced = {other for key in mapping for other in instead.get(key, ())}
    mapping = {key: value for key, value in trials.mapping.items() if key not in replaced} | mapping
    check_mapping(mapping, where)
    given = {key: value for key, value in table.items() if key in _POSTURE}
    usual = {"window": STATIC_WINDOW} | ({"trial": trials.trial} if "file" in table else {})
    plain = settings(TrialsSettings, usual | given, "trials.posture")
    made = replace(plain, task="posture", mapping=mapping, geometry=trials.geometry, folder=trials.folder)
    _check_files(made, table, "trials.posture")
    _check_window(made.window, "trials.posture")
    return made


def _check_files(trials: TrialsSettings, table: Mapping[str, Any], where: str) -> None:
    if (trials.file is None) == (not trials.files):
        raise ValueError(f"[{where}] needs either 'files' (one a trial) or 'file' (all in one), one of the two")
    if trials.file is None and "trial" in table:
        raise ValueError(f"{where}.trial tells the trials of one 'file' apart: leave it out beside 'files'")


def _check_values(trials: TrialsSettings) -> None:
    if trials.task not in TASKS:
        raise ValueError(f"trials.task is '{trials.task}': {nearest(trials.task, list(TASKS))}")
    if not trials.methods or len(set(trials.methods)) < len(trials.methods):
        raise ValueError(f"trials.method is {list(trials.methods)}: name at least one, and each once")
    pairs = {"cutoff": trials.cutoff}
    if trials.handle is not None:
        pairs |= {"handle.mass": trials.handle.mass, "handle.damping": trials.handle.damping}
        if not (trials.handle.own_mass >= 0 and math.isfinite(trials.handle.own_mass)):
            raise ValueError(f"trials.handle.own_mass is {trials.handle.own_mass}: it must be zero or more, in kg")
    for name, pair in pairs.items():
        if pair is not None and (len(pair) != 2 or not all(x > 0 and math.isfinite(x) for x in pair)):
            raise ValueError(f"trials.{name} is {pair}: it must be two numbers above zero")
    _check_window(trials.window, "trials")
    if trials.trigger is not None and trials.trigger.axis not in (1, 2):
        raise ValueError(f"trials.trigger.axis is {trials.trigger.axis}: it must be 1 or 2")


def _check_window(window: float, where: str) -> None:
    if not (window > 0 and math.isfinite(window)):
        raise ValueError(f"{where}.window is {window}: it must be a number above zero, in s")
    if window > 5:
        raise ValueError(f"{where}.window is {window:g} s: were milliseconds meant?")


def _matching(folder: Path, name: str) -> list[Path]:
    """The files that a name, a pattern or a folder stands for."""
    path = folder / name
    if path.is_dir():
        found = [file for file in path.iterdir() if file.suffix.lower() in FORMATS and not file.name.startswith(".")]
        if not found:
            raise ValueError(f"trials.files: the folder {path} has no file of a known kind: {', '.join(FORMATS)}")
    elif glob.has_magic(name) and not path.exists():
        found = [folder / match for match in glob.glob(name, root_dir=folder, recursive=True)]
        if not found:
            raise ValueError(f"trials.files: no file matches {path}: check the pattern and the folder")
    else:
        found = [path]
    return sorted(found, key=_by_number)


def _by_number(path: Path) -> list[tuple[int, str]]:
    """Trial 10 comes after trial 9."""
    return [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"(\d+)", str(path))]
