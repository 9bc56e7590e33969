"""Libraries that only some formats need, and that not everybody has."""

from __future__ import annotations

import importlib
from typing import Any

from jaximp.recordings.errors import RecordingError


def library(module: str, package: str, extension: str) -> Any:
    """A module of the extra `formats`.

    **Raises:** `RecordingError` with what to install where it is missing.
    """
    try:
        return importlib.import_module(module)
    except ImportError:
        raise RecordingError(
            f"'{extension}' files need {package}, which is not installed: pip install 'jaximp[formats]' (or export the "
            "recording as CSV)"
        ) from None
