"""Which estimates to believe, and why not."""
