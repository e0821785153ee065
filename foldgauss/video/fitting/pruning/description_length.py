"""Pruning by minimum description length: which Gaussians and parameters save more bits than they cost.

A stored parameter costs bits and must save as many in the residual. This is the description length of a two-part code
(Rissanen 1978): bits of the parameters, and of the residual given them, which for n independent errors of one variance
are n / 2 log2(squared error) plus a constant.
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

#: The dB that decaying learning rates and recovery from pruning gain over the whole plan: a round aims so much lower;
#: and so much higher, as a margin at the end.
REMAINING_GAIN, MARGIN = 0.8, 0.1
#: The squared error decreases by so many dB in the later part of a whole plan, without pruning. (Bunny 80x160, 20,000
#: Gaussians: 5.4 from 0.3 of the plan on.)
ERROR_DECREASE = 7.0
#: Doubling the Gaussians gains so many dB (Bunny 160x320, degree 1: 4,000 28.7, 7,000 30.2).
DOUBLING_GAIN = 1.9
#: Without a PSNR: births in a round of the first half, as a fraction of the Gaussians; they continue while at least
#: half of the previous ones stay.
BIRTH_FRACTION = 0.5
#: The dB that a round gives up at most: estimates to second order are valid for small changes only.
MAX_LOSS_PER_ROUND = 3.0
#: The fraction of the Gaussians that a round makes opaque at most: what is behind one depends on the others, and the
#: scores tell what each costs alone.
MAX_OPAQUE_FRACTION = 0.25
#: The weights of frames differ by at most this factor from their geometric mean: 6 dB.
_MAX_WEIGHT_RATIO = 4.0


def count_births(
    economy: Economy, scores: PruningScores, psnr: float, progress: float, num: int, survived: float
) -> int:
    """How many Gaussians are born to `num`; `survived` is the fraction of the previous newborns that were not pruned.

    `psnr` is the one reached now, in dB.
    """
    if scores.squared_error <= ROUNDING * scores.num_samples:  # invisible after rounding to 8 bits
        return 0
    if economy.psnr is None:
        return round(BIRTH_FRACTION * num) if economy.grows and survived >= 0.5 else 0
    missing = _round_target(economy, progress) - psnr
    return round(num * (2 ** min(missing / DOUBLING_GAIN, 1.0) - 1)) if missing > 0 else 0


def allowed_error(economy: Economy, scores: PruningScores, psnr: float, progress: float) -> float | None:
    """The squared error that a round may add at the PSNR reached now, in dB; None where the price decides."""
    if economy.psnr is None:
        return None
    return scores.squared_error * (10 ** (min(psnr - _round_target(economy, progress), MAX_LOSS_PER_ROUND) / 10) - 1)


def _round_target(economy: Economy, progress: float) -> float:
    """The PSNR in dB that a round aims at: the remaining steps improve it further."""
    return economy.psnr + MARGIN - REMAINING_GAIN * (1 - progress)


def weigh_frames(errors: Float32[np.ndarray, " num_frames"]) -> Float[np.ndarray, " num_frames"]:
    """The weights of the frames' squared errors where their mean PSNR is optimized; 1 on average.

    Each dB of each frame counts the same, so an error is weighted by the inverse of the present one: within
    `_MAX_WEIGHT_RATIO` of the geometric mean, since frames that are nearly exact would outweigh all others. Errors of 0
    are not known yet.
    """
    known = errors > 0
    if not known.any():
        return np.ones(len(errors))
    typical = np.exp(np.log(errors[known], dtype=float).mean())
    inverse = 1 / np.clip(np.where(known, errors, typical), typical / _MAX_WEIGHT_RATIO, typical * _MAX_WEIGHT_RATIO)
    return inverse / inverse.mean()


# ------------------------------------------------------------------------------------------ pruning


class PrunedRows(NamedTuple):
    """The Gaussians that stay: indices of rows, in order; their new rows and kinds.

    `added`: the predicted increase of the squared error; `price`: what a parameter had to save.
    """

    stay: Int[np.ndarray, " left"]
    rows: Float32[np.ndarray, "left width"]
    kinds: UInt8[np.ndarray, " left"]
    added: float
    price: float


def compute_price(scores: PruningScores, bits: float, progress: float) -> float:
    """The squared error that a parameter has to save: its bits, at d(n / 2 log2 e) / de = n / (2 e ln 2).

    The error is that expected at the end of the fit, `progress` being the fraction of the plan that is done.
    """
    error = scores.squared_error * 10 ** (-ERROR_DECREASE * (1 - progress) / 10)
    error = max(error, ROUNDING * scores.num_samples)
    return bits * 2 * math.log(2) * error / scores.effective_samples


def prune_rows(
    rows: Float32[np.ndarray, "num width"],
    kinds: UInt8[np.ndarray, " num"],
    scores: PruningScores,
    economy: Economy,
    *,
    degree: int,
    pixels: float,
    max_added_error: float | None = None,
    progress: float = 1.0,
    shares_sizes: bool = False,
    allow_opaque: bool = True,
) -> PrunedRows:
    """Drop the Gaussians and parameters of packed rows that do not pay, at a fraction `progress` of the plan.

    At the price of `compute_price`; or where `max_added_error` is given, at the one that adds so much squared error.
    `pixels` is the number of pixels along one unit of model space. With `shares_sizes`, where Gaussians share shapes,
    sizes do not change; without `allow_opaque`, all keep their opacities. At least one Gaussian stays.
    """
    table = _CostTable(rows, kinds, scores, degree, pixels, shares_sizes, allow_opaque)
    if max_added_error is None:
        return table.prune(compute_price(scores, economy.bits, progress), economy.most_dropped)
    low, high = 0.0, max(scores.squared_error, 1e-9)
    for _ in range(40):
        middle = (low + high) / 2 if low > 0 else high / 2
        low, high = (middle, high) if table.added(middle, economy.most_dropped) <= max_added_error else (low, middle)
        if low > 0 and high < 1.01 * low:
            break
    return table.prune(low, economy.most_dropped)


class _CostTable:
    """For each Gaussian and each simpler form of it: the squared error that it adds, and its number of parameters."""

    def __init__(
        self,
        rows: np.ndarray,
        kinds: np.ndarray,
        scores: PruningScores,
        degree: int,
        pixels: float,
        shares_sizes: bool,
        allow_opaque: bool,
    ):
        self._rows, self._kinds, self._scores, self._degree, self._pixels = rows, kinds, scores, degree, pixels
        self._log_growth = np.zeros(len(rows)) if shares_sizes else scores.mean_log_envelope
        self._at, num = columns(degree), len(rows)
        own, static = get_degrees(kinds), is_static(kinds)
        place = np.concatenate([rows[:, self._at["loc"]], rows[:, self._at["coefficients"]]], 1)
        self._place = place.reshape(num, degree + 1, 2).astype(float) * pixels
        added = np.full((num, degree + 1, 2, 2), np.inf)  # by degree, static, opaque
        for lower in range(degree + 1):
            which = np.flatnonzero(own > lower)
            if len(which):
                added[which, lower, 0, 0] = scores.lower_degree(self._place, lower, which)[0]
            added[own == lower, lower, 0, 0] = 0
        added[:, :, 1, 0] = added[:, :, 0, 0] + scores.added_by_static(self._log_growth)[:, None]
        added[static, :, 1], added[static, :, 0] = added[static, :, 0], np.inf
        opacity = 1 / (1 + np.exp(-rows[:, self._at["opacity_logit"].start].astype(float)))
        by_opaque = scores.added_by_opaque(opacity)[:, None, None] if allow_opaque else np.inf
        added[:, :, :, 1] = added[:, :, :, 0] + by_opaque
        self._opaque = is_opaque(kinds)
        added[self._opaque, :, :, 1], added[self._opaque, :, :, 0] = added[self._opaque, :, :, 0], np.inf
        powers = POWER_PARAMETERS * np.arange(degree + 1)[:, None, None]
        saved = TIME_PARAMETERS * np.array([0, 1])[:, None] + OPACITY_PARAMETERS * np.array([0, 1])
        self._added, self._num_parameters = added.reshape(num, -1), (BASE_PARAMETERS + powers - saved).ravel()

    def _choose(self, price: float, most_dropped: float) -> tuple[np.ndarray, np.ndarray, float]:
        """Which Gaussians stay, the best form of each, and the squared error that both add."""
        num, removed = len(self._rows), self._scores.added_by_removal
        costs = self._added + price * self._num_parameters
        best = np.argmin(costs, 1)
        gain = costs[np.arange(num), best] - removed  # by removing it
        out = np.flatnonzero(gain > 0)
        most = min(math.ceil(most_dropped * num), num - 1)
        if len(out) > most:
            out = out[np.argsort(-gain[out], kind="stable")[:most]]
        stays = np.ones(num, bool)
        stays[out] = False
        best = self._limit_opaque(best, stays)
        return stays, best, float(removed[out].sum() + self._added[stays, best[stays]].sum())

    def _limit_opaque(self, best: np.ndarray, stays: np.ndarray) -> np.ndarray:
        """The best forms where at most `MAX_OPAQUE_FRACTION` become opaque: those with the lowest cost of it."""
        which = np.flatnonzero(stays & (best % 2 == 1) & ~self._opaque)
        most = math.ceil(MAX_OPAQUE_FRACTION * len(self._rows))
        if len(which) > most:
            cost = self._added[which, best[which]] - self._added[which, best[which] - 1]
            best[which[np.argsort(cost, kind="stable")[most:]]] -= 1  # the same form, but not opaque
        return best

    def added(self, price: float, most_dropped: float) -> float:
        """The squared error that pruning at this price adds."""
        return self._choose(price, most_dropped)[2]

    def prune(self, price: float, most_dropped: float) -> PrunedRows:
        """The forms of lowest cost at a price of a parameter, in squared error."""
        stays, best, added = self._choose(price, most_dropped)
        stay = np.flatnonzero(stays)
        lower, static, opaque = np.unravel_index(best[stay], (self._degree + 1, 2, 2))
        kinds = (lower + STATIC_BIT * static + OPAQUE_BIT * opaque).astype(np.uint8)
        return PrunedRows(stay, self._simplify(stay, lower, static == 1, opaque == 1), kinds, added, price)

    def _simplify(self, stay: np.ndarray, lower: np.ndarray, static: np.ndarray, opaque: np.ndarray) -> np.ndarray:
        """The rows `stay` in their new forms."""
        rows, own, at = self._rows[stay].copy(), get_degrees(self._kinds[stay]), self._at
        place, now = self._place[stay], static & ~is_static(self._kinds[stay])
        for degree in range(self._degree):
            here = np.flatnonzero((lower == degree) & (own > degree))
            if len(here):
                place[here] = self._scores.lower_degree(self._place, degree, stay[here])[1]
        logit = rows[now, at["time_loc_logit"].start].astype(float)
        place[now] = shift_path(place[now], 0.5 - 1 / (1 + np.exp(-logit)))
        rows[now, at["log_scale"]] += self._log_growth[stay[now], None].astype(np.float32)
        rows[now, at["time_loc_logit"].start], rows[now, at["log_time_scale"].start] = 0, STATIC_LOG_TIME_SCALE
        rows[opaque, at["opacity_logit"].start] = OPAQUE_LOGIT
        moved = now | (lower < own)
        anew = (place[moved] / self._pixels).astype(np.float32)
        rows[moved, at["loc"]] = anew[:, 0]
        rows[moved, at["coefficients"]] = anew[:, 1:].reshape(len(anew), 2 * self._degree)
        return rows
