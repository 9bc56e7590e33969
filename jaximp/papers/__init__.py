"""What the papers show, redone."""
