"""Columns of a file, as they are: one kind of file a module, and the table of them in `formats`."""
