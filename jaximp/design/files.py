"""A designed motion as files: for a controller (CSV), for other programs (JSON), for ROS (YAML), for robots that read
URScript; and read back."""

from __future__ import annotations

import csv
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaximp.design.clearance import Clearance
from jaximp.design.excitation import Design
from jaximp.models.chain import Chain
from jaximp.motion.trajectories import FourierSeries

FORMAT = "jaximp trajectory, version 1"
CHANNELS = {"position": "rad", "velocity": "rad_s", "acceleration": "rad_s2", "torque": "Nm"}
"""Columns of the CSV file, with what stands for the unit in their names."""


CYCLE = 0.008
"""Of the positions in a URScript [s]: what controllers of either generation keep pace with."""
LOOKAHEAD, GAIN = 0.1, 300
"""With which the controller follows them: smoothing [s] and stiffness of `servoj`."""
APPROACH = (0.5, 0.5)
"""Acceleration [rad/s^2] and speed [rad/s] towards the first position."""


def write_design(folder: Path, design: Design, sample_rate: float, joints: tuple[str, ...] = ()) -> None:
    """Write trajectory.csv, .json and .yaml: one period at the controller's sample rate [Hz].

    Of six joints that begin and end at rest also trajectory.script, in URScript.

    **Arguments:** `joints` their names, for ROS; by default those of the URDF, or joint1, joint2, ...
    """
    n, moved = design.model.n_joints, design.moved
    named = moved.joint_names if isinstance(moved, Chain) else tuple(f"joint{j + 1}" for j in range(n))
    joints = joints or named
    if len(joints) != n:
        raise ValueError(f"{len(joints)} names for {n} joints: give one name for each joint")
    motion = {name: x if name == "time" else x.reshape(len(x), n) for name, x in design.sampled(sample_rate).items()}
    _write_csv(folder / "trajectory.csv", motion, n)
    text = json.dumps(_summary(design, sample_rate) | {name: x.tolist() for name, x in motion.items()}, indent=1)
    (folder / "trajectory.json").write_text(text + "\n", encoding="utf-8")
    (folder / "trajectory.yaml").write_text(_ros(motion, joints), encoding="utf-8")
    if n == 6 and _rests(design):
        (folder / "trajectory.script").write_text(urscript(design.trajectory), encoding="utf-8")
    (folder / "summary.json").write_text(json.dumps(_summary(design, sample_rate), indent=1) + "\n", encoding="utf-8")


def read_trajectory(path: str | Path) -> FourierSeries:
    """The motion of a `trajectory.json` that `write_design` wrote.

    **Raises:** `ValueError` with one line that names the cause and the remedy.
    """
    path = Path(path)
    try:
        table = json.loads(path.read_text(encoding="utf-8"))
        if not isinstance(table, dict) or table.get("format") != FORMAT:
            raise ValueError
        return FourierSeries(**table["series"])
    except FileNotFoundError:
        raise ValueError(f"{path}: there is no such file; give the trajectory.json of a design") from None
    except (ValueError, KeyError, TypeError, UnicodeDecodeError):
        raise ValueError(f"{path}: this is not a trajectory that jaximp designed; give its trajectory.json") from None


def urscript(series: FourierSeries) -> str:
    """A program that moves to the first position, and then through one period; of six joints from rest to rest."""
    count = math.ceil(float(series.period) / CYCLE - 1e-9)
    time = np.minimum(CYCLE * np.arange(count + 1), float(series.period))
    rows = [f"[{', '.join(f'{number:.6f}' for number in row)}]" for row in np.asarray(series(time)[0])]
    follow = f"t={CYCLE}, lookahead_time={LOOKAHEAD}, gain={GAIN}"
    lines = [
        "def excitation():",
        f"  # {count + 1} positions [rad], {CYCLE} s apart. Run it slowly first, and with an empty cell.",
        f"  movej({rows[0]}, a={APPROACH[0]}, v={APPROACH[1]})",
        *(f"  servoj({row}, {follow})" for row in rows),
        "  stopj(2.0)",
        "end",
        "excitation()",
    ]
    return "\n".join(lines) + "\n"


def _rests(design: Design) -> bool:
    """Whether velocity and acceleration vanish where the period begins."""
    _, *rates = (np.abs(x) for x in design.trajectory(np.array([0.0])))
    return all((x < 1e-6).all() for x in rates)


def _write_csv(path: Path, motion: dict[str, NDArray[np.float64]], n: int) -> None:
    present = [name for name in CHANNELS if name in motion]
    of = [f"{j + 1}" if n > 1 else "" for j in range(n)]
    header = ["time_s", *(f"{name}{of[j]}_{CHANNELS[name]}" for name in present for j in range(n))]
    columns = np.column_stack([motion["time"], *(motion[name] for name in present)])
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(header)
        writer.writerows([f"{number:.12g}" for number in row] for row in columns)


def _summary(design: Design, sample_rate: float) -> dict[str, Any]:
    series, limits = design.trajectory, design.limits
    return {
        "format": FORMAT,
        "series": {name: np.asarray(getattr(series, name)).tolist() for name in ("sine", "cosine", "offset", "period")},
        "form": "q = offset + sum_k sine_k sin(w k t)/(w k) - cosine_k cos(w k t)/(w k), w = 2 pi/period, rad and s",
        "sample_rate": sample_rate,
        "parameters": list(design.model.names),
        "condition": design.condition,
        "condition_of_unit_columns": design.unit_condition,
        "lower_bound": None if math.isnan(design.lower_bound) else design.lower_bound,
        "bound": design.bound_source,
        "objective": design.objective,
        "value": design.value,
        "window": design.window,
        "worst_condition": design.worst_condition,
        "active_limits": list(design.active),
        "limits": {name: _plain(value) for name, value in vars(limits).items()},
        "clearance": None if design.clearance is None else _clearance(design.clearance),
        "conditions_of_all_starts": [float(x) if math.isfinite(x) else None for x in design.conditions],
    }


def _clearance(clearance: Clearance) -> dict[str, Any]:
    pairs, notes = list(dict.fromkeys(clearance.names)), list(clearance.notes)
    return {"distance": clearance.distance, "pairs": pairs, "notes": notes}


def _plain(value: Any) -> Any:
    """Numbers as JSON knows them: no limit is null."""
    if isinstance(value, tuple | list | np.ndarray):
        return [_plain(item) for item in value]
    return float(value) if math.isfinite(value) else None


def _ros(motion: dict[str, NDArray[np.float64]], joints: tuple[str, ...]) -> str:
    """A `trajectory_msgs/JointTrajectory`, as `ros2 topic pub` and rosbag tools read it."""
    names = {"position": "positions", "velocity": "velocities", "acceleration": "accelerations", "torque": "effort"}
    lines = ["header:", "  stamp: {sec: 0, nanosec: 0}", "  frame_id: ''", f"joint_names: {json.dumps(list(joints))}"]
    lines.append("points:")
    for k, time in enumerate(motion["time"]):
        nanoseconds = round(float(time) * 1e9)
        head = "- "
        for name, key in names.items():
            row = motion[name][k].tolist() if name in motion else []
            lines.append(f"{head}{key}: [{', '.join(f'{number:.12g}' for number in row)}]")
            head = "  "
        seconds, rest = divmod(nanoseconds, 10**9)
        lines.append(f"  time_from_start: {{sec: {seconds}, nanosec: {rest}}}")
    return "\n".join(lines) + "\n"
