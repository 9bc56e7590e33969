"""A real robot of six joints from its URDF: what it predicts, and whether its errors are as large as they say.

`ur10e` (JAXIMP_DATA, else ../shared/data): exciting motions are fitted, a motion from point to point is predicted, its
standstill included. Then every exciting motion is fitted by itself, and in halves and thirds: parameters of a robot
that does not change must scatter as their standard errors claim. Writes experiments/results/robots.json and robots.md.

    python experiments/robots.py
"""

from __future__ import annotations

import json
import os
from itertools import pairwise
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jaximp.identification import FilterSettings, Pipeline, estimate
from jaximp.models import Chain
from jaximp.recordings import recordings_from_mapping
from jaximp.types import Numbers, Recording

jax.config.update("jax_enable_x64", True)

RESULTS = Path(__file__).parent / "results"
DATA = Path(os.environ.get("JAXIMP_DATA") or Path(__file__).parents[2] / "shared" / "data") / "ur10e"
GAINS = [10.0, 10.70, 8.46, 9.00, 9.48, 10.12]
"""The owners' [N m/A]."""
EXCITING = {"30sec_12harm.csv": (635, 3510), "40sec_12harm.csv": (500, 4460), "14harm50sec.csv": (195, 4966)}
UNSEEN = "ptp_10_points.csv", (700, 4200)
PARTS = {"30sec_12harm.csv": 2, "40sec_12harm.csv": 2, "14harm50sec.csv": 3}
FILTER = FilterSettings(position_cutoff=10.0, decimation_cutoff=5.0)
PEER = "figaroh was reported to leave 4.75 to 4.80 % of the same rows, by two recordings; it was not run here"


def recording(file: str, rows: tuple[int, int]) -> Recording:
    torque = {"columns": [14, 15, 16, 17, 18, 19], "gain": GAINS}
    table = {"file": file, "rows": list(rows), "time": 1, "position": [2, 3, 4, 5, 6, 7], "torque": torque}
    return recordings_from_mapping(table, DATA)[0]


def pipeline() -> Pipeline:
    arm = Chain.from_urdf(DATA / "ur10e.urdf", friction=True, rotor=True, offset=True)
    return Pipeline(100.0, arm.with_sign_width(0.005), filter=FILTER)


def predicted(files: list[str]) -> dict[str, Any]:
    """What is left of the unseen recording, by a fit of these."""
    unseen = recording(*UNSEEN)
    seen = [recording(file, EXCITING[file]) for file in files]
    (found,) = estimate(pipeline(), seen if len(seen) > 1 else seen[0], held_out=unseen)
    assert found.held_out is not None
    held = found.held_out
    return {"files": files, "residual": held.total, "moving": held.moving.tolist(), "still": held.still.tolist()}


def scatter(pieces: list[tuple[str, tuple[int, int]]]) -> dict[str, Any]:
    """Between fits of pieces, over the standard errors: root mean square and median over parameters of a kind."""
    fits = [estimate(pipeline(), recording(*piece))[0] for piece in pieces]
    value, stderr = (np.array([getattr(one, name)[0] for one in fits]) for name in ("value", "stderr"))
    weight = 1 / stderr**2
    mean = (weight * value).sum(axis=0) / weight.sum(axis=0)
    ratio: Numbers = np.sqrt((weight * (value - mean) ** 2).sum(axis=0) / (len(fits) - 1))
    kinds = {"rigid": ("link", "rotor"), "friction": ("friction",), "offset": ("offset",)}
    found = {}
    for kind, words in kinds.items():
        own = ratio[[any(word in name for word in words) for name in fits[0].names]]
        found[kind] = {"rms": float(np.sqrt((own**2).mean())), "median": float(np.median(own))}
    return found


def parts_of(file: str) -> list[tuple[str, tuple[int, int]]]:
    first, last = EXCITING[file]
    edges = np.linspace(first, last + 1, PARTS[file] + 1).astype(int)
    return [(file, (int(a), int(b) - 1)) for a, b in pairwise(edges)]


def markdown(found: dict[str, Any]) -> str:
    lines = ["| fitted | held-out residual, all joints and rows |", "| --- | --- |"]
    lines += [f"| {len(one['files'])} recordings | {one['residual']:.2%} |" for one in found["predicted"]]
    lines += ["", PEER + ".", "", "| scatter over claimed error, rms (median) | rigid | friction | constants |"]
    lines += ["| --- | --- | --- | --- |"]
    for name, kinds in found["scatter"].items():
        lines.append(f"| {name} | " + " | ".join(f"{k['rms']:.2f} ({k['median']:.2f})" for k in kinds.values()) + " |")
    return "\n".join(lines) + "\n"


def main() -> None:
    if not DATA.is_dir():
        raise SystemExit(f"no recordings in {DATA}: set JAXIMP_DATA")
    files = list(EXCITING)
    found = {
        "predicted": [predicted(files[:2]), predicted(files)],
        "scatter": {
            "three recordings": scatter(list(EXCITING.items())),
            "halves and thirds of them": scatter([piece for file in files for piece in parts_of(file)]),
        },
    }
    (RESULTS / "robots.json").write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
    text = markdown(found)
    (RESULTS / "robots.md").write_text(text, encoding="utf-8")
    print(text)


if __name__ == "__main__":
    main()
