"""`jaximp reproduce`."""

from __future__ import annotations

from enum import StrEnum
from importlib import import_module

import typer

from jaximp.cli.terminal import Force, Out, bar_of


class Paper(StrEnum):
    """What can be reproduced."""

    tout2023 = "tout2023"
    lakatos2011 = "lakatos2011"
    borner2020 = "borner2020"


def reproduce(paper: Paper, out: Out, force: Force = False) -> None:
    """Redraw a paper's figures and tables; tables.json holds the numbers beside the paper's."""
    from jaximp.recordings.outputs import new_folder

    study = import_module(f"jaximp.papers.{paper.value}")
    with new_folder(out, force) as folder, bar_of(f"reproducing {paper.value}") as progress:
        study.reproduce(folder, progress)
    typer.echo(f"figures and tables: {out}")
