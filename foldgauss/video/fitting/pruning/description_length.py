"""Only what the scene requires: what of a fit's Gaussians is worth its bits; the rest is dropped.

A number that is stored has a price in bits and must save as many in the residual. That is the description length of a
two-part code (Rissanen 1978): bits of the parameters, and of the residual given them, which for n independent errors
of one variance are n / 2 log2(squared error) and a constant.
"""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Float32, Int, UInt8

from foldgauss.video.fitting.economy import Economy
from foldgauss.video.fitting.pruning.scores import ROUNDING, PruningScores
from foldgauss.video.models.row_layout import columns, shift_path
from foldgauss.video.models.sparse_storage import (
    BASE_PARAMETERS,
    OPACITY_PARAMETERS,
    OPAQUE_BIT,
    POWER_PARAMETERS,
    STATIC_BIT,
    TIME_PARAMETERS,
    get_degrees,
    is_opaque,
    is_static,
)
from foldgauss.video.models.splats import OPAQUE_LOGIT, STATIC_LOG_TIME_SCALE

#: What a fit gains by falling rates, and makes up for what was dropped, in dB over the whole plan: a round aims so much
#: lower; and so much higher, in dB, that the end is not missed by a hair.
YET_TO_COME, SPARE = 0.8, 0.1
#: The squared error falls by so many dB in a whole plan's later part, where nothing is dropped. (Bunny 80x160, 20,000
#: Gaussians: 5.4 from 0.3 of the plan on.)
FALLS = 7.0
#: Doubling the Gaussians brings so many dB (Bunny 160x320, degree 1: 4,000 28.7, 7,000 30.2).
DOUBLING = 1.9
#: Of the Gaussians, in the first half of the rounds, without a PSNR: births; they go on while at least half of the last
#: ones stay.
BIRTHS = 0.5
#: dB that a round gives up at most: farther away estimates to second order tell little.
MOST_AT_ONCE = 3.0
#: Of the Gaussians, those that light no longer comes through after a round: what is behind one depends on the others,
#: and the ledger tells what each costs alone.
MOST_SOLID = 0.25
#: Frames' errors differ by this factor from their geometric mean, as far as it counts: 6 dB.
_UNLIKE = 4.0


def count_births(
    economy: Economy, ledger: PruningScores, psnr: float, progress: float, num: int, survived: float
) -> int:
    """How many Gaussians are born to `num`; `survived` is the fraction of the previous newborns that were not pruned.

    `psnr` is the one reached now, in dB.
    """
    if ledger.squared_error <= ROUNDING * ledger.num_samples:  # below the rounding to 8 bits
        return 0
    if economy.psnr is None:
        return round(BIRTHS * num) if economy.grows and survived >= 0.5 else 0
    missing = _round_target(economy, progress) - psnr
    return round(num * (2 ** min(missing / DOUBLING, 1.0) - 1)) if missing > 0 else 0


def allowed_error(economy: Economy, ledger: PruningScores, psnr: float, progress: float) -> float | None:
    """The squared error that a round may add at the PSNR reached now, in dB; None where the price decides."""
    if economy.psnr is None:
        return None
    return ledger.squared_error * (10 ** (min(psnr - _round_target(economy, progress), MOST_AT_ONCE) / 10) - 1)


def _round_target(economy: Economy, progress: float) -> float:
    """The PSNR in dB that a round aims at: the remaining steps improve it further."""
    return economy.psnr + SPARE - YET_TO_COME * (1 - progress)


def frame_weights(errors: Float32[np.ndarray, " num_frames"]) -> Float[np.ndarray, " num_frames"]:
    """What a frame's squared error counts where the mean of the frames' PSNR is what is asked for; 1 on the average.

    A dB of each frame is worth the same, so an error counts by the inverse of what there is: held within `_UNLIKE` of
    the geometric mean, lest frames that are nearly exact outweigh all others. Errors of 0 are not known yet.
    """
    known = errors > 0
    if not known.any():
        return np.ones(len(errors))
    typical = np.exp(np.log(errors[known], dtype=float).mean())
    inverse = 1 / np.clip(np.where(known, errors, typical), typical / _UNLIKE, typical * _UNLIKE)
    return inverse / inverse.mean()


