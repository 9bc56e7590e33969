"""Where the project is: its README, its docs and examples, and the library itself."""

from pathlib import Path

ROOT = Path(__file__).parents[1]
