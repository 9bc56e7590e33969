"""Parameters that move: a million rows, and a thousand recordings side by side, in one run; ratios count.

Every measurement is a process of its own. The path and the likelihood of known drift sizes: 10^6 rows of 4 parameters;
a thousand recordings of 10 s at 100 Hz (3 parameters, a point each 10 ms) side by side, and one after the other, each
by the same compiled function for one. `track`, whose drift is to be found, on a minute at 100 Hz: the first call, which
compiles, and later ones. Writes results/tracking.json and .md.
"""

from __future__ import annotations

import json
import os
import platform
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

RESULTS = Path(__file__).parents[1] / "results"
RECORDINGS, SAMPLES, LOOPED = 1000, 1000, 50
MANY, WIDE, GRID = 10**6, 4, 10


def data(recordings: int, n: int, p: int) -> tuple[np.ndarray, np.ndarray]:
    random = np.random.default_rng(0)
    W = random.normal(size=(recordings, n, p))
    moving = np.arange(1.0, p + 1) + np.sin(4 * np.pi * np.arange(n) / n)[:, None] * (np.arange(p) == p - 1)
    return W, np.einsum("rnp,np->rn", W, moving) + 0.3 * random.normal(size=(recordings, n))


def seconds(function: Callable[[], object], repeats: int = 4) -> dict[str, float]:
    """First call and the best of some more: other work on a shared machine only ever adds."""
    times = []
    for _ in range(repeats + 1):
        begin = time.perf_counter()
        function()
        times.append(time.perf_counter() - begin)
    return {"first": times[0], "s": min(times[1:])}


def known(what: str, order: int) -> dict[str, float]:
    """Paths of known drift sizes."""
    import jax

    jax.config.update("jax_enable_x64", True)
    from jaximp.numerics.compilation import compiled
    from jaximp.tracking import smoothed_path, smoothed_paths

    shape = (1, MANY, WIDE) if what == "rows" else (RECORDINGS, SAMPLES, 3)
    W, y = data(*shape)
    settings: dict[str, Any] = {"grid": GRID if what == "rows" else 1, "noise": 0.3, "order": order}
    drift = 1e-3 * np.eye(shape[2])[-1]
    function = compiled(
        lambda W, y: (smoothed_paths if what == "lanes" else smoothed_path)(W, y, drift=drift, **settings)
    )
    if what == "lanes":
        return seconds(lambda: jax.block_until_ready(function(W, y)))
    if what == "rows":
        return seconds(lambda: jax.block_until_ready(function(W[0], y[0])))
    found = seconds(lambda: [jax.block_until_ready(function(W[k], y[k])) for k in range(LOOPED)])
    return {name: t * RECORDINGS / LOOPED for name, t in found.items()}


def found(p: int) -> dict[str, float]:
    import jax

    jax.config.update("jax_enable_x64", True)
    from jaximp import track

    W, y = data(1, 6000, p)
    return seconds(lambda: track(W[0], y[0], grid=0.02, sample_rate=100.0), 2)


def measure(*arguments: str) -> dict[str, float]:
    """In a process of its own, without a store of compiled programs."""
    env = {**os.environ, "JAX_COMPILATION_CACHE_DIR": ""}
    done = subprocess.run([sys.executable, __file__, *arguments], capture_output=True, text=True, check=True, env=env)
    return dict(json.loads(done.stdout.splitlines()[-1]))


def run() -> dict[str, Any]:
    measured: dict[str, Any] = {"machine": f"{platform.machine()}, {os.cpu_count()} cores"}
    for order in (0, 1):
        for what in ("rows", "lanes", "loop"):
            measured[f"{what}, order {order}"] = measure(what, str(order))
        loop, lanes = (measured[f"{what}, order {order}"]["s"] for what in ("loop", "lanes"))
        measured[f"loop over lanes, order {order}"] = loop / lanes
    for p in (3, 8):
        measured[f"track, p = {p}"] = measure("track", str(p))
    return measured


def table(measured: dict[str, Any]) -> str:
    rows = [
        *(
            f"| 10^6 rows, p = {WIDE}, path and likelihood, {kind} [s] | {measured[f'rows, order {k}']['s']:.2f} |"
            for k, kind in enumerate(("random walk", "smooth"))
        ),
        *(
            f"| {RECORDINGS} recordings of {SAMPLES} rows, p = 3, {kind}: loop of a compiled one over all together "
            f"| {measured[f'loop over lanes, order {k}']:.1f} |"
            for k, kind in enumerate(("random walk", "smooth"))
        ),
        *(
            f"| `track`, 6000 rows, 3000 points, p = {p}: first call, later ones [s] "
            f"| {measured[f'track, p = {p}']['first']:.1f}, {measured[f'track, p = {p}']['s']:.1f} |"
            for p in (3, 8)
        ),
    ]
    return "\n".join(["| | |", "|---|---|", *rows]) + "\n"


if __name__ == "__main__":
    if len(sys.argv) > 1:
        what, number = sys.argv[1], int(sys.argv[2])
        print(json.dumps(found(number) if what == "track" else known(what, number)))
    else:
        result = run()
        (RESULTS / "tracking.json").write_text(json.dumps(result, indent=1) + "\n")
        (RESULTS / "tracking.md").write_text(table(result))
        print(table(result))
