"""Least squares in one window, in all windows, adaptive and recursive; noise that is not white."""
