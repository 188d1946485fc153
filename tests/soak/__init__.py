"""Long trials of the whole package, by part; see `python -m tests.soak --help`."""
