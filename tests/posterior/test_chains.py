"""Files of chains: they resume to the same result, or are refused untouched."""

from __future__ import annotations

import subprocess
import sys
import textwrap
import time
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from factories.posteriors import chain_run
from jaximp.posterior import files as posterior_files
from paths import ROOT


def test_an_interrupted_run_resumes_to_the_same_result(tmp_path: Path) -> None:
    whole = chain_run(None, ess=3000)
    path = tmp_path / "chain.h5"

    class Stop(KeyboardInterrupt):
        pass

    calls = iter(range(10_000))

    def stop(share: float) -> None:
        if next(calls) == 1:
            raise Stop

    with pytest.raises(Stop):
        chain_run(path, ess=3000, progress=stop)
    with h5py.File(path) as file:
        assert len(file["mcmc/chain"]) == 200
    chain_run(path, max_steps=350)  # with fewer steps than before it was interrupted, and then a few more
    resumed = chain_run(path, ess=3000)
    np.testing.assert_array_equal(whole.chains, resumed.chains)
    np.testing.assert_array_equal(whole.log_density, resumed.log_density)
    again = chain_run(path, ess=3000)
    np.testing.assert_array_equal(whole.chains, again.chains)
    assert [file.name for file in tmp_path.iterdir()] == ["chain.h5"]


def test_emcee_reads_the_file(tmp_path: Path) -> None:
    import emcee

    posterior = chain_run(tmp_path / "chain.h5", max_steps=100)
    backend = emcee.backends.HDFBackend(str(tmp_path / "chain.h5"), read_only=True)
    assert backend.iteration == 100
    assert backend.shape == (32, 4)
    kept = backend.get_chain()[-posterior.chains.shape[1] :].swapaxes(0, 1)
    np.testing.assert_array_equal(kept, posterior.chains)
    assert backend.random_state is not None
    assert backend.accepted.sum() > 0


@pytest.mark.slow
def test_a_run_that_is_killed_resumes(tmp_path: Path) -> None:
    """Killed without warning, between or while writing: what is there is whole."""
    program = """
        import sys
        sys.path[:0] = {path!r}
        import jax
        jax.config.update("jax_enable_x64", True)
        from jaximp.posterior import ensemble
        ensemble.SAVE_EVERY = 0
        from factories.posteriors import chain_run
        from pathlib import Path
        chain_run(Path({file!r}), ess=1e6)
    """
    file = tmp_path / "chain.h5"
    paths = [str(ROOT / "tests"), str(ROOT)]
    code = textwrap.dedent(program.format(path=paths, file=str(file)))
    with subprocess.Popen([sys.executable, "-c", code], stderr=subprocess.DEVNULL) as process:
        for _ in range(600):
            time.sleep(0.1)
            if file.exists() or process.poll() is not None:
                break
        assert process.poll() is None
        time.sleep(0.15)
        process.kill()
    for leftover in tmp_path.glob(".chain*"):
        leftover.unlink()
    resumed, whole = chain_run(file, max_steps=300), chain_run(None, max_steps=300)
    np.testing.assert_array_equal(resumed.chains, whole.chains)


@pytest.mark.parametrize(
    ("change", "line"),
    [
        ({"offset": 0.01}, "of other data or another model"),
        ({"seed": 1}, "made with 32 walkers, seed 0"),
        ({"walkers": 34}, "not with 34 walkers"),
        ({"names": ("x", "b", "c", "log_noise")}, "a model with the parameters a, b, c, log_noise"),
    ],
)
def test_chains_of_anything_else_are_refused_untouched(tmp_path: Path, change: dict[str, Any], line: str) -> None:
    path = tmp_path / "chain.h5"
    chain_run(path, max_steps=20)
    before = path.read_bytes()
    with pytest.raises(ValueError, match=line):
        chain_run(path, **change)
    assert path.read_bytes() == before


def test_other_files_are_refused_untouched(tmp_path: Path) -> None:
    path = tmp_path / "notes.txt"
    path.write_text("not a chain")
    with pytest.raises(ValueError, match="holds no chain"):
        chain_run(path)
    assert path.read_text() == "not a chain"
    with pytest.raises(ValueError, match="there is no folder"):
        chain_run(tmp_path / "nowhere" / "chain.h5")


def test_a_file_that_cannot_be_written_leaves_the_old_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "chain.h5"
    chain_run(path, max_steps=20)
    before = path.read_bytes()

    def fail(*_: Any) -> None:
        raise OSError("no space left")

    monkeypatch.setattr(posterior_files.os, "replace", fail)
    with pytest.raises(OSError, match="no space"):
        chain_run(path, max_steps=40)
    assert path.read_bytes() == before
    assert [file.name for file in tmp_path.iterdir()] == ["chain.h5"]
