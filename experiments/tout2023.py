"""Regenerates the figures and tables of Tout et al. 2023 into experiments/results/tout2023."""

from __future__ import annotations

from pathlib import Path

import jax

from jaximp.papers import tout2023

jax.config.update("jax_enable_x64", True)

if __name__ == "__main__":
    folder = Path(__file__).parent / "results" / "tout2023"
    folder.mkdir(parents=True, exist_ok=True)
    tout2023.reproduce(folder)
    print((folder / "tables.md").read_text())
