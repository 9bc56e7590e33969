"""What is identified: pure regressors with parameter names and units. `a + b` stacks, `combine(a, b)` merges."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
