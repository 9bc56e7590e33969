"""What the papers show, redone with this package; one module a paper."""
