"""Several processes, a cluster and several devices give what one process gives."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pyarrow.parquet as pq
import pytest

from factories.studies import content, run
from jaximp.batch import workers as batch_workers

if TYPE_CHECKING:
    import psutil


@pytest.fixture(scope="module")
def alone(study: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The study by this process alone, with the programs that other processes have: those of users."""
    out = tmp_path_factory.mktemp("alone") / "out"
    run(study, out)
    return out


@pytest.mark.slow
def test_the_devices_of_a_host_share_a_stack(study: Path, tmp_path: Path) -> None:
    """Two devices, which XLA makes of one processor, give what one gives, and each has half of the recordings."""
    code = (
        "import jax, sys; jax.config.update('jax_enable_x64', True)\n"
        "from jaximp.batch import run as batch; from jaximp.jobs import job\n"
        "from jaximp.identification import solving\n"
        "program, placed = solving._program, []\n"
        "def seen(*args):\n"
        "    found = program(*args); placed.append(found[0].theta.sharding.device_set); return found\n"
        "solving._program = seen\n"
        "batch.run(job.read_job(sys.argv[1] + '/job.toml'), out=sys.argv[2], manifest=sys.argv[1] + '/study.csv')\n"
        "print(sorted(map(len, placed)))"
    )
    flags = "--xla_force_host_platform_device_count=2"
    done = subprocess.run(
        [sys.executable, "-c", code, str(study), str(tmp_path / "out")],
        env=os.environ | {"XLA_FLAGS": flags}, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)[-1] == 2
    for path in (study / "reference/estimates").rglob("*.parquet"):
        expected = pq.ParquetFile(path).read()
        found = pq.ParquetFile(tmp_path / "out" / path.relative_to(study / "reference")).read()
        assert found["verdict"] == expected["verdict"]
        for name in ("stiffness", "stiffness_stderr", "condition_number", "held_out_vaf"):
            np.testing.assert_allclose(found[name], expected[name], 1e-9, err_msg=name)


def is_worker(child: psutil.Process) -> bool:
    """Whether a Dask worker runs in it; of what ended a moment ago the system knows no command."""
    import psutil

    try:
        return "spawn_main" in " ".join(child.cmdline())
    except (psutil.NoSuchProcess, psutil.ZombieProcess):
        return False


@pytest.mark.slow
@pytest.mark.optimised
def test_workers_give_the_same_bits_though_one_is_killed(study: Path, alone: Path, tmp_path: Path) -> None:
    pytest.importorskip("distributed")
    import psutil

    killed: list[psutil.Process] = []

    def kill(event: dict[str, object]) -> None:
        """`kill -9` of a worker, when the first batch is done and the others are under way."""
        children = psutil.Process().children(recursive=True)
        workers = [child for child in children if is_worker(child)]
        if event["event"] == "batch" and not killed:
            addresses = {connection.laddr.ip for worker in workers for connection in worker.net_connections("inet")}
            assert addresses <= {"127.0.0.1"}
            killed.append(workers[0])
            workers[0].kill()

    assert run(study, tmp_path / "out", workers=2, tell=kill).exit_status == 0
    assert killed
    assert content(tmp_path / "out") == content(alone)
    assert json.loads((tmp_path / "out/quarantine.json").read_text()) == []


@pytest.mark.slow
@pytest.mark.optimised
def test_somebodys_cluster_gives_the_same(study: Path, alone: Path, tmp_path: Path) -> None:
    """Workers that know nothing of us, but for where we are installed."""
    distributed = pytest.importorskip("distributed")
    options = {"host": "127.0.0.1", "dashboard_address": "127.0.0.1:0", "silence_logs": 50}
    with distributed.LocalCluster(n_workers=1, threads_per_worker=2, processes=True, **options) as cluster:
        assert run(study, tmp_path / "out", scheduler=cluster.scheduler_address).exit_status == 0
    assert content(tmp_path / "out") == content(alone)


def test_who_cannot_work_is_said_in_a_line(study: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ValueError, match="one of the two"):
        run(study, tmp_path / "a", workers=2, scheduler="tcp://127.0.0.1:1")
    pytest.importorskip("distributed")
    monkeypatch.setattr(batch_workers, "PATIENCE", 1.0)
    with pytest.raises(ValueError, match="no Dask scheduler answers at tcp://127"):
        run(study, tmp_path / "b", scheduler="tcp://127.0.0.1:1")
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(ValueError, match="jaximp\\[batch\\]"):
        run(study, tmp_path / "c", workers=1)
