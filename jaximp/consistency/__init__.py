"""Real bodies only: robots whose links have mass and inertia as bodies can, and what data leave open among them."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
