"""One recording: filters, rows, windows, methods 1 to 4, estimates with verdicts."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
