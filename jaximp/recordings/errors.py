"""What is said of a measurement that cannot be used."""

from __future__ import annotations


class RecordingError(ValueError):
    """A measurement that cannot be used: one line with the cause and the remedy."""


class UnavailableError(RecordingError):
    """A file that could not be read for now, for a reason that does not lie in its content."""
