"""The commands that fit models: `fit`, `fit-many` and `demo`, their options, workers and progress display."""
