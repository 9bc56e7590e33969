"""Least squares in sliding windows, this project beside its peers, in one run; ratios count, seconds do not.

Every measurement is a process of its own, so that none inherits the other's memory or compiled code; the peers
(`pip install -e '.[peers]'`) run between ours. Writes results/sliding_windows.json and .md.
"""

from __future__ import annotations

import json
import os
import platform
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from importlib.util import find_spec
from pathlib import Path

import numpy as np

RESULTS = Path(__file__).parents[1] / "results"
PEERS = ("polars_ols", "statsmodels", "padasip")


def data(n: int, p: int) -> tuple[np.ndarray, np.ndarray]:
    random = np.random.default_rng(0)
    W = random.normal(size=(n, p))
    return W, W @ np.arange(1.0, p + 1) + random.normal(size=n)


def seconds(function: Callable[[], object], repeats: int = 5) -> dict[str, float]:
    """First call and the best of some more: other work on a shared machine only ever adds."""
    times = []
    for _ in range(repeats + 1):
        begin = time.perf_counter()
        function()
        times.append(time.perf_counter() - begin)
    return {"first": times[0], "s": min(times[1:])}


def ours(what: str, n: int, p: int, window: int, repeats: int = 5) -> dict[str, float]:
    import jax

    jax.config.update("jax_enable_x64", True)
    import jaximp
    from jaximp.signals import autocovariance, butterworth

    W, y = data(n, p)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    # A 40 Hz low-pass of order 4 at 1 kHz, and every fifth sample kept.
    noise = autocovariance(butterworth(4, 40, 1000), 5) if what == "coloured" else None
    fits = {
        "theta": lambda: jaximp.sliding_theta(W, y, window),
        "textbook": lambda: jaximp.sliding_least_squares(W, y, window),
        "coloured": lambda: jaximp.sliding_least_squares(W, y, window, noise=noise),
        "recursive": lambda: jax.block_until_ready(jaximp.recursive_least_squares(W, y, 0.999)),
    }
    found = seconds(fits[what], repeats)
    peak = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) * 1024
    result = fits[what]()
    output = sum(np.asarray(leaf).nbytes for leaf in jax.tree.leaves(result))
    return found | {"memory": (W.nbytes + y.nbytes + peak) / (W.nbytes + y.nbytes + output)}


def write_parquet(path: str, n: int, p: int) -> dict[str, float]:
    """A recording that is larger than the memory it is to be read with, a million rows at a time."""
    import pyarrow as pa
    from pyarrow import parquet

    schema = pa.schema([(name, pa.float64()) for name in [*(f"x{k}" for k in range(p)), "y"]])
    random = np.random.default_rng(0)
    with parquet.ParquetWriter(path, schema, compression="none", use_dictionary=False) as writer:
        for first in range(0, n, 10**6):
            W = random.normal(size=(min(10**6, n - first), p))
            y = W @ np.arange(1.0, p + 1) + random.normal(size=len(W))
            writer.write_table(pa.Table.from_arrays([pa.array(x) for x in (*W.T, y)], schema=schema))
    return {"bytes": Path(path).stat().st_size}


def from_parquet(path: str, window: int) -> dict[str, float]:
    """Every window of a file, read batch by batch; what is found is summed up, not kept."""
    import jax

    jax.config.update("jax_enable_x64", True)
    from pyarrow import parquet

    import jaximp

    def pieces() -> Iterator[tuple[np.ndarray, np.ndarray]]:
        with parquet.ParquetFile(path, pre_buffer=False) as file:
            for batch in file.iter_batches(batch_size=200_000):
                *columns, y = (column.to_numpy() for column in batch.columns)
                yield np.stack(columns, axis=1), y

    def solve() -> tuple[int, float]:
        sums = [(len(fit.theta), float(fit.theta[:, 0].sum())) for fit in jaximp.sliding_pieces(pieces(), window)]
        return sum(count for count, _ in sums), sum(total for _, total in sums)

    found = seconds(solve, 1)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    count, total = solve()
    return found | {"windows": count, "mean_of_first": total / count, "peak_GB": peak / 1e9}


