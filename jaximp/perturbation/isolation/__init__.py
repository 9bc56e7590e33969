"""What a perturbation added to a movement: isolation of the deviation, one method a file, and the table of methods."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
