"""Independent random generators, one for each use of a seed."""

import enum

import numpy as np


@enum.unique
class Stream(enum.IntEnum):
    """The uses of random numbers. Each has its own stream, so that none repeats the draws of another.

    A value is part of the results: a new use takes the next value, and none is used again.
    """

    INITIALIZATION = 0
    FRAME_ORDER = 1
    SPLIT = 2  #: halves of Gaussians that densification splits
    BIRTH = 3
    BACKGROUND = 6
    INTERPOLATED_FRAME = 7
    ERROR_WEIGHTED_FRAME = 8
    TRACK = 12
    ROUNDING_ORDER = 13
    SENSITIVITY_PROBE = 14
    SKETCH = 16
    REFIT = 18
    RESAMPLED_FRAME = 19
    WALKERS = 20
    POSTERIOR_DRAW = 21
    EM_JITTER = 25
    SYNTHETIC_NOISE = 27


def seed_sequence(stream: Stream, *place: int, seed: int = 0) -> np.random.SeedSequence:
    """The seed of `stream` for a user's `seed`, at a `place` in it: a step, or a step and a frame.

    Sequences of different streams, places or seeds (below 2^128) are independent. **Source:** `spawn_key` of NumPy.
    """
    return np.random.SeedSequence(seed, spawn_key=(stream, *place))


def make_generator(stream: Stream, *place: int, seed: int = 0) -> np.random.Generator:
    """A generator for `seed_sequence`."""
    return np.random.default_rng(seed_sequence(stream, *place, seed=seed))
