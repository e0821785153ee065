"""The fit: `loop.fit` drives a stepper over the frames; configuration, state, schedule and pruning beside it."""
