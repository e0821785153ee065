"""Kinds of Gaussians: which numbers each has. A byte: its degree, and a bit for each thing that it does without."""

import numpy as np
from jaxtyping import Bool, Float32, Int, UInt8

from foldgauss.video.models.row_layout import columns
from foldgauss.video.models.splats import LASTING, OPAQUE

#: The bit of a kind that says: it is there throughout the clip; that says: no light comes through; and the degrees.
LASTS, SOLID, DEGREES = 128, 64, 63
#: Numbers of a Gaussian that has neither bit and degree 0; what each of the bits and each power saves or costs.
NUMBERS, OF_TIME, OF_OPACITY, OF_POWER = 11, 2, 1, 2


def degrees_of(kinds: UInt8[np.ndarray, " num"]) -> Int[np.ndarray, " num"]:
    """The last power that each has."""
    return (kinds & DEGREES).astype(int)


def lasts(kinds: UInt8[np.ndarray, " num"]) -> Bool[np.ndarray, " num"]:
    """Who has no m_t and sigma_t."""
    return (kinds & LASTS) > 0


def is_solid(kinds: UInt8[np.ndarray, " num"]) -> Bool[np.ndarray, " num"]:
    """Who has no opacity."""
    return (kinds & SOLID) > 0


def kinds_of(rows: Float32[np.ndarray, "num width"], degree: int) -> UInt8[np.ndarray, " num"]:
    """The kinds of packed rows, by what their numbers are."""
    at, num = columns(degree), len(rows)
    there = (rows[:, at["coefficients"]].reshape(num, degree, 2) != 0).any(2)
    last = np.max(there * np.arange(1, degree + 1), axis=1, initial=0)
    lasting = (rows[:, at["log_time_scale"].start] == LASTING) & (rows[:, at["time_loc_logit"].start] == 0)
    return (last + LASTS * lasting + SOLID * (rows[:, at["opacity_logit"].start] == OPAQUE)).astype(np.uint8)


def kinds_at_start(rows: Float32[np.ndarray, "num width"], degree: int) -> UInt8[np.ndarray, " num"]:
    """Kinds of rows that have not learned yet: all powers, but for those that last, which stand still."""
    kinds = kinds_of(rows, degree)
    return np.where(lasts(kinds), kinds, degree).astype(np.uint8)


def numbers_of(kinds: UInt8[np.ndarray, " num"]) -> int:
    """Those that Gaussians of these kinds have, each counted as if nothing were shared."""
    return int((NUMBERS + OF_POWER * degrees_of(kinds) - OF_TIME * lasts(kinds) - OF_OPACITY * is_solid(kinds)).sum())


def forget(first: np.ndarray, second: np.ndarray, kinds: UInt8[np.ndarray, " num"], degree: int) -> None:
    """Adam's moments of numbers that a kind does not have become 0, in place."""
    at = columns(degree)
    gone = np.repeat(np.arange(1, degree + 1), 2) > degrees_of(kinds)[:, None]
    for moments in (first, second):
        moments[:, at["coefficients"]][gone] = 0
        for name in ("time_loc_logit", "log_time_scale"):
            moments[lasts(kinds), at[name].start] = 0
        moments[is_solid(kinds), at["opacity_logit"].start] = 0
