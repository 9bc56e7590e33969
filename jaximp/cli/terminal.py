"""What the commands share: their options, a bar of progress, and what they say at the end."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console

if TYPE_CHECKING:  # a command imports what it needs when it runs: `--help` must not wait for it
    from jaximp.types import Progress

console = Console(stderr=True, highlight=False)

JobFile = Annotated[Path, typer.Argument(metavar="JOB.toml", help="What to identify, from which recording.")]
Out = Annotated[Path, typer.Option("--out", "-o", help="Folder to write; it must not exist yet.")]
OutBeside = Annotated[
    Path | None,
    typer.Option("--out", "-o", help="Folder to write; it must not exist yet.", show_default="beside the job"),
]
Force = Annotated[bool, typer.Option("--force", help="Replace a folder that jaximp wrote earlier.")]
Seed = Annotated[int, typer.Option("--seed", help="Seed of the simulated noise.")]


@contextmanager
def bar_of(task: str) -> Iterator[Progress]:
    """A bar on the terminal, nothing where there is none."""
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    columns = (TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn())
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as bar:
        name = bar.add_task(task, total=1.0)
        yield lambda share: bar.update(name, completed=share)


def out_beside(job_file: Path, out: Path | None, what: str) -> Path:
    """The folder that was asked for, or one beside the job and called after it."""
    return job_file.with_name(f"{job_file.stem}-{what}") if out is None else out


def say_where(out: Path) -> None:
    typer.echo(f"report: {(out / 'report.html').resolve()}")
