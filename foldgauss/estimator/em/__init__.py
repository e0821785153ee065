"""Expectation maximisation of mixtures, on arrays: `loop` drives it, `statistics` and `updates` are its two halves."""
