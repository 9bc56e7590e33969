"""The job file of a design: for which model, within which limits, judged by what."""

from __future__ import annotations

import tomllib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from jaximp.design.excitation import OBJECTIVES, Design, design_excitation
from jaximp.design.limits import Limits
from jaximp.design.motions import Encoder
from jaximp.jobs.job import ModelSettings, model_settings
from jaximp.jobs.settings import check_keys, checked, read, settings
from jaximp.models.base import Joints, Model, combine
from jaximp.models.joint import RobotJoint
from jaximp.numerics.optimise import METHODS
from jaximp.types import Progress, nearest


@dataclass(frozen=True)
class DesignSettings:
    """What motion is wanted; see `excitation.design_excitation`."""

    harmonics: int = 5
    """Harmonics of the Fourier series: its highest frequency is harmonics / period."""
    period: float = 10.0
    """The motion repeats after this time [s]."""
    objective: str = "condition"
    """`condition`, `determinant`, `sigma_min`, or `stderr` of one parameter."""
    parameter: str | None = None
    """The parameter whose standard error is made small, with `objective = "stderr"`."""
    window: float | None = None
    """Design for the worst sliding window of this length [s], not for the whole period."""
    rest: bool = False
    """The motion begins and ends at rest."""
    mean: float | list[float] | None = None
    """Mean position [rad or m], for all joints or for each; free where it is not given."""
    sample_rate: float = 1000.0
    """Sample rate of the controller, and of the exported motion [Hz]."""
    identify: str | None = None
    """Where the model has both: `human` if the robot is known by then (methods 1 and 3), or `robot`; else both. The
    torque is that of both in any case, and so are the parameters."""
    joints: int = 1
    """How many joints of this model stand side by side."""
    starts: int = 32
    """How many random motions the optimiser starts from."""
    seed: int = 0
    """Seed of the random motions."""
    method: str = "bfgs"
    """The optimiser: `bfgs`, `conjugate_gradient`, `lbfgsb` or `projected_gradient`."""


@dataclass(frozen=True)
class EncoderSettings:
    """See `motions.Encoder`."""

    step: float
    """Quantisation step [rad or m]."""
    cutoff: float
    """Low-pass of the position before it is differentiated [Hz]."""
    order: int = 8
    """Order of that low-pass."""


@dataclass(frozen=True)
class DesignJob:
    """Everything that `jaximp design` needs to know."""

    model: ModelSettings
    design: DesignSettings
    limits: Limits
    parameters: Mapping[str, float] | None = None
    """The model's parameters, by name, where the torque is limited or wanted."""
    scale: Mapping[str, float] | None = None
    """The size of each parameter, by name: columns are compared by the torque that they make."""
    encoder: EncoderSettings | None = None
    text: str = ""

    def run(self, progress: Progress = lambda share: None) -> Design:
        """Design the motion."""
        wanted = dict(vars(self.design))
        joints, identify = wanted.pop("joints"), wanted.pop("identify")
        moved = self._made(("robot", "human"), joints)
        model = moved if identify is None else self._made((identify,), joints)
        return design_excitation(
            model,
            moved=moved,
            limits=self.limits,
            parameters=_by_name(self.parameters, moved, "parameters"),
            scale=_by_name(self.scale, model, "scale"),
            encoder=None
            if self.encoder is None
            else Encoder(sample_rate=self.design.sample_rate, **vars(self.encoder)),
            progress=progress,
            **wanted,
        )

    def _made(self, whom: tuple[str, ...], joints: int) -> Model:
        """Robot, human, or both with the columns that they share merged; joints side by side."""
        robot, human = self.model.robot, self.model.human
        if self.model.arm is not None:
            return self.model.arm.make()
        made: list[Model] = [] if robot is None or "robot" not in whom else [RobotJoint(**vars(robot))]
        made += [] if human is None or "human" not in whom else [human.make(self.design.sample_rate)]
        one = made[0] if len(made) == 1 else combine(*made)
        return one if joints == 1 else Joints(*[one] * joints)


