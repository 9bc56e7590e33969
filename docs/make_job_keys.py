"""Writes job-keys.md, the reference of all keys of a job file: run `make job-keys` after a setting has changed.

Names, kinds and defaults come from the fields of the settings' dataclasses, and what a key means from the text behind
its field. The keys of `[recording]` are the keywords of `load_recording`, whose docstring explains them.
"""

from __future__ import annotations

import ast
import inspect
import itertools
import math
import textwrap
import types
import typing
from collections.abc import Iterator, Mapping
from dataclasses import MISSING, Field, dataclass, fields, is_dataclass
from pathlib import Path
from typing import Any

from jaximp.design.limits import Limits
from jaximp.identification.filter_settings import FilterSettings
from jaximp.identification.pipeline import TrackSettings, WindowSettings
from jaximp.jobs.arm import OF_HAND, OF_JOINTS, ArmSettings, InertiaSettings
from jaximp.jobs.chain import ChainSettings, TipSettings
from jaximp.jobs.design import ClearanceSettings, DesignSettings, EncoderSettings
from jaximp.jobs.job import HumanSettings, ModelSettings, ReflexSettings, RobotSettings, WindowJob
from jaximp.jobs.payload import PayloadSettings
from jaximp.jobs.trials import STATIC_WINDOW, HandleSettings, TrialsSettings, TriggerSettings
from jaximp.posterior.inference import PosteriorSettings
from jaximp.posterior.priors import LogNormal, Normal
from jaximp.recordings.load import load_recording
from jaximp.trust.limits import TrustLimits

PAGE = Path(__file__).with_name("job-keys.md")


@dataclass(frozen=True)
class Table:
    """One TOML table of a job file."""

    title: str
    settings: type
    text: str = ""
    """What the table is for; else the first sentence of the settings' docstring."""
    only: tuple[str, ...] = ()
    """The fields that are keys of this table; else all but `hidden`."""
    hidden: tuple[str, ...] = ()
    """Fields that no key sets."""
    window: float | None = None
    """The default of the key `window`, where it is not the dataclass's."""


RECORDING_JOB = (
    Table(
        "At the top of the file",
        WindowJob,
        "Keys that stand in no table, above the first one.",
        only=("held_out", "reference_period", "design"),
    ),
    Table(
        "[model]",
        ModelSettings,
        "What is identified: `human = true`, `robot = true`, both, or an arm. Each may also be a table, with the keys "
        "below.",
        only=("methods", "drive", "robot_drift"),
    ),
    Table("[model.human]", HumanSettings, "A human joint: inertia, damping, stiffness and offset torque."),
    Table("[model.human.reflex]", ReflexSettings, "The stretch reflex of a human joint."),
    Table("[model.robot]", RobotSettings, "A robot's joint: its inertia, gravity and friction."),
    Table(
        "[model.robot] with a URDF",
        ChainSettings,
        "A robot of all joints that its URDF moves. See [robots](robots.md).",
    ),
    Table(
        "[model.human] beside a URDF",
        TipSettings,
        "A human who holds the end of the robot, its `tip`: `[robot_recording]` is the robot alone. See "
        "[robots](robots.md#a-human-at-the-end-of-the-robot).",
    ),
    Table(
        "[model.arm]",
        ArmSettings,
        "An arm of two joints in a plane. It stands alone: without human and robot.",
        hidden=OF_HAND,
    ),
    Table(
        "[payload]",
        PayloadSettings,
        "A load at the end of a robot with a URDF: `[recording]` is with it, `[robot_recording]` without. See "
        "[payload](payload.md).",
    ),
    Table("[filter]", FilterSettings, "Filters of position and torque, all run forward and backward."),
    Table("[window]", WindowSettings),
    Table(
        "[track]",
        TrackSettings,
        "Parameters that are followed as they move, in place of windows. See [parameters that move](tracking.md).",
    ),
    Table("[trust]", TrustLimits),
    Table("[posterior]", PosteriorSettings, "Used by `jaximp posterior` alone.", hidden=("prior",)),
    Table(
        "[posterior.prior], a Gaussian", Normal, "One line for each parameter of which something is known beforehand."
    ),
    Table("[posterior.prior], a positive parameter", LogNormal, "Log-normal."),
)
TRIALS_JOB = (
    Table(
        "[trials]",
        TrialsSettings,
        "It stands in place of `[recording]`, `[filter]` and `[window]`. Besides the keys below it has those of "
        "`[recording]`: `position` and `torque` are those of the hand [m, N], `command` is the perturbing force [N].",
        hidden=("mapping", "geometry", "folder", "posture"),
    ),
    Table("[trials.handle]", HandleSettings, "The admittance of the handle that the hand holds."),
    Table("[trials.trigger]", TriggerSettings, "The place at which perturbations begin."),
    Table(
        "[trials.posture]",
        TrialsSettings,
        "Perturbed postures, from which the arm's inertia is estimated. Columns that it does not name are those of "
        "`[trials]`; `reference` [m] is the position that the handle was asked to follow.",
        only=("files", "file", "trial", "onset", "window"),
        window=STATIC_WINDOW,
    ),
    Table("[model.arm] beside [trials]", ArmSettings, "The arm whose hand was recorded.", hidden=OF_JOINTS),
    Table("[model.arm.inertia] and [model.arm.inertia_stderr]", InertiaSettings, "Base inertia of the arm."),
)
DESIGN_JOB = (
    Table("[design]", DesignSettings, "The motion that is wanted."),
    Table(
        "[limits]",
        Limits,
        "What the motion keeps at every instant: one number for all joints, or a list with one for each.",
    ),
    Table("[clearance]", ClearanceSettings, "What a robot with a URDF stays away from: its own links, and planes."),
    Table("[encoder]", EncoderSettings, "How the motion will be measured, if its quantisation is to be in the loop."),
)
KINDS = {
    float: "number",
    int: "whole number",
    bool: "true or false",
    str: "text",
    list[float]: "list of numbers",
    dict[str, float]: "table of numbers",
    list[int]: "list of whole numbers",
    list[str]: "list of text",
    list[list[str]]: "list of lists of text",
    dict[str, list[float]]: "table of lists of numbers",
    list[list[float]]: "list of lists of numbers",
    Mapping[str, Any]: "table",
    tuple[str, ...]: "list of names",
    tuple[int, ...]: "list of whole numbers",
    tuple[Any, Any]: "[lowest, highest], or { low = [...], high = [...] }",
    Any: "number, or a list",
}


