"""Who solves the batches: threads of this process, local workers, or those of somebody's Dask cluster."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from functools import cache
from pathlib import Path
from typing import Any

from jaximp.batch.plan import Batch
from jaximp.batch.results import solve_batch
from jaximp.batch.task import Task
from jaximp.numerics.cores import cores

IN_FLIGHT = 2
"""Batches that are handed out per worker: one is solved while the next one waits."""
PATIENCE = 30.0
"""How long a scheduler has to answer [s]."""

Found = Iterator[tuple[Batch, dict[str, Any] | BaseException]]


def solved(
    task: Task, batches: Sequence[Batch], workers: int, scheduler: str | None, check: Callable[[], None]
) -> Found:
    """Every batch with its receipt, or with why there is none, in the order in which they are done."""
    if scheduler is not None or workers > 0:
        return _on_workers(task, batches, workers, scheduler, check)
    return _on_threads(task, batches, check)


def _on_threads(task: Task, batches: Sequence[Batch], check: Callable[[], None]) -> Found:
    """In this process: while one batch is solved, others are read and written."""
    stop = threading.Event()
    pool = ThreadPoolExecutor(cores())

    def solve(batch: Batch) -> dict[str, Any]:
        return solve_batch(task, batch, stop.is_set)

    def first_done(futures: list[Future[Any]]) -> list[Future[Any]]:
        done: set[Future[Any]] = set()
        while not done:  # a wait without end could not be interrupted by a signal on every system
            done = wait(futures, timeout=1.0, return_when=FIRST_COMPLETED).done
            check()
        return [future for future in futures if future in done]

    try:
        yield from _in_turn(batches, cores() + 1, lambda batch: pool.submit(solve, batch), first_done)
    finally:
        stop.set()
        pool.shutdown(wait=True, cancel_futures=True)


def _in_turn(
    batches: Sequence[Batch], at_once: int, submit: Callable[[Batch], Any], first_done: Callable[[list[Any]], list[Any]]
) -> Found:
    """Never more than a few batches at a time, so that memory does not depend on how many there are."""
    waiting, ahead = dict[Any, Batch](), iter(batches)
    while True:
        for batch in ahead:
            waiting[submit(batch)] = batch
            if len(waiting) >= at_once:
                break
        if not waiting:
            return
        for future in first_done(list(waiting)):
            batch = waiting.pop(future)
            try:
                found: Any = future.result()
            except Exception as error:
                found = error
            yield batch, found


def _on_workers(
    task: Task, batches: Sequence[Batch], workers: int, scheduler: str | None, check: Callable[[], None]
) -> Found:
    """On the workers of a Dask cluster; a local one listens on the loopback interface alone."""
    try:
        from distributed import Client, LocalCluster
        from distributed import wait as wait_for
    except ImportError:
        raise ValueError("workers need Dask: pip install 'jaximp[batch]', or leave out --workers") from None
    cluster = None
    if scheduler is None:
        cluster = LocalCluster(
            n_workers=workers, threads_per_worker=1, processes=True, host="127.0.0.1", protocol="tcp://",
            dashboard_address="127.0.0.1:0", scheduler_kwargs={"dashboard": False},  # or it wants port 8787
            worker_dashboard_address=None, silence_logs=50, env=_environment(),
        )  # fmt: skip
    try:
        with _connected(Client, cluster if cluster is not None else scheduler) as client:

            def submit(batch: Batch) -> Any:
                return client.submit(_work, task, batch, workers, pure=False)

            def first_done(futures: list[Any]) -> list[Any]:
                done = wait_for(futures, return_when="FIRST_COMPLETED").done
                check()
                return [future for future in futures if future in done]

            at_once = IN_FLIGHT * (workers or max(1, len(client.scheduler_info(n_workers=-1)["workers"])))
            yield from _in_turn(batches, at_once, submit, first_done)
    finally:
        if cluster is not None:
            cluster.close()


def _connected(client: Any, cluster: Any) -> Any:
    try:
        return client(cluster, timeout=PATIENCE)
    except (OSError, ValueError) as error:
        if not isinstance(cluster, str):
            raise
        raise ValueError(f"no Dask scheduler answers at {cluster}: check the address ({error})") from None


def _environment() -> dict[str, str]:
    """Of a worker: float64, libraries that keep to its core, and the compiled code that is kept for the next run."""
    import jax

    settings = {"JAX_ENABLE_X64": "1", "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    folder = getattr(jax.config, "jax_compilation_cache_dir", None) or os.environ.get("JAX_COMPILATION_CACHE_DIR")
    if folder is not None:
        settings |= {"JAX_COMPILATION_CACHE_DIR": folder, "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0.05"}
    return settings


@cache
def _settle(workers: int) -> None:
    """Give one of so many local workers cores, and an accelerator, of its own; before its first computation."""
    from distributed import get_worker

    number = int(get_worker().name)
    if hasattr(os, "sched_setaffinity"):
        mine = sorted(os.sched_getaffinity(0))
        share = max(1, len(mine) // workers)
        first = number * share % len(mine)
        os.sched_setaffinity(0, set(mine[first : first + share]))
    accelerators = len(list(Path("/dev").glob("nvidia[0-9]*")))
    if accelerators > 1 and "CUDA_VISIBLE_DEVICES" not in os.environ:
        os.environ["CUDA_VISIBLE_DEVICES"] = str(number % accelerators)


def _work(task: Task, batch: Batch, workers: int) -> dict[str, Any]:
    """A batch on one of so many workers of this machine (or none: on somebody's cluster), whatever its settings."""
    if workers:
        _settle(workers)
    import jax

    with jax.enable_x64(True):
        return solve_batch(task, batch)
