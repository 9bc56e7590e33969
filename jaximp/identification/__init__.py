"""One recording: filters, rows, windows, methods 1 to 4, estimates with verdicts."""