# ------------------------------------------------------------------------------------------ what is dropped


class Cut(NamedTuple):
    """What stays: indices of rows, in order; those rows anew, and their kinds.

    `added`: squared error, as foretold; `price`: what a number had to save.
    """

    stay: Int[np.ndarray, " left"]
    rows: Float32[np.ndarray, "left width"]
    kinds: UInt8[np.ndarray, " left"]
    added: float
    price: float


def price_of(ledger: PruningScores, bits: float, progress: float = 1.0) -> float:
    """The squared error that a number has to save: its bits, at d(n / 2 log2 e) / de = n / (2 e ln 2).

    The error is that of the fit's end, by what is usual at a share `progress` of its plan.
    """
    error = ledger.squared_error * 10 ** (-FALLS * (1 - progress) / 10)
    error = max(error, ROUNDING * ledger.num_samples)
    return bits * 2 * math.log(2) * error / ledger.effective_samples


def cut(
    rows: Float32[np.ndarray, "num width"],
    kinds: UInt8[np.ndarray, " num"],
    ledger: PruningScores,
    economy: Economy,
    *,
    degree: int,
    pixels: float,
    room: float | None = None,
    progress: float = 1.0,
    sized: bool = False,
    solid: bool = True,
) -> Cut:
    """What is left of packed rows, by what `ledger` says of them at a share `progress` of the plan.

    At the price of `price_of`; or where `room` is given, at the one that adds so much squared error. `pixels`: those
    along a unit of model space. Where Gaussians are `sized`, by shapes that they share, sizes stay as they are;
    without `solid`, all keep their opacities. At least one Gaussian is left.
    """
    book = _Book(rows, kinds, ledger, degree, pixels, sized, solid)
    if room is None:
        return book.at(price_of(ledger, economy.bits, progress), economy.most_dropped)
    low, high = 0.0, max(ledger.squared_error, 1e-9)
    for _ in range(40):
        middle = (low + high) / 2 if low > 0 else high / 2
        low, high = (middle, high) if book.added(middle, economy.most_dropped) <= room else (low, middle)
        if low > 0 and high < 1.01 * low:
            break
    return book.at(low, economy.most_dropped)


