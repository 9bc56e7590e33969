"""Figures: the only part that draws.

Every function takes results and returns a `Figure` of a printed page's width; `png` renders it. Nothing is kept
between calls, and the settings of a caller's own matplotlib stay as they are. Long recordings are thinned to
envelopes, so that a million samples cost as much as a few thousand.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
