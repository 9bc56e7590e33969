"""Motions that excite a model, found by gradient within limits."""
