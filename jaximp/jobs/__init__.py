"""Job files: the only part that knows TOML."""