class _Book:
    """All that may be done to each Gaussian, with the squared error that it adds and the numbers that it leaves."""

    def __init__(
        self,
        rows: np.ndarray,
        kinds: np.ndarray,
        ledger: PruningScores,
        degree: int,
        pixels: float,
        sized: bool = False,
        solid: bool = True,
    ):
        self._rows, self._kinds, self._ledger, self._degree, self._pixels = rows, kinds, ledger, degree, pixels
        self._grown = np.zeros(len(rows)) if sized else ledger.mean_log_envelope
        self._at, num = columns(degree), len(rows)
        own, lasting = get_degrees(kinds), is_static(kinds)
        place = np.concatenate([rows[:, self._at["loc"]], rows[:, self._at["coefficients"]]], 1)
        self._place = place.reshape(num, degree + 1, 2).astype(float) * pixels
        added = np.full((num, degree + 1, 2, 2), np.inf)  # by degree, whether it is static, whether it is opaque
        for lower in range(degree + 1):
            which = np.flatnonzero(own > lower)
            if len(which):
                added[which, lower, 0, 0] = ledger.lower(self._place, lower, which)[0]
            added[own == lower, lower, 0, 0] = 0
        added[:, :, 1, 0] = added[:, :, 0, 0] + ledger.lasting(self._grown)[:, None]
        added[lasting, :, 1], added[lasting, :, 0] = added[lasting, :, 0], np.inf
        opacity = 1 / (1 + np.exp(-rows[:, self._at["opacity_logit"].start].astype(float)))
        added[:, :, :, 1] = added[:, :, :, 0] + (ledger.solid(opacity)[:, None, None] if solid else np.inf)
        self._solid = is_opaque(kinds)
        added[self._solid, :, :, 1], added[self._solid, :, :, 0] = added[self._solid, :, :, 0], np.inf
        powers = POWER_PARAMETERS * np.arange(degree + 1)[:, None, None]
        numbers = (
            BASE_PARAMETERS
            + powers
            - TIME_PARAMETERS * np.array([0, 1])[:, None]
            - OPACITY_PARAMETERS * np.array([0, 1])
        )
        self._added, self._numbers = added.reshape(num, -1), numbers.ravel()

    def _chosen(self, price: float, most_dropped: float) -> tuple[np.ndarray, np.ndarray, float]:
        """Who stays, the best for each, and the squared error that both add."""
        num, removed = len(self._rows), self._ledger.removed
        costs = self._added + price * self._numbers
        best = np.argmin(costs, 1)
        gain = costs[np.arange(num), best] - removed  # by leaving it out
        out = np.flatnonzero(gain > 0)
        most = min(math.ceil(most_dropped * num), num - 1)
        if len(out) > most:
            out = out[np.argsort(-gain[out], kind="stable")[:most]]
        stays = np.ones(num, bool)
        stays[out] = False
        best = self._few_solid(best, stays)
        return stays, best, float(removed[out].sum() + self._added[stays, best[stays]].sum())

    def _few_solid(self, best: np.ndarray, stays: np.ndarray) -> np.ndarray:
        """What is best for each, where no more than `MOST_SOLID` become solid: those whom it costs least."""
        which = np.flatnonzero(stays & (best % 2 == 1) & ~self._solid)
        most = math.ceil(MOST_SOLID * len(self._rows))
        if len(which) > most:
            cost = self._added[which, best[which]] - self._added[which, best[which] - 1]
            best[which[np.argsort(cost, kind="stable")[most:]]] -= 1  # the same, but clear
        return best

    def added(self, price: float, most_dropped: float) -> float:
        return self._chosen(price, most_dropped)[2]

    def at(self, price: float, most_dropped: float) -> Cut:
        """The cheapest at a price of a number, in squared error."""
        stays, best, added = self._chosen(price, most_dropped)
        stay = np.flatnonzero(stays)
        lower, lasting, solid = np.unravel_index(best[stay], (self._degree + 1, 2, 2))
        kinds = (lower + STATIC_BIT * lasting + OPAQUE_BIT * solid).astype(np.uint8)
        return Cut(stay, self._changed(stay, lower, lasting == 1, solid == 1), kinds, added, price)

    def _changed(self, stay: np.ndarray, lower: np.ndarray, lasting: np.ndarray, solid: np.ndarray) -> np.ndarray:
        rows, own, at = self._rows[stay].copy(), get_degrees(self._kinds[stay]), self._at
        place, now = self._place[stay], lasting & ~is_static(self._kinds[stay])
        for degree in range(self._degree):
            here = np.flatnonzero((lower == degree) & (own > degree))
            if len(here):
                place[here] = self._ledger.lower(self._place, degree, stay[here])[1]
        logit = rows[now, at["time_loc_logit"].start].astype(float)
        place[now] = shift_path(place[now], 0.5 - 1 / (1 + np.exp(-logit)))
        rows[now, at["log_scale"]] += self._grown[stay[now], None].astype(np.float32)
        rows[now, at["time_loc_logit"].start], rows[now, at["log_time_scale"].start] = 0, STATIC_LOG_TIME_SCALE
        rows[solid, at["opacity_logit"].start] = OPAQUE_LOGIT
        moved = now | (lower < own)
        anew = (place[moved] / self._pixels).astype(np.float32)
        rows[moved, at["loc"]] = anew[:, 0]
        rows[moved, at["coefficients"]] = anew[:, 1:].reshape(len(anew), 2 * self._degree)
        return rows
