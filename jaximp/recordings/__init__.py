"""Recordings: files of many kinds, columns and units, a uniform grid in time."""
