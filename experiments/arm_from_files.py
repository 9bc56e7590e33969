"""How far the impedance that `jaximp identify` finds in files of `jaximp simulate arm` is from the truth beside them.

20 seeds of the standard recordings: 20 perturbed and 40 unperturbed movements, encoders of 1 um, inertia from 20
perturbed postures. Five of them also with the true inertia, with position and force smoothed and as measured: what
reading costs. Writes experiments/results/arm_from_files.json.
"""

from __future__ import annotations

import json
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import jax
import numpy as np

from jaximp import ArmImpedance, identify_impedance, parse_job, read_job
from jaximp.jobs.run_trials import identify_trials
from jaximp.models import BaseInertia
from jaximp.perturbation.deviations import KnownArm
from jaximp.perturbation.isolation.methods import METHODS
from jaximp.simulation.arm_recordings import write_arm_recordings

jax.config.update("jax_enable_x64", True)

SEEDS = 20
MATRICES = {"damping": "damping_Nms_per_rad", "stiffness": "stiffness_Nm_per_rad"}
OF_FILTERS = 5
"""Seeds of which the filters' share is told as well."""


def compared(found: ArmImpedance, truth: dict[str, Any]) -> dict[str, float]:
    """Each element: error as a share of the truth, standard error likewise, and whether the interval holds it."""
    low, high = found.interval()
    row = {}
    for k, name in enumerate(found.names):
        matrix, place = name.split("_")
        true = truth[MATRICES[matrix]][int(place[0]) - 1][int(place[1]) - 1]
        row |= {
            name: found.theta[k] / true - 1,
            f"{name}_stderr": found.stderr[k] / true,
            f"{name}_held": float(low[k] <= true <= high[k]),
        }
    for matrix, values in (("damping", found.D), ("stiffness", found.K)):
        true_matrix = np.array(truth[MATRICES[matrix]])
        row[f"{matrix}_norm"] = np.linalg.norm(values - true_matrix) / np.linalg.norm(true_matrix)
    return row | {"trusted": float(found.trusted)}


def main() -> None:
    rows: dict[str, list[dict[str, float]]] = {}
    for seed in range(SEEDS):
        with TemporaryDirectory() as name:
            folder = Path(name)
            write_arm_recordings(folder, seed=seed)
            truth = json.loads((folder / "truth.json").read_text())
            text = (folder / "job.toml").read_text().replace('"output_error"', json.dumps(list(METHODS)))
            result = identify_trials(parse_job(text, folder))
            for found in result.estimates:
                rows.setdefault(found.method, []).append(compared(found, truth))
            trials = read_job(folder / "job.toml").trials
            assert trials is not None
            for smooth in (True, False) if seed < OF_FILTERS else ():
                perturbed, unperturbed, _ = trials.load(smooth)
                named = {name.removesuffix("_inertia"): value for name, value in truth["inertia_kgm2"].items()}
                for method in METHODS:
                    arm = KnownArm(result.main.arm.geometry, BaseInertia(**named), trials.handle.make())
                    found = identify_impedance(perturbed, unperturbed, arm, method)
                    label = f"{method}, inertia known, {'smoothed' if smooth else 'as measured'}"
                    rows.setdefault(label, []).append(compared(found, truth))
    summary = {
        label: {
            "seeds": len(several),
            **{f"{name}_mean": float(np.mean([row[name] for row in several])) for name in several[0]},
            **{f"{name}_sd": float(np.std([row[name] for row in several], ddof=1)) for name in several[0]},
        }
        for label, several in rows.items()
    }
    target = Path(__file__).parent / "results" / "arm_from_files.json"
    target.write_text(json.dumps(summary, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
