"""Benchmarks: `python -m benchmarks.NAME [--json FILE]`, from the repository's root.

Each prints a table and, with `--json`, writes {"figures": {name: number}, ...}. What is measured, and how,
stands in the docstring of each module. Timings mean something on a quiet machine only.
"""
