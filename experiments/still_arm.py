"""How many windows are trusted where the arm stands still, moves at one frequency, or moves well: the trust table.

6 s at 1 kHz, true inertia 0.1, damping 1.5, stiffness 20; three frequencies with a still stretch from 2 to 4 s in which
the encoder shows noise (1e-5 rad) or exactly zero; or one frequency throughout. Torque noise 0.2 N m, windows of 0.5 s,
filters of 2nd order at 20 Hz. Twenty noise seeds. Writes experiments/results/still_arm.json.
"""

from __future__ import annotations

import json
from pathlib import Path

import jax
import numpy as np
from numpy.typing import NDArray

from jaximp import Recording, identify_recording, parse_job, recording_from_arrays

jax.config.update("jax_enable_x64", True)

TIME = np.arange(6000) * 1e-3
MULTISINE = ((0.2, 1.1, 0.0), (0.1, 2.9, 0.5), (0.04, 6.3, 1.0))
SEEDS = 20
JOB = parse_job(
    """
    recording = {}
    [model]
    human = { offset = false }
    [filter]
    position_cutoff = 20
    position_order = 2
    decimation_cutoff = 20
    decimation_order = 2
    [window]
    length = 0.5
    step = 0.01
    """
)


def arm(lines: tuple[tuple[float, float, float], ...], moving: NDArray[np.bool_], noise: float, seed: int) -> Recording:
    """A joint that moves at some frequencies while `moving`."""
    q, dq, ddq = (
        moving
        * sum(a * (2 * np.pi * f) ** k * np.sin(2 * np.pi * f * TIME + phase + k * np.pi / 2) for a, f, phase in lines)
        for k in range(3)
    )
    generator = np.random.default_rng(seed)
    torque = 0.1 * ddq + 1.5 * dq + 20 * q + generator.normal(0, 0.2, len(TIME))
    return recording_from_arrays(TIME, q + noise * generator.normal(size=len(TIME)), torque)


def shares(lines: tuple[tuple[float, float, float], ...], still: bool, noise: float) -> dict[str, float]:
    """Share of trusted windows among those wholly still and wholly in motion, over all seeds."""
    moving = ~((TIME >= 2) & (TIME < 4)) if still else np.ones(len(TIME), bool)
    counts = {"still": [0, 0], "moving": [0, 0]}
    for seed in range(SEEDS):
        estimates = identify_recording(JOB, arm(lines, moving, noise, seed))[0]
        begins, ends, trusted = estimates.start, estimates.end, estimates.verdicts.trusted
        at_rest = still & (begins >= 2 - 1e-9) & (ends < 4 - 1e-9)
        in_motion = (ends < 2 - 1e-9) | (begins >= 4 - 1e-9) if still else np.ones(len(ends), bool)
        for name, these in (("still", at_rest), ("moving", in_motion)):
            counts[name][0] += int(trusted[these].sum())
            counts[name][1] += int(these.sum())
    return {name: trusted / total for name, (trusted, total) in counts.items() if total}


if __name__ == "__main__":
    results = {
        "still with encoder noise": shares(MULTISINE, True, 1e-5),
        "still at exactly zero": shares(MULTISINE, True, 0.0),
        "one frequency throughout": shares(((0.2, 1.1, 0.0),), False, 1e-5),
    }
    text = json.dumps(results, indent=1)
    (Path(__file__).parent / "results" / "still_arm.json").write_text(text + "\n")
    print(text)
