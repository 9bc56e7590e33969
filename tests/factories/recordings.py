"""Recordings that are changed."""

from dataclasses import fields, replace

import numpy as np

from jaximp.types import Recording


def cut(recording: Recording, part: slice) -> Recording:
    """Some of the samples, of every channel."""
    channels = {field.name: getattr(recording, field.name) for field in fields(recording)}
    return replace(recording, **{name: x[part] for name, x in channels.items() if isinstance(x, np.ndarray)})
