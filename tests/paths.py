"""Where the project is, with its README, docs and examples, and where real recordings are."""

import os
from pathlib import Path

ROOT = Path(__file__).parents[1]
DATA = Path(os.environ.get("JAXIMP_DATA") or ROOT / "../shared/data").resolve()
"""Real recordings, which are not part of this project."""
