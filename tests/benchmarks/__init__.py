"""Benchmarks: each runs as `python -m tests.benchmarks.<name>`."""
