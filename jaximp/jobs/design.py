"""The job file of a design: for which model, within which limits, judged by what."""

from __future__ import annotations

import tomllib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from jaximp.design.clearance import RADIUS, Clearance, Plane
from jaximp.design.columns import Load, Selected
from jaximp.design.excitation import OBJECTIVES, Design, design_excitation
from jaximp.design.limits import Limits
from jaximp.design.motions import Encoder
from jaximp.jobs.job import ModelSettings, model_settings
from jaximp.jobs.settings import check_keys, checked, read, settings
from jaximp.models.base import Joints, Model, combine
from jaximp.models.chain import Chain
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
    identify: str | list[str] | None = None
    """Where the model has both: `human` if the robot is known by then (methods 1 and 3), or `robot`; else both. The
    torque is that of both in any case, and so are the parameters. Of a robot with a URDF: `load` for the ten parameters
    of a load at its tip, or a list of those parameters that are not known."""
    joints: int = 1
    """How many joints of this model stand side by side."""
    starts: int | None = None
    """How many random motions the optimiser starts from; by default 32, and 16 by the method `python`."""
    seed: int = 0
    """Seed of the random motions."""
    method: str | None = None
    """The optimiser: `bfgs`, `conjugate_gradient`, `lbfgsb`, `projected_gradient` or `python`; by default `python` for
    many parameters and where a clearance is kept, else `bfgs`."""


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
class ClearanceSettings:
    """What a robot with a URDF stays away from: itself, and planes. See `clearance.Clearance`."""

    distance: float = 0.02
    """Between all surfaces [m]."""
    radius: float = RADIUS
    """Of links whose shape is a mesh or not in the URDF: they are taken for bars from joint to joint [m]."""
    radii: dict[str, float] | None = None
    """The same for some links by name, whatever their shape in the URDF [m]."""
    ignore: list[list[str]] | None = None
    """Pairs of links that may touch, such as `[["forearm", "base"]]`."""
    table: float | None = None
    """All that moves stays above this height in the base's frame [m]."""
    walls: dict[str, list[float]] | None = None
    """More planes by name: `x, y, z, offset` in the base's frame [m], where the free side is where
    `x px + y py + z pz >= offset`."""

    def make(self, chain: Chain, urdf: Path, mean: Any) -> Clearance:
        """For the robot of a job."""
        planes = [] if self.table is None else [Plane(offset=self.table)]
        for name, numbers in (self.walls or {}).items():
            if len(numbers) != 4:
                raise ValueError(f"clearance.walls.{name} is {numbers}: write four numbers, [x, y, z, offset]")
            planes.append(Plane((numbers[0], numbers[1], numbers[2]), numbers[3], name))
        if any(len(pair) != 2 for pair in self.ignore or []):
            raise ValueError('clearance.ignore lists pairs of links, such as [["forearm", "base"]]')
        return Clearance.of(
            chain, urdf, distance=self.distance, radius=self.radius, radii=self.radii, planes=planes,
            ignore=[(one, other) for one, other in self.ignore or []], mean=mean,
        )  # fmt: skip


