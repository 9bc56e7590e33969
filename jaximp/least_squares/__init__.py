"""Least squares in one window, in all windows, adaptive and recursive; noise that is not white."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
