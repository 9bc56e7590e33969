"""Regenerates the figures and tables of Börner et al. 2020 into experiments/results/borner2020."""

from __future__ import annotations

from pathlib import Path

import jax

from jaximp.papers import borner2020

jax.config.update("jax_enable_x64", True)

if __name__ == "__main__":
    folder = Path(__file__).parent / "results" / "borner2020"
    folder.mkdir(parents=True, exist_ok=True)
    borner2020.reproduce(folder)
    print((folder / "tables.md").read_text())