@dataclass(frozen=True)
class DesignJob:
    """Everything that `jaximp design` needs to know."""

    model: ModelSettings
    design: DesignSettings
    limits: Limits
    parameters: Mapping[str, float] | None = None
    """The model's parameters, by name, where the torque is limited or wanted."""
    scale: Mapping[str, float] | str | None = None
    """The size of each parameter, by name: columns are compared by the torque that they make. Or `unit`: they are
    compared at unit norm."""
    encoder: EncoderSettings | None = None
    clearance: ClearanceSettings | None = None
    text: str = ""
    folder: Path = Path()
    """Where the paths of the job begin."""

    def run(self, progress: Progress = lambda share: None) -> Design:
        """Design the motion."""
        wanted = dict(vars(self.design))
        model, moved = self._models(wanted.pop("joints"), wanted.pop("identify"))
        return design_excitation(
            model,
            moved=moved,
            limits=self.limits,
            parameters=_by_name(self.parameters, moved, "parameters"),
            scale=self.scale if isinstance(self.scale, str) else _by_name(self.scale, model, "scale"),
            encoder=None
            if self.encoder is None
            else Encoder(sample_rate=self.design.sample_rate, **vars(self.encoder)),
            clearance=self._clearance(moved),
            progress=progress,
            **wanted,
        )

    def _models(self, joints: int, identify: str | list[str] | None) -> tuple[Model, Model]:
        """What is identified, and everything that is moved."""
        if self.model.chain is not None:
            chain = self.model.chain.make(self.folder)
            if isinstance(identify, list):
                return Selected(chain, identify), chain
            return (chain if identify is None else Load(chain)), chain
        assert not isinstance(identify, list)
        moved = self._made(("robot", "human"), joints)
        return (moved if identify is None else self._made((identify,), joints)), moved

    def _clearance(self, moved: Model) -> Clearance | None:
        if self.clearance is None:
            return None
        assert self.model.chain is not None
        assert isinstance(moved, Chain)
        return self.clearance.make(moved, self.folder / self.model.chain.urdf, self.design.mean)

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
    return read(path, parse_design_job)


def parse_design_job(text: str, folder: Path = Path()) -> DesignJob:
    """The job of a design from TOML text; the paths in it begin at the folder."""
    tables = tomllib.loads(text)
    check_keys(tables, ["model", "design", "limits", "parameters", "scale", "encoder", "clearance"], "the job")
    if "model" not in tables:
        raise ValueError("the job has no [model] table: add one")
    for name in ("parameters", "scale"):
        if not isinstance(tables.get(name, {}), dict) and (name, tables[name]) != ("scale", "unit"):
            raise ValueError(f"[{name}] must be a table: a number for every parameter")
    model = model_settings(tables["model"])
    if model == ModelSettings():
        raise ValueError("[model] is empty: write human = true, or robot = true, or both, or an arm, or a robot's urdf")
    if model.tip is not None:
        raise ValueError("a motion is designed for a robot from a URDF that nobody holds: leave out [model.human]")
    design = settings(DesignSettings, tables.get("design", {}), "design")
    for name, choices in (("objective", OBJECTIVES), ("method", METHODS)):
        chosen = getattr(design, name)
        if chosen is not None and chosen not in choices:
            raise ValueError(f"design.{name} is '{chosen}': {nearest(chosen, list(choices))}")
    _check_identify(model, design.identify)
    if (model.arm is not None or model.chain is not None) and design.joints != 1:
        has = "an arm has two joints" if model.chain is None else "the URDF says what joints there are"
        raise ValueError(f"design.joints counts models of one joint side by side: leave it out, {has}")
    if design.joints < 1:
        raise ValueError(f"design.joints is {design.joints}: there must be at least one")
    encoder, clearance = tables.get("encoder"), tables.get("clearance")
    if clearance is not None and model.chain is None:
        raise ValueError("[clearance] is that of a robot's links: it needs [model.robot] with a urdf")
    return DesignJob(
        model,
        design,
        _limits(tables.get("limits", {})),
        tables.get("parameters"),
        tables.get("scale"),
        None if encoder is None else settings(EncoderSettings, encoder, "encoder"),
        None if clearance is None else settings(ClearanceSettings, clearance, "clearance"),
        text,
        folder,
    )


def _check_identify(model: ModelSettings, identify: str | list[str] | None) -> None:
    if identify is None:
        return
    if model.chain is not None:
        if isinstance(identify, str) and identify != "load":
            raise ValueError(
                f"design.identify is '{identify}': of a robot with a URDF write 'load', or a list of parameters"
            )
    elif not (model.robot is not None and model.human is not None and identify in ("robot", "human")):
        raise ValueError(
            f"design.identify is '{identify}': it must be 'human' or 'robot', and the model must have both"
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