def polars(what: str, n: int, p: int, window: int) -> dict[str, float]:
    import polars as pl
    import polars_ols  # noqa: F401

    W, y = data(n, p)
    names = [f"x{k}" for k in range(p)]
    frame = pl.DataFrame(dict(zip(names, W.T, strict=True)) | {"y": y})
    columns = [pl.col(name) for name in names]
    y_column = pl.col("y").least_squares
    expression = {
        "theta": lambda: y_column.rolling_ols(*columns, window_size=window, mode="coefficients"),
        "recursive": lambda: y_column.rls(*columns, half_life=float(np.log(0.5) / np.log(0.999)), mode="coefficients"),
    }[what]
    return seconds(lambda: frame.select(expression()), 3)


def statsmodels(n: int, p: int, window: int) -> dict[str, float]:
    from statsmodels.regression.rolling import RollingOLS

    W, y = data(n, p)
    return seconds(lambda: RollingOLS(y, W, window=window).fit(params_only=True), 3)


def padasip(n: int, p: int) -> dict[str, float]:
    from padasip.filters import FilterRLS

    W, y = data(n // 50, p)
    return {"s": 50 * seconds(lambda: FilterRLS(p, mu=0.999).run(y, W), 3)["s"]}


def streaming(p: int) -> dict[str, float]:
    import jax

    jax.config.update("jax_enable_x64", True)
    from jaximp.least_squares import recursive

    W, y = data(20_000, p)
    step, state, times = jax.jit(recursive.step), recursive.init(p), []
    for row, torque in zip(W, y, strict=True):
        begin = time.perf_counter()
        state, theta = step(state, row, torque, 0.999)
        np.asarray(theta)
        times.append(time.perf_counter() - begin)
    batch = np.asarray(recursive.recursive_least_squares(W, y, 0.999).theta[-1])
    return {
        "p99_ms": 1e3 * float(np.percentile(times[100:], 99)),
        "difference": float(np.abs(np.asarray(theta) / batch - 1).max()),
    }


def measure(call: str, cache: str | None = None) -> dict[str, float]:
    """Evaluate one of the functions above in a process of its own, if wanted with a cache of compiled code."""
    command = [sys.executable, __file__, call]
    settings = {"JAX_COMPILATION_CACHE_DIR": cache, "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0.05"}
    environment = os.environ | (settings if cache else {})
    done = subprocess.run(command, capture_output=True, text=True, check=True, env=environment)
    found = json.loads(done.stdout.splitlines()[-1])
    print(f"{call}: {found}", flush=True)
    return found


def run() -> tuple[dict[str, dict[str, float]], list[tuple[str, str, str]]]:
    def all_of(calls: dict[str, str]) -> dict[str, dict[str, float]]:
        return {name: measure(call) for name, call in calls.items()}

    found = all_of(
        {
            "theta": "ours('theta', 10**6, 8, 2000)",
            "polars": "polars('theta', 10**6, 8, 2000)",
            "textbook": "ours('textbook', 10**6, 8, 2000)",
            "coloured": "ours('coloured', 10**6, 8, 2000, 2)",
            "theta, 1e5 x 4": "ours('theta', 10**5, 4, 2000)",
            "statsmodels, 1e5 x 4": "statsmodels(10**5, 4, 2000)",
            "window 200": "ours('textbook', 10**6, 4, 200)",
            "window 2000": "ours('textbook', 10**6, 4, 2000)",
            "window 20000": "ours('textbook', 10**6, 4, 20000)",
            "N 1e5": "ours('textbook', 10**5, 4, 2000, 9)",
            "N 1e7": "ours('textbook', 10**7, 4, 2000, 2)",
            "recursive": "ours('recursive', 10**6, 4, 1)",
            "polars rls": "polars('recursive', 10**6, 4, 1)",
            "padasip": "padasip(10**6, 4)",
            "streaming": "streaming(8)",
        }
    )

    with tempfile.TemporaryDirectory() as folder:
        for name in ("theta", "textbook", "coloured"):
            call = f"ours('{name}', 10**5, 8, 2000, 2)"
            measure(call, folder)
            found[f"{name}, second process"] = measure(call, folder)
        for name, n in (("1e6", 10**6), ("1e8", 10**8)):
            path = f"{folder}/{name}.parquet"
            found[f"Parquet {name}"] = measure(f"write_parquet({path!r}, {n}, 4)")
            found[f"Parquet {name}"] |= measure(f"from_parquet({path!r}, 2000)")
            Path(path).unlink()

    def compilation(name: str) -> str:
        first, second = found[name], found[f"{name}, second process"]
        return f"{first['first'] - first['s']:.1f} s ({second['first'] - second['s']:.1f} s)"

    def ratio(slow: str, fast: str) -> float:
        return found[slow]["s"] / found[fast]["s"]

    lengths = [found[f"window {n}"]["s"] / (10**6 - n) for n in (200, 2000, 20000)]
    per_sample = [found["N 1e5"]["s"] / 1e5, found["window 2000"]["s"] / 1e6, found["N 1e7"]["s"] / 1e7]
    rows = [
        (
            "theta alone, 1e6 x 8, windows of 2000",
            "5 times polars-ols, 10 the aim",
            f"{ratio('polars', 'theta'):.1f} times",
        ),
        (
            "theta alone, 1e5 x 4, windows of 2000",
            "100 times statsmodels",
            f"{ratio('statsmodels, 1e5 x 4', 'theta, 1e5 x 4'):.0f} times",
        ),
        (
            "with textbook standard errors, condition, singular value, RMS",
            "at most 3 times theta alone",
            f"{ratio('textbook', 'theta'):.1f} times",
        ),
        (
            "with standard errors that know the filter",
            "at most 3 times the textbook's is the aim",
            f"{ratio('coloured', 'textbook'):.1f} times",
        ),
        ("windows of 200 to 20 000", "flat within 1.3 times", f"{max(lengths) / min(lengths):.2f} times"),
        ("1e5 to 1e7 samples", "linear within 1.2 times", f"{max(per_sample) / min(per_sample):.2f} times"),
        (
            "1e6 to 1e8 samples x 4 from Parquet",
            "linear within 1.2 times",
            f"{found['Parquet 1e8']['s'] / found['Parquet 1e6']['s'] / 100:.2f} times",
        ),
        ("peak memory, 1e8 x 4 from Parquet", "2 GB", f"{found['Parquet 1e8']['peak_GB']:.2f} GB"),
        ("peak memory, 1e7 x 4", "3 times input plus output", f"{found['N 1e7']['memory']:.1f} times"),
        (
            "recursive least squares, 1e6 x 4",
            "polars-ols; 50 times padasip",
            f"{ratio('polars rls', 'recursive'):.1f} times; {ratio('padasip', 'recursive'):.0f} times",
        ),
        (
            "one sample at a time, 8 columns, 99th percentile",
            "0.5 ms; batch estimates to 1e-10",
            f"{found['streaming']['p99_ms']:.2f} ms; {found['streaming']['difference']:.0e}",
        ),
        (
            "compilation of the first call (in a second process): theta alone, textbook, coloured",
            "3 s; found in a cache",
            ", ".join(compilation(name) for name in ("theta", "textbook", "coloured")),
        ),
    ]
    return found, rows


def machine() -> str:
    model = next((line for line in Path("/proc/cpuinfo").read_text().splitlines() if line.startswith("model name")), "")
    return f"{os.cpu_count()} cores, {model.split(':')[-1].strip() or platform.processor()}, float64"


if __name__ == "__main__":
    if len(sys.argv) > 1:
        print(json.dumps(eval(sys.argv[1])))
        sys.exit(0)
    missing = [name for name in PEERS if find_spec(name) is None]
    if missing:
        print(f"skipped: the peers {', '.join(missing)} are not installed (pip install -e '.[peers]')")
        sys.exit(0)
    found, rows = run()
    table = [f"{machine()}\n", "| what | target | reached |", "| --- | --- | --- |"]
    table += [f"| {what} | {target} | {reached} |" for what, target, reached in rows]
    RESULTS.mkdir(exist_ok=True)
    (RESULTS / "sliding_windows.json").write_text(json.dumps({"machine": machine()} | found, indent=1) + "\n")
    (RESULTS / "sliding_windows.md").write_text("\n".join(table) + "\n")
    print("\n".join(table))
