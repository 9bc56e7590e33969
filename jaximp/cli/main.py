"""The command line: `jaximp demo`, `init`, `check`, `identify`, `monitor`, `posterior`, `design`, `batch` and others.

One command a file. A file imports what its command needs when that runs: help must not wait for it.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from contextlib import suppress
from functools import wraps
from pathlib import Path
from typing import Annotated, Any

import typer

from jaximp import __version__
from jaximp.cli.batch import batch
from jaximp.cli.check import check
from jaximp.cli.demo import demo
from jaximp.cli.design import design
from jaximp.cli.export import export
from jaximp.cli.identify import identify
from jaximp.cli.init import init
from jaximp.cli.monitor import monitor
from jaximp.cli.posterior import posterior
from jaximp.cli.reproduce import reproduce
from jaximp.cli.signals import Stopped, signals_heard
from jaximp.cli.simulate import simulate
from jaximp.cli.terminal import console

MOST_CACHED = 500_000_000
"""Bytes of compiled code that are kept for later runs."""

app = typer.Typer(
    add_completion=False,
    pretty_exceptions_enable=False,
    no_args_is_help=True,
    rich_markup_mode="markdown",
    context_settings={"help_option_names": ["-h", "--help"]},
    help="Identify the mechanical impedance of human joints, and the dynamics of the robots that hold them.\n\n"
    "Begin with `jaximp demo`. For your own recording, `jaximp init FILE` writes a first job, `jaximp check JOB.toml` "
    "looks at the data, and `jaximp identify JOB.toml` writes estimates and a report.",
)


def main() -> None:
    """Run the command line; bad input ends in one line and exit status 1, a signal in another and its own status."""
    try:
        with signals_heard():
            app()
    except Stopped as stopped:
        console.print("interrupted")
        sys.stdout.flush()
        os._exit(int(stopped.code or 0))  # all is cleaned up; threads that still compile would crash while Python ends
    except (ValueError, OSError) as error:
        message = " ".join(str(error).split())
        console.print("[bold red]error:[/] ", end="")
        console.print(message, markup=False, soft_wrap=True)
        sys.exit(1)


def prepare() -> None:
    """Identification needs float64; compiled code is kept for the next run."""
    import jax

    jax.config.update("jax_enable_x64", True)
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "jaximp"
    with suppress(OSError):
        cache.mkdir(mode=0o700, parents=True, exist_ok=True)
        keep_small(cache)
    if "JAX_COMPILATION_CACHE_DIR" not in os.environ and os.access(cache, os.W_OK):
        jax.config.update("jax_compilation_cache_dir", str(cache))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.05)


def keep_small(cache: Path, most: int = MOST_CACHED) -> None:
    """Delete the compiled code that was used least lately, where there is more than so many bytes of it.

    Several processes may do so at a time: what another one has deleted is gone, and what it still needs is compiled.
    """
    files = [(entry.stat(), entry.path) for entry in os.scandir(cache) if entry.is_file()]
    total = sum(about.st_size for about, _ in files)
    for about, path in sorted(files, key=lambda file: max(file[0].st_atime, file[0].st_mtime)):
        if total <= most:
            return
        with suppress(OSError):
            os.unlink(path)
        total -= about.st_size


def prepared(command: Callable[..., None]) -> Callable[..., None]:
    """The command, after `prepare`: not before its options were read, so that its help is quick, too."""

    @wraps(command)
    def run(*arguments: Any, **options: Any) -> None:
        prepare()
        command(*arguments, **options)

    return run


def say_version(wanted: bool) -> bool:
    if wanted:
        typer.echo(f"jaximp {__version__}")
        raise typer.Exit
    return wanted


@app.callback()
def options(
    version: Annotated[
        bool, typer.Option("--version", callback=say_version, is_eager=True, help="Say the version and end.")
    ] = False,
) -> None:
    """What can be asked of jaximp itself."""


for each in (demo, init, check, identify, monitor, posterior, design, export, simulate, batch, reproduce):
    app.command()(prepared(each))
