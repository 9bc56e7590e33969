"""A load at the end of a robot in a job: the table `[payload]`.

```toml
[payload]
method = 4                 # the load, from [robot_recording] without and [recording] with it; or [4, 1, 2]

[payload]
mass = 2.805               # kg: the load is known, and tells the gains of the drives
```
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from jaximp.consistency.bodies import RealBody, nearest_body
from jaximp.identification.drive_gains import DriveGains, identify_gains
from jaximp.identification.payload import LOAD_METHODS, Payload, identify_payload
from jaximp.identification.pipeline import Pipeline
from jaximp.jobs.settings import settings
from jaximp.types import Recording


@dataclass(frozen=True)
class Weighed:
    """A load by one method or several."""

    loads: tuple[Payload, ...]
    """The first is the answer."""
    body: RealBody | None
    """The real body that is nearest to it."""
    remark: str = ""
    """Why there is none, if so."""

    @classmethod
    def of(cls, loads: Sequence[Payload]) -> Weighed:
        """With the nearest body, where that can be found."""
        try:
            return cls(tuple(loads), nearest_body(loads[0].theta, loads[0].covariance))
        except ValueError as error:
            return cls(tuple(loads), None, f"whether a real body has these parameters is not known: {error}")

    def of_body(self) -> list[str]:
        """Whether a real body can have the parameters, in words."""
        return [self.remark] if self.body is None else self.body.in_words()

    def in_words(self) -> list[str]:
        """The answer, whether a real body can have it, and the mass by further methods."""
        others = [f"by method {load.method}: {load.in_words()[0]}" for load in self.loads[1:]]
        return [*self.loads[0].in_words(), *self.of_body(), *others]


@dataclass(frozen=True)
class PayloadSettings:
    """Keywords of `identify_payload`, or with a `mass` those of `identify_gains`."""

    method: int | list[int] = 4
    """1: the robot first, then the load from what is left. 2: the difference of two robots. 3: the difference of the
    torques on one motion. 4: all together. Of several, such as `[4, 1, 2]`, the first is the answer, and the others
    stand beside it."""
    mass: float | None = None
    """Of a load that is known [kg]: then the gains of the drives are identified, not the load."""
    mass_error: float = 0.0
    """Standard error of the mass [kg]."""
    centre: list[float] | None = None
    """Centre of mass of the known load in the frame of the robot's tip [m], where it is known."""
    centre_error: float = 0.0
    """Standard error of its coordinates [m]."""
    same_friction: bool = False
    """Whether friction is the same with the known load. By default the recordings have each their own."""

    @property
    def methods(self) -> list[int]:
        """The first is that of the answer."""
        return self.method if isinstance(self.method, list) else [self.method]

    def found(self, pipeline: Pipeline, alone: list[Recording], loaded: list[Recording]) -> Weighed | DriveGains:
        """The load, or the gains by a load that is known.

        **Raises:** `ValueError` as `identify_payload` and `identify_gains`.
        """
        if self.mass is None:
            return Weighed.of([identify_payload(pipeline, alone, loaded, method) for method in self.methods])
        known = (self.mass, self.mass_error, self.centre, self.centre_error, self.same_friction)
        return identify_gains(pipeline, alone, loaded, *known)


def payload_settings(table: Any) -> PayloadSettings:
    """`[payload]`, with every key and value checked."""
    given = settings(PayloadSettings, table, "payload")
    if not given.methods or not set(given.methods) <= set(LOAD_METHODS):
        raise ValueError(f"payload.method is {given.method}: choose 1, 2, 3 or 4, or list some of them")
    if len(set(given.methods)) < len(given.methods):
        raise ValueError(f"payload.method is {given.method}: list each method once")
    if given.mass is None:
        for key in ("mass_error", "centre", "centre_error", "same_friction"):
            if key in table:
                raise ValueError(f"payload.{key} is of use only with a payload.mass that is known: leave it out")
    elif "method" in table:
        raise ValueError("payload.method is of no use with a payload.mass that is known: leave one of them out")
    return given
