"""How fast learning is, and against what: `python -m benchmarks.benchmark --help`."""