def _by_name(values: Mapping[str, float] | None, model: Model, where: str) -> list[float] | None:
    if values is None:
        return None
    check_keys(values, list(model.names), f"[{where}]")
    missing = [name for name in model.names if name not in values]
    if missing:
        raise ValueError(f"[{where}] has no '{missing[0]}': give all of {', '.join(model.names)}")
    return [checked(values[name], float, f"{where}.{name}") for name in model.names]


def read_design_job(path: str | Path) -> DesignJob:
    """Read and check the job file of a design.

    **Raises:** `ValueError` with one line that names the key and the remedy.
    """
    return read(path, lambda text, _: parse_design_job(text))


def parse_design_job(text: str) -> DesignJob:
    """The job of a design from TOML text."""
    tables = tomllib.loads(text)
    check_keys(tables, ["model", "design", "limits", "parameters", "scale", "encoder"], "the job")
    if "model" not in tables:
        raise ValueError("the job has no [model] table: add one")
    for name in ("parameters", "scale"):
        if not isinstance(tables.get(name, {}), dict):
            raise ValueError(f"[{name}] must be a table: a number for every parameter")
    model = model_settings(tables["model"])
    if model == ModelSettings():
        raise ValueError("[model] is empty: write human = true, or robot = true, or both, or an arm")
    design = settings(DesignSettings, tables.get("design", {}), "design")
    for name, choices in (("objective", OBJECTIVES), ("method", METHODS)):
        if getattr(design, name) not in choices:
            raise ValueError(
                f"design.{name} is '{getattr(design, name)}': {nearest(getattr(design, name), list(choices))}"
            )
    both = model.robot is not None and model.human is not None
    if design.identify is not None and not (both and design.identify in ("robot", "human")):
        raise ValueError(
            f"design.identify is '{design.identify}': it must be 'human' or 'robot', and the model must have both"
        )
    if model.arm is not None and design.joints != 1:
        raise ValueError("design.joints counts models of one joint side by side: leave it out, an arm has two joints")
    if design.joints < 1:
        raise ValueError(f"design.joints is {design.joints}: there must be at least one")
    encoder = tables.get("encoder")
    return DesignJob(
        model,
        design,
        _limits(tables.get("limits", {})),
        tables.get("parameters"),
        tables.get("scale"),
        None if encoder is None else settings(EncoderSettings, encoder, "encoder"),
        text,
    )


def _limits(table: Any) -> Limits:
    """Numbers, or lists with one for each joint; the position's are a pair."""
    if not isinstance(table, dict):
        raise ValueError("[limits] must be a table")
    check_keys(table, [setting.name for setting in fields(Limits)], "[limits]")

    def number(value: Any, where: str) -> Any:
        if isinstance(value, list):
            return tuple(number(item, where) for item in value)
        return checked(value, float, where)

    given = {name: number(value, f"limits.{name}") for name, value in table.items() if name != "position"}
    if "position" in table:
        given["position"] = _range(table["position"], number)
    return Limits(**given)


def _range(value: Any, number: Callable[[Any, str], Any]) -> tuple[Any, Any]:
    """`[lowest, highest]` of all joints, or `{ low = [...], high = [...] }` with a number for each."""
    if isinstance(value, dict):
        check_keys(value, ["low", "high"], "limits.position")
        if len(value) == 2:
            return number(value["low"], "limits.position.low"), number(value["high"], "limits.position.high")
    elif isinstance(value, list) and len(value) == 2 and not any(isinstance(item, list) for item in value):
        return number(value[0], "limits.position"), number(value[1], "limits.position")
    raise ValueError(
        f"limits.position is {value}: write [lowest, highest], or for joints that differ "
        "{ low = [joint 1, joint 2], high = [joint 1, joint 2] }"
    )
