"""Regenerates the figures and tables of Lakatos et al. 2011 into experiments/results/lakatos2011."""

from __future__ import annotations

from pathlib import Path

import jax

from jaximp.papers import lakatos2011

jax.config.update("jax_enable_x64", True)

if __name__ == "__main__":
    folder = Path(__file__).parent / "results" / "lakatos2011"
    folder.mkdir(parents=True, exist_ok=True)
    lakatos2011.reproduce(folder)
    print((folder / "tables.md").read_text())
