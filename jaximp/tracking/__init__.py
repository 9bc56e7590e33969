"""Parameters that move, as a path with a band: without a window, from the whole record and up to each instant."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
