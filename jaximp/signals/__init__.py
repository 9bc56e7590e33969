"""Filters without a shift in time, derivatives, and raw samples: noise, jumps, steps, glitches, limits."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
