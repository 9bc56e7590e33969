"""Wall time from a CSV file to the report by one command, imports and compilation in: first run and second run.

The human ankle of `real_recordings.py`, 60 s at 1 kHz, if it is at hand. Writes results/first_report.json.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE.parent))

from real_recordings import ANKLE, DATA  # noqa: E402


def run(job: Path, folder: Path) -> float:
    """Seconds for one `jaximp identify` in a process of its own."""
    environment = os.environ | {"XDG_CACHE_HOME": str(folder / "cache")}
    begin = time.perf_counter()
    command = [
        str(Path(sys.executable).parent / "jaximp"),
        "identify",
        str(job),
        "--out",
        str(folder / "out"),
        "--force",
    ]
    subprocess.run(command, env=environment, check=True, stdout=subprocess.DEVNULL)
    return time.perf_counter() - begin


if __name__ == "__main__":
    if not DATA.is_dir():
        print("skipped: no real recordings; set JAXIMP_DATA to their folder")
        sys.exit(0)
    seconds = []
    for _ in range(3):
        folder = Path(tempfile.mkdtemp())
        (folder / "ankle.toml").write_text(ANKLE.replace('"ankle/', f'"{DATA.resolve()}/ankle/'))
        seconds.append((run(folder / "ankle.toml", folder), run(folder / "ankle.toml", folder)))
        shutil.rmtree(folder)
    first, second = (sorted(times)[1] for times in zip(*seconds, strict=True))
    results = {"first_run_s": round(first, 1), "second_run_s": round(second, 1), "cores": os.cpu_count()}
    (HERE.parent / "results" / "first_report.json").write_text(json.dumps(results) + "\n")
    print(results)