def texts(kind: type) -> dict[str, str]:
    """What stands behind each field of a dataclass, as one line."""
    body = typing.cast(ast.ClassDef, ast.parse(textwrap.dedent(inspect.getsource(kind))).body[0]).body
    found = {}
    for here, after in itertools.pairwise(body):
        if isinstance(here, ast.AnnAssign) and isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant):
            found[ast.unparse(here.target)] = " ".join(str(after.value.value).split())
    return found


def kind_of(hint: Any) -> str:
    """A type in plain words; None is no value that a file could hold."""
    if isinstance(hint, types.UnionType):
        return " or ".join(dict.fromkeys(kind_of(part) for part in typing.get_args(hint) if part is not type(None)))
    return "table" if is_dataclass(hint) else KINDS[hint]


def default_of(setting: Field[Any]) -> str:
    """The default as TOML would write it."""
    if setting.default is MISSING and setting.default_factory is MISSING:
        return "required"
    value = setting.default if setting.default_factory is MISSING else setting.default_factory()
    if value is None or value == ():
        return ""
    if setting.name == "length" and value == math.inf:
        return '`"all"` for a robot from a URDF'
    if value == math.inf or value == (-math.inf, math.inf):
        return "no limit"
    if isinstance(value, bool):
        return f"`{str(value).lower()}`"
    return f'`"{value}"`' if isinstance(value, str) else f"`{list(value) if isinstance(value, tuple) else value}`"


def keys(table: Table) -> list[Field[Any]]:
    """The fields that are keys of a table."""
    every = [setting for setting in fields(table.settings) if setting.name not in table.hidden]
    return [setting for setting in every if not table.only or setting.name in table.only]


def section(table: Table) -> Iterator[str]:
    """Heading, purpose, and a row for each key."""
    hints, meaning = typing.get_type_hints(table.settings), texts(table.settings)
    yield f"### {table.title}\n"
    yield (table.text or inspect.getdoc(table.settings) or "").split("\n\n")[0] + "\n"
    yield "| key | kind | default | meaning |\n| --- | --- | --- | --- |"
    for key in keys(table):
        default = default_of(key) if key.name != "window" or table.window is None else f"`{table.window}`"
        yield f"| `{key.name}` | {kind_of(hints[key.name])} | {default} | {meaning.get(key.name, '')} |"
    yield ""


def recording() -> Iterator[str]:
    """The keys of `[recording]`: the arguments that the docstring of `load_recording` explains."""
    arguments = (inspect.getdoc(load_recording) or "").split("**Arguments:**")[1].split("**Returns:**")[0].strip()
    yield "### [recording], [robot_recording] and [robot_recording_after]\n"
    yield (
        "Where the measurements are: `file`, a path that begins at the job's folder, and the columns. "
        "`[robot_recording]` has the same keys, and is the recording of the robot alone, without a human or a load; "
        "its columns are those of `[recording]` unless it names both position and torque. "
        "`[robot_recording_after]` has them too, and is a second one, made after the recording with the human: it "
        "tells how far the robot changed. "
        "Of `[recording]` alone, `file` may be a list of files with the same columns (and `rows` a list of pairs), or "
        "there may be several `[[recording]]` tables: they are identified together, and no filter crosses from one "
        "into the next.\n"
    )
    yield arguments.replace("- `path`:", "- `file`:") + "\n"


def page() -> str:
    """The whole page."""
    parts = [
        "# All keys of a job file\n",
        "<!-- docs/make_job_keys.py writes this page from the code. To change it, change the settings there. -->\n",
        "A job is a [TOML](https://toml.io) file. A key that does not exist is refused, and the nearest known one is "
        "named. Units stand in brackets; of a prismatic joint they are metres and newtons.\n",
        "- [A job with a recording](#a-job-with-a-recording): `jaximp check`, `identify`, `posterior`, `batch`\n"
        "- [A job with trials](#a-job-with-trials): perturbed movements of an arm, for the first three of these\n"
        "- [A job of a design](#a-job-of-a-design): `jaximp design`\n",
        "## A job with a recording\n",
        *recording(),
        *(line for table in RECORDING_JOB for line in section(table)),
        "## A job with trials\n",
        "It also takes `[trust]` and `[posterior]` (without a prior) as above.\n",
        *(line for table in TRIALS_JOB for line in section(table)),
        "## A job of a design\n",
        "`[model]` is that of a job with a recording. `[parameters]` and `[scale]` give a number for each parameter, "
        "by its name: the parameters that limits of the torque need, and the sizes by which columns are compared; "
        '`scale = "unit"` at the head of the job compares them at unit norm. A robot with a URDF (`[model.robot]` with '
        "`urdf`) keeps the file's limits of position, velocity and torque, and has its parameters, where the job gives "
        "no others.\n",
        *(line for table in DESIGN_JOB for line in section(table)),
    ]
    return "\n".join(parts).rstrip() + "\n"


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
