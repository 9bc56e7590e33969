"""How long the simulated experiments of Börner et al. 2020 take, once compiled: tables 1 A to D and 2.

Every configuration is run twice, once to compile with half of its simulations and once to measure. Beside it, what one
trial costs in numpy: the same arm, stepped one by one. Writes results/arm_tables.json and .md.
"""

from __future__ import annotations

import json
import os
import platform
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np

jax.config.update("jax_enable_x64", True)

from jaximp.papers.arm_experiments import Case, run_case  # noqa: E402
from jaximp.papers.borner2020 import AT_ONCE, Sizes, run  # noqa: E402
from jaximp.simulation.neuromuscular import RATE, NeuromuscularArm  # noqa: E402

COMPARED = ("feedback_jerk", "gomi_kawato")
RESULTS = Path(__file__).parents[1] / "results"
ALTERNATIVES = [Case(duration=1.0), Case(duration=3.0), Case(cutoff=1.0), Case(cutoff=3.0), Case(amplitude=5.0)]
ALTERNATIVES.append(Case(amplitude=20.0))


def seconds(work: Callable[..., Any], *arguments: Any) -> float:
    begin = time.perf_counter()
    work(*arguments)
    return time.perf_counter() - begin


def main() -> None:
    found: dict[str, Any] = {"machine": f"{os.cpu_count()} cores, {platform.machine()}"}
    jobs = [(Case(), (*COMPARED, "erden_billard"), True), *((case, COMPARED, False) for case in ALTERNATIVES)]
    found["first_run_s"] = sum(seconds(run, case, m, AT_ONCE, static) for case, m, static in jobs)
    parts = [seconds(run, case, m, Sizes().simulations, static) for case, m, static in jobs]
    found["tables_1A_and_2_s"], found["tables_1B_to_1D_s"] = parts[0], sum(parts[1:])
    found["all_s"] = sum(parts)

    arm, keys = NeuromuscularArm(), jax.random.split(jax.random.key(1), AT_ONCE)
    simulate = lambda: [jax.block_until_ready(x) for x in run_case(arm, Case(), keys, static=False)]  # noqa: E731
    simulate()
    found["steps_of_a_trial_per_second"] = AT_ONCE * 120 * 2 * RATE / seconds(simulate)
    found["one_trial_in_numpy_s"] = seconds(one_trial_in_numpy)
    found["numpy_over_ours"] = found["steps_of_a_trial_per_second"] * found["one_trial_in_numpy_s"] / (2 * RATE)
    (RESULTS / "arm_tables.json").write_text(json.dumps(found, indent=1) + "\n")
    rows = "\n".join(
        f"| {name.replace('_', ' ')} | {value:.4g} |" for name, value in found.items() if name != "machine"
    )
    text = f"{found['machine']}\n\n| what | |\n| --- | --- |\n{rows}\n"
    (RESULTS / "arm_tables.md").write_text(text)
    print(text)


def one_trial_in_numpy() -> None:
    """The plainest way: small arrays, one step at a time, Heun's method."""
    arm = NeuromuscularArm()
    A, K0, K1 = np.asarray(arm.moment_arms), np.asarray(arm.intrinsic_stiffness), 75.0
    (l1, l2), (p1, p2, p3) = np.asarray(arm.lengths), np.asarray(arm.inertia)
    activation, noise = np.full(6, 5.0), np.zeros(6)

    def acceleration(q: np.ndarray, dq: np.ndarray) -> np.ndarray:
        s1, c1, s12, c12 = np.sin(q[0]), np.cos(q[0]), np.sin(q.sum()), np.cos(q.sum())
        J = np.array([[-l1 * s1 - l2 * s12, -l2 * s12], [l1 * c1 + l2 * c12, l2 * c12]])
        bend = np.array(
            [-l1 * c1 * dq[0] ** 2 - l2 * c12 * dq.sum() ** 2, -l1 * s1 * dq[0] ** 2 - l2 * s12 * dq.sum() ** 2]
        )
        c, s = np.cos(q[1]), np.sin(q[1])
        M = np.array([[p1 + p2 + 2 * p3 * c, p2 + p3 * c], [p2 + p3 * c, p2]])
        C = p3 * s * np.array([[-dq[1], -dq.sum()], [dq[0], 0.0]])
        a = activation + (4.4 + 0.05 * activation) * noise
        error = np.array([0.8, 1.9]) - q - dq / 12
        torque = A.T @ (a + (K0 + K1 * a) * (A @ error))
        force = -5.0 * bend - 20.0 * (J @ dq)
        return np.linalg.solve(M + 5.0 * J.T @ J, torque - C @ dq + J.T @ force)

    q, dq, h = np.array([0.8, 1.9]), np.zeros(2), 1 / RATE
    for _ in range(round(2 * RATE)):
        first = acceleration(q, dq)
        ahead, velocity = q + h * dq, dq + h * first
        q, dq = q + h / 2 * (dq + velocity), dq + h / 2 * (first + acceleration(ahead, velocity))


if __name__ == "__main__":
    main()
