"""Windows of planar arms: how often intervals hold the truth, and what is said of good models and of wrong ones.

Good arms (`arms.HUMAN`, `arms.ROBOT`) in white noise and in noise with a memory of 0.1 s, by estimated noise and by
ordinary least squares: of each record the intervals of the middle window count, and whether any test of the model
raises an alarm. Then arms that do what the model does not know (`arms.WRONG`).
Writes experiments/results/arm_windows.json and arm_windows.md.

    python experiments/arm_windows.py [--records 200]
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import arms
import jax
import numpy as np

from jaximp.identification.identify import estimate
from jaximp.identification.misfit import culprits
from jaximp.identification.suspects import what
from jaximp.trust.score_tests import significant

jax.config.update("jax_enable_x64", True)

ARMS = {"human": arms.HUMAN, "robot": arms.ROBOT}
NOISES = {"white": "white", "memory of 0.1 s": "order"}


def good_cell(arm: arms.Arm, noise: str, way: str, records: int) -> dict[str, Any]:
    """Coverage of the middle window, and alarms."""
    pipeline, truth = arms.pipeline(arm, noise=way), np.array(list(arm.truth.values()))
    held, error, alarms, trusted = [], [], [], []
    for k in range(records):
        found = estimate(pipeline, arms.record(np.random.default_rng((5, k)), arm, noise))[0]
        middle = len(found.value) // 2
        low, high = (x[middle] for x in found.interval())
        held.append((low < truth) & (truth < high))
        error.append((found.value[middle] - truth) / found.stderr[middle])
        alarms.append(bool(significant(found.misfits)))
        trusted.append(found.trusted.mean())
    return {
        "records": records,
        "coverage of 95 %": dict(zip(arm.truth, np.mean(held, axis=0).tolist(), strict=True)),
        "errors in standard errors, sd": dict(zip(arm.truth, np.std(error, axis=0).tolist(), strict=True)),
        "alarms": float(np.mean(alarms)),
        "windows trusted": float(np.mean(trusted)),
    }


def wrong_cell(arm: arms.Arm, wrong: arms.Wrong, records: int) -> dict[str, Any]:
    """What is found of a wrong arm, in noise with a memory."""
    pipeline = arms.pipeline(arm, wrong)
    right = [what(group) for group in wrong.culprits]
    off, named, noticed, refused, lacking = [], [], [], [], []
    for k in range(records):
        found = estimate(pipeline, arms.record(np.random.default_rng((6, k)), arm, "order", wrong))[0]
        known = [name in arm.truth for name in found.names]
        truth = np.array([arm.truth.get(name, np.nan) for name in found.names])
        off.append((np.median(found.value, axis=0) / truth - 1)[known])
        named.append(any(words in culprits(found.misfits) for words in right))
        noticed.append(bool(significant(found.misfits)))
        refused.append(found.trusted.mean() < 0.5)
        lacking.append([name in found.lacking for name in found.names])
    names = [name for name in found.names if name in arm.truth]
    return {
        "records": records,
        "off": dict(zip(names, np.mean(off, axis=0).tolist(), strict=True)),
        "said to be off": dict(zip(found.names, np.mean(lacking, axis=0).tolist(), strict=True)),
        "noticed": float(np.mean(noticed)),
        "named rightly": float(np.mean(named)),
        "not trusted": float(np.mean(refused)),
    }


def report(good: dict[str, dict[str, Any]], wrong: dict[str, dict[str, Any]], records: int) -> str:
    """Two tables."""
    lines = [
        f"{records} records a row.",
        "",
        "| arm, noise, how | 95 % intervals hold, mean | lowest | alarms | windows trusted |",
        "| --- |" + " --- |" * 4,
    ]
    for name, cell in good.items():
        held = list(cell["coverage of 95 %"].values())
        shares = (np.mean(held), min(held), cell["alarms"], cell["windows trusted"])
        lines.append(f"| {name} | " + " | ".join(f"{share:.1%}" for share in shares) + " |")
    lines += ["", "| the arm | farthest off | noticed | named | not trusted |", "| --- |" + " --- |" * 4]
    for name, cell in wrong.items():
        farthest = max(cell["off"], key=lambda one: abs(cell["off"][one]))
        shares = (cell[key] for key in ("noticed", "named rightly", "not trusted"))
        lines.append(
            f"| {name} | {farthest} {cell['off'][farthest]:+.0%} | "
            + " | ".join(f"{share:.0%}" for share in shares)
            + " |"
        )
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    arguments.add_argument("--records", type=int, default=200, help="of every row")
    records = arguments.parse_args().records
    good = {
        f"{name}, {noise}, {way}": good_cell(arm, kind, way, records)
        for name, arm in ARMS.items()
        for noise, kind in NOISES.items()
        for way in ("estimated", "filtered")
    }
    wrong = {name: wrong_cell(*one, records) for name, one in arms.WRONG.items()}
    folder = Path(__file__).parent / "results"
    (folder / "arm_windows.json").write_text(json.dumps({"good": good, "wrong": wrong}, indent=1) + "\n")
    (folder / "arm_windows.md").write_text(report(good, wrong, records))
    print(report(good, wrong, records))
