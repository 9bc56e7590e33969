"""HTML reports and tables of results."""
