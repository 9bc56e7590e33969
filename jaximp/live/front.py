"""From one sample to a row of least squares: what `identification.rows` does, for samples that arrive one by one.

The position is smoothed and differentiated without phase, which costs a constant delay; torque and columns then pass
the same causal filter. A gap that is short against the filters is bridged; whatever else a missing sample reaches does
not count.
"""

from __future__ import annotations

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaximp.identification.pipeline import Pipeline
from jaximp.models.base import Model
from jaximp.signals.streaming import (
    Causal,
    Derivatives,
    Passed,
    begin_causal,
    design_causal,
    design_derivatives,
    pass_causal,
)
from jaximp.types import AnyArray


class Front(eqx.Module):
    """What is done with every sample, for one sample rate."""

    model: Model
    """What is identified."""
    robot: Model | None
    """What holds it, whose torque is known and taken off; None without."""
    robot_theta: AnyArray
    """Its parameters."""
    derivatives: Derivatives
    causal: Causal
    decimate: int = eqx.field(static=True)
    """Every n-th sample makes a row."""
    bridge: int = eqx.field(static=True)
    """Samples that may be missing in a row for a straight line to serve."""
    min_velocity: float = eqx.field(static=True)
    """Rows of slower samples do not count [rad/s or m/s]."""

    @property
    def late(self) -> int:
        """Samples by which the motion of a row is behind the newest sample."""
        return self.derivatives.late + self.bridge

    @property
    def columns(self) -> int:
        """Of a row, the torque being the last one."""
        return len(self.model.names) + 1


class Sample(NamedTuple):
    """What was measured at one instant, or at N of them."""

    position: Float[AnyArray, "*N"]
    """[rad or m]"""
    torque: Float[AnyArray, "*N"]
    """[N m or N]"""
    valid: Bool[AnyArray, "*N"]
    """False for one that is missing; its numbers mean nothing then."""


class Held(NamedTuple):
    """What is kept of the samples before."""

    position: Float[Array, " T"]
    """The latest stands last."""
    torque: Float[Array, " T"]
    known: Bool[Array, " T"]
    missing: Int[Array, ""]
    """Samples since the last that was known."""
    passed: Passed
    clean: Int[Array, ""]
    """Samples in a row whose motion comes from measurements."""
    fast: Bool[Array, " D"]
    """Which of them were fast enough; the latest stands last."""
    number: Int[Array, ""]
    """How many samples there were."""


class Row(NamedTuple):
    """What a sample makes of all that came before."""

    values: Float[Array, " f"]
    """Columns and torque [N m], filtered."""
    due: Array
    """Whether this sample makes a row."""
    valid: Array
    """Whether that row counts."""
    measured: Array
    """Whether its motion and torque come from measurements, fast enough or not."""


def front_of(pipeline: Pipeline, robot_theta: AnyArray | None = None) -> Front:
    """The filters of a pipeline.

    **Raises:** `ValueError` in one line for what cannot be identified live.
    """
    model, filters = pipeline.model, pipeline.filters
    if model.n_joints != 1 or model.regroups or model.memory:
        raise ValueError(
            "monitor identifies one joint without a reflex so far: give [model] a human or a robot of one joint, or "
            "run identify"
        )
    if pipeline.filter.measured_derivatives:
        raise ValueError("filter.measured_derivatives does not work live: leave it out")
    if not pipeline.once:
        raise ValueError("filter.mode = 'window' does not work live: leave it out")
    derivatives = design_derivatives(filters.position, filters.differentiator, pipeline.sample_rate)
    none = np.zeros(0)
    return Front(
        model=model,
        robot=pipeline.robot,
        robot_theta=none if robot_theta is None else np.asarray(robot_theta, float),
        derivatives=derivatives,
        causal=design_causal(filters.parallel),
        decimate=filters.decimate,
        bridge=filters.bridge,
        min_velocity=float(pipeline.min_velocity),
    )


def nothing_held(front: Front) -> Held:
    """Before the first sample."""
    length, zero = front.derivatives.samples + front.bridge, jnp.zeros((), int)
    return Held(
        position=jnp.zeros(length),
        torque=jnp.zeros(length),
        known=jnp.zeros(length, bool),
        missing=zero,
        passed=begin_causal(front.causal, jnp.zeros(front.columns)),
        clean=zero,
        fast=jnp.zeros(round(front.causal.late) + 1, bool),
        number=zero,
    )


def take_sample(front: Front, held: Held, sample: Sample) -> tuple[Held, Row]:
    """One sample further."""
    valid = jnp.asarray(sample.valid) & jnp.isfinite(sample.position) & jnp.isfinite(sample.torque)
    position, torque, known = _with_sample(front, held, sample, valid)
    length, late = front.derivatives.samples, front.derivatives.late
    q, dq, ddq = front.derivatives(position[:length])
    of_model = front.model.regressor(q, dq, ddq)
    of_joint = torque[late]
    if front.robot is not None:
        of_joint = of_joint - front.robot.regressor(q, dq, ddq) @ front.robot_theta
    z = jnp.append(of_model, of_joint)
    measured = known[:length].all()
    # At rest where measurements begin, and on hold where there are none: of torque and columns alike.
    begun, follows = begin_causal(front.causal, z), held.clean > 0
    before = Passed(*(jnp.where(follows, a, b) for a, b in zip(held.passed, begun, strict=True)))
    passed, filtered = pass_causal(front.causal, before, z)
    clean = jnp.where(measured, held.clean + 1, 0)
    fast = jnp.append(held.fast[1:], front.model.speed(dq[None])[0] >= front.min_velocity)
    settled = clean >= front.causal.settles
    due = held.number % front.decimate == 0
    row = Row(filtered, due, due & settled & fast[0], due & settled)
    missing = jnp.where(valid, 0, held.missing + 1)
    return Held(position, torque, known, missing, passed, clean, fast, held.number + 1), row


def _with_sample(front: Front, held: Held, sample: Sample, valid: Array) -> tuple[Array, Array, Array]:
    """Position, torque and what is known of them, with the newest sample; a short gap that it ends is bridged."""
    known = jnp.append(held.known[1:], valid)
    index = jnp.arange(len(known))
    gap = held.missing
    # Before the first sample that is known there is nothing to bridge from.
    bridged = valid & (gap > 0) & (gap <= front.bridge) & held.known[-1 - jnp.minimum(gap, len(known) - 1)]
    inside = bridged & (index >= len(known) - 1 - gap) & (index < len(known) - 1)
    share = (len(known) - 1 - index) / (gap + 1)

    def joined(before: Array, now: AnyArray) -> Array:
        value = jnp.where(valid, now, before[-1])
        return jnp.where(inside, value + share * (before[-1] - value), jnp.append(before[1:], value))

    return joined(held.position, sample.position), joined(held.torque, sample.torque), known | inside
