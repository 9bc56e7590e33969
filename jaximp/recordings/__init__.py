"""Recordings: files of many kinds, columns and units, a uniform grid in time."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
