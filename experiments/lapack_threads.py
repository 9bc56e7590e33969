"""Do compiled programs that call LAPACK block each other on few cores?

Every case is a process of its own on two cores: one thread, or four with a compiled program each, decompose batches of
small matrices. A case is blocked where for half a minute no call ends and all threads sleep; on a slow machine some of
them would be waiting for a processor instead. The result stands in results/lapack_threads.txt.

No upstream report of this was found. Programs with Fourier transforms are known to block in a like way, a thread of the
pool waiting for the pool: https://github.com/PyAutoLabs/PyAutoFit/issues/1530.

    python experiments/lapack_threads.py [seconds for each case]
"""

from __future__ import annotations

import os
import subprocess
import sys
import threading
import time
from pathlib import Path

PROGRAMS = {
    "cholesky": ("cholesky",),
    "qr": ("qr",),
    "svd": ("svd",),
    "eigh": ("eigh",),
    "fft": ("fft",),
    "all four in one program": ("cholesky", "qr", "svd", "eigh"),
    "svd and fft in one program": ("svd", "fft"),
}
THREADS = (1, 4)
PATIENCE = 30
"""Seconds without any progress."""


def others_run() -> bool:
    """Whether any other thread of this process runs, or would if a processor were free (Linux)."""
    mine = str(threading.get_native_id())
    states = [
        (task / "stat").read_text().rsplit(")", 1)[1].split()[0]
        for task in Path("/proc/self/task").iterdir()
        if task.name != mine
    ]
    return any(state != "S" for state in states)


def work(program: str, threads: int, seconds: float) -> None:
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:2])
    import jax
    import jax.numpy as jnp

    jax.config.update("jax_enable_x64", True)
    functions = {
        "cholesky": lambda x: jnp.linalg.cholesky(x.T @ x),
        "qr": lambda x: jnp.linalg.qr(x, mode="r"),
        "svd": lambda x: jnp.linalg.svd(x, compute_uv=False),
        "eigh": lambda x: jnp.linalg.eigh(x.T @ x)[0],
        "fft": lambda x: jnp.abs(jnp.fft.rfft(x, n=1024, axis=0)),
    }
    calls, ended = [0] * threads, threading.Event()

    def run(thread: int) -> None:
        solve = jax.jit(jax.vmap(lambda x: sum(functions[name](x).sum() for name in PROGRAMS[program])))
        x = jax.random.normal(jax.random.key(thread), (100 + thread, 500, 6))  # another shape, another program
        while not ended.is_set():
            jax.block_until_ready(solve(x))
            calls[thread] += 1

    workers = [threading.Thread(target=run, args=(thread,), daemon=True) for thread in range(threads)]
    for worker in workers:
        worker.start()
    begin = moved = time.monotonic()
    before = 0
    while any(worker.is_alive() for worker in workers):
        time.sleep(1)
        if time.monotonic() - begin > seconds and all(calls):
            ended.set()
        if sum(calls) > before or others_run():
            before, moved = sum(calls), time.monotonic()
        if time.monotonic() - moved > PATIENCE:
            print(f"blocked after {sum(calls)} calls", flush=True)
            os._exit(0)
    print(f"{sum(calls)} calls", flush=True)


def main() -> None:
    from importlib.metadata import version

    seconds = sys.argv[1] if len(sys.argv) > 1 else "20"
    lines = [f"jax {version('jax')}, two cores, {seconds} s for each case"]
    for program in PROGRAMS:
        for threads in THREADS:
            command = [sys.executable, __file__, "--work", program, str(threads), seconds]
            said = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True).stdout.strip()
            lines.append(f"{program}, {threads} thread{'s' * (threads > 1)}: {said}")
            print(lines[-1], flush=True)
    (Path(__file__).parent / "results" / "lapack_threads.txt").write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    if sys.argv[1:2] == ["--work"]:
        work(sys.argv[2], int(sys.argv[3]), float(sys.argv[4]))
    else:
        main()
