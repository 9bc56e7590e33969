"""Exciting motions: what is reached in which time, and by which optimiser.

Every measurement is a process of its own: a first design (compilation in) and a second one with another seed. Writes
results/excitation.json and .md. The optimiser `projected_gradient` is given up after TIMEOUT seconds.
"""

from __future__ import annotations

import json
import math
import os
import platform
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

RESULTS = Path(__file__).parents[1] / "results"
TIMEOUT = 120
HANDLE = (-10.5, 10.5)  # rad at the motor: 0.7 rad at the handle
WINDOW = 2.0  # s
PROBLEMS = ("human", "robot", "worst window", "whole period", "worst window, mean 0", "worst window, order 5, mean 0")


def design(problem: str, method: str, seed: int) -> Any:
    import jaximp
    from jaximp.models import HumanJoint, RobotJoint

    human, limits = HumanJoint(offset=False), jaximp.Limits(position=(-0.5, 0.5))
    model, settings = {
        "human": (human, {"limits": limits}),
        "robot": (RobotJoint(gear_ratio=15), {"limits": jaximp.Limits(position=HANDLE)}),
        "worst window": (human, {"limits": limits, "harmonics": 7, "window": WINDOW}),
        "whole period": (human, {"limits": limits, "harmonics": 7}),
        "worst window, mean 0": (human, {"limits": limits, "harmonics": 7, "window": WINDOW, "mean": 0.0}),
        "worst window, order 5, mean 0": (human, {"limits": limits, "window": WINDOW, "mean": 0.0}),
    }[problem]
    return jaximp.design_excitation(model, method=method, seed=seed, **settings)


def measured(problem: str, method: str) -> dict[str, Any]:
    import jax

    jax.config.update("jax_enable_x64", True)
    found: dict[str, Any] = {}
    for name, seed in (("first", 0), ("second", 1)):
        begin = time.perf_counter()
        one = design(problem, method, seed)
        found[f"{name}_s"] = time.perf_counter() - begin
    conditions = [float(x) for x in one.conditions]
    return found | {
        "best": conditions[0],
        "median": conditions[len(conditions) // 2],
        "near_floor": sum(x < 1.001 * math.sqrt(3) for x in conditions),
        "starts": len(conditions),
        "period": one.condition,
        "worst_window": float(one.sliding_condition(WINDOW)[1].max()),
    }


def measure(problem: str, method: str) -> dict[str, Any] | None:
    command = [sys.executable, __file__, problem, method]
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=TIMEOUT)
    except subprocess.TimeoutExpired:
        print(f"{problem}, {method}: given up after {TIMEOUT} s", flush=True)
        return None
    found = json.loads(done.stdout.splitlines()[-1])
    print(f"{problem}, {method}: {found}", flush=True)
    return found


def table(found: dict[str, dict[str, Any]]) -> list[str]:
    best = {problem: found[problem]["bfgs"] for problem in PROBLEMS}
    rows = [
        (
            "human joint, order 5, 10 s, 32 starts",
            "within 0.1 % of the root of 3 from 28, in 2 s",
            f"from {best['human']['near_floor']}, in {best['human']['second_s']:.1f} s",
        ),
        (
            "robot joint of Tout et al. 2023, 0.7 rad",
            "11.5, in 5 s",
            f"{best['robot']['best']:.1f}, in {best['robot']['second_s']:.1f} s",
        ),
        (
            f"worst window of 2 s, human joint, order 7 (designed for the whole period: "
            f"{best['whole period']['worst_window']:.1f})",
            "3.8",
            f"{best['worst window']['best']:.2f}, in {best['worst window']['second_s']:.1f} s",
        ),
        (
            "the same, mean position 0; order 5",
            "",
            " and ".join(
                f"{best[name]['best']:.2f}" for name in ("worst window, mean 0", "worst window, order 5, mean 0")
            ),
        ),
    ]
    lines = ["| what | target | reached |", "| --- | --- | --- |", *(f"| {' | '.join(row)} |" for row in rows), ""]
    lines += ["| optimiser | " + " | ".join(PROBLEMS[:3]) + " |", "| --- | --- | --- | --- |"]
    for method in found["human"]:
        cells = []
        for problem in PROBLEMS[:3]:
            one = found[problem].get(method)
            if one is None:
                cells.append(f"given up after {TIMEOUT} s")
                continue
            times = f"{one['second_s']:.1f} s after {one['first_s']:.1f} s"
            cells.append(f"{one['best']:.4g} (median {one['median']:.4g}), {times}")
        lines.append(f"| {method} | {' | '.join(cells)} |")
    return lines


def machine() -> str:
    model = next((line for line in Path("/proc/cpuinfo").read_text().splitlines() if line.startswith("model name")), "")
    return f"{os.cpu_count()} cores, {model.split(':')[-1].strip() or platform.processor()}"


if __name__ == "__main__":
    if len(sys.argv) > 1:
        print(json.dumps(measured(*sys.argv[1:3])))
        sys.exit(0)
    from jaximp.numerics.optimise import METHODS

    found = {
        problem: {method: measure(problem, method) for method in METHODS if problem in PROBLEMS[:3] or method == "bfgs"}
        for problem in PROBLEMS
    }
    text = "\n".join([machine() + "\n", *table(found)])
    (RESULTS / "excitation.json").write_text(json.dumps({"machine": machine()} | found, indent=1) + "\n")
    (RESULTS / "excitation.md").write_text(text + "\n")
    print(text)
