"""The commands that measure: `tradeoff`, `uncertainty` and `doctor`, with the files that they write."""
