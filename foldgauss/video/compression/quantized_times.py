"""Frame times of compact files: their logits as integers."""

import numpy as np
from jaxtyping import Float, Int32

#: Frame times are rounded to a fraction of 2^-TIME_BITS of each interval,
TIME_BITS = 10
#: or finer, with at most so many bits,
MAX_TIME_BITS = 24
#: so that no frame moves by more than this fraction of the median interval: the interval of a cut is some hundred
#: frames long.
TIME_ERROR = 0.005


def choose_time_bits(logits: Float[np.ndarray, " intervals"]) -> int:
    """The fewest bits from `TIME_BITS` on with which rounding moves no frame by more than `TIME_ERROR` intervals."""
    if not len(logits):
        return TIME_BITS
    logits = logits - logits.max()
    median = np.median(np.exp(logits))
    for bits in range(TIME_BITS, MAX_TIME_BITS):
        moved = np.cumsum(np.exp(round_times(logits, bits) * 2.0**-bits) - np.exp(logits))
        moved -= moved[-1] * np.cumsum(np.exp(logits)) / np.exp(logits).sum()  # they end at 1
        if np.abs(moved).max() <= TIME_ERROR * median:
            return bits
    return MAX_TIME_BITS


def round_times(
    logits: Float[np.ndarray, " intervals"], bits: int, largest: int = 2**30 - 1
) -> Int32[np.ndarray, " intervals"]:
    """Integers of logits up to 0; those of intervals that are 0 in float64 are limited to -`largest`."""
    return np.rint(np.maximum(logits, -1e5) * 2.0**bits).astype(np.int64).clip(-largest).astype(np.int32)
