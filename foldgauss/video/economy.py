"""Only what the scene requires: what of a fit's Gaussians is worth its bits, and what is dropped.

A number that is stored has a price in bits; it must save at least as many in the residual. That is the description
length of a two-part code (Rissanen 1978): bits of the parameters, and of the residual given them, which for n samples
of normal errors are n / 2 log2(squared error) and a constant.
"""

import dataclasses
import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float32, Int

from foldgauss._checks import invalid, whole, within
from foldgauss.video.ledger import Ledger
from foldgauss.video.model import LASTING
from foldgauss.video.packing import columns
from foldgauss.video.quantise import moved_to

#: Numbers of a Gaussian that lasts and stands still, and of one that comes and goes: m_t and sigma_t.
NUMBERS, OF_TIME = 9, 2
#: Squared error of rounding to 8 bits: no residual is taken to be finer.
ROUNDING = 1 / (12 * 255.0**2)


@dataclasses.dataclass(frozen=True)
class Economy:
    """What a fit pays for: at `rounds` points of its plan, evenly from `first_share` to `last_share`, it takes stock.

    * Without `psnr`: a Gaussian, a power of its path, an end of its life stay if they save more than `bits` for each of
      their numbers. (Compact files hold a number in 8 bits on the average.)
    * With `psnr`, dB: what is dropped is what costs the least, until the mean PSNR over all frames is that.

    A round drops at most a `most_dropped` share of the Gaussians: the others take over what is missed.
    Raises ValueError for numbers out of range.
    """

    psnr: float | None = None
    bits: float = 8.0
    rounds: int = 4
    first_share: float = 0.3
    last_share: float = 0.85
    most_dropped: float = 0.3

    def __post_init__(self) -> None:
        bounds = {
            "bits": "(0, inf)",
            "first_share": "(0, 1)",
            "last_share": "(0, 1)",
            "most_dropped": "(0, 1]",
        }
        if self.psnr is not None:
            bounds["psnr"] = "(0, 100]"
        for name, interval in bounds.items():
            if not within(getattr(self, name), interval):
                raise invalid(f"economy.{name}", expected=f"a number in {interval}", got=repr(getattr(self, name)))
        if not whole(self.rounds, 1):
            raise invalid("economy.rounds", expected="a whole number >= 1", got=repr(self.rounds))
        if self.first_share > self.last_share:
            got = f"{self.first_share:g} and {self.last_share:g}"
            raise invalid("economy.first_share, last_share", expected="in this order", got=got)

    def round_at(self, step: int, plan: int) -> int | None:
        """Which round is due after `step` of `plan` steps; None where none is."""
        shares = np.linspace(self.first_share, self.last_share, self.rounds)
        due = np.flatnonzero(np.maximum(np.rint(shares * plan), 1) == step)
        return int(due[-1]) if len(due) else None


class Cut(NamedTuple):
    """What stays: indices of rows in order, those rows anew, and their kinds."""

    stay: Int[np.ndarray, "left"]
    rows: Float32[np.ndarray, "left width"]
    kinds: np.ndarray
    added: float  # squared error, as foretold


def kinds_of(rows: Float32[np.ndarray, "num width"], degree: int) -> np.ndarray:
    """uint8 (num,): the number of the last power that a packed row has, and 128 more for one that lasts."""
    at, num = columns(degree), len(rows)
    there = (rows[:, at["coefficients"]].reshape(num, degree, 2) != 0).any(2)
    last = np.max(there * np.arange(1, degree + 1), axis=1, initial=0)
    return (last + 128 * lasting(rows, degree)).astype(np.uint8)


def lasting(rows: Float32[np.ndarray, "num width"], degree: int) -> np.ndarray:
    """bool (num,)"""
    at = columns(degree)
    return (rows[:, at["log_time_scale"].start] == LASTING) & (rows[:, at["time_loc_logit"].start] == 0)


def forget(first: np.ndarray, second: np.ndarray, kinds: np.ndarray, degree: int) -> None:
    """Adam's moments of numbers that a kind does not have become 0, in place."""
    at = columns(degree)
    powers = np.repeat(np.arange(1, degree + 1), 2)
    gone = powers > (kinds & 127)[:, None]
    for moments in (first, second):
        moments[:, at["coefficients"]][gone] = 0
        for name in ("time_loc_logit", "log_time_scale"):
            moments[kinds >= 128, at[name].start] = 0


def price_of(ledger: Ledger, economy: Economy) -> float:
    """The squared error that a number has to save: its bits, at d(n / 2 log2 e) / de = n / (2 e ln 2)."""
    return economy.bits * 2 * math.log(2) * max(ledger.mean_squared_error, ROUNDING)


def cut(
    rows: Float32[np.ndarray, "num width"],
    kinds: Int[np.ndarray, "num"],
    ledger: Ledger,
    economy: Economy,
    *,
    degree: int,
    pixels: float,
    room: float | None = None,
) -> Cut:
    """What is left of packed rows of `kinds` (degree, + 128 for those that last), by what `ledger` says.

    At a price of `price_of`, or where `room` is given, at the one that adds so much squared error. `pixels`: those along
    a unit of model space. One Gaussian at least is left.
    """
    book = _Book(rows, kinds, ledger, degree, pixels)
    if room is None:
        return book.at(price_of(ledger, economy), economy.most_dropped)
    low, high = 0.0, 1.0
    while book.at(high, economy.most_dropped).added < room and high < 1e9:
        high *= 4
    for _ in range(30):
        middle = (low + high) / 2
        low, high = (middle, high) if book.at(middle, economy.most_dropped).added <= room else (low, middle)
    return book.at(low, economy.most_dropped)


class _Book:
    """All that may be done to each Gaussian, with what it adds to the squared error and the numbers left."""

    def __init__(self, rows: np.ndarray, kinds: np.ndarray, ledger: Ledger, degree: int, pixels: float):
        self._rows, self._kinds, self._ledger, self._degree, self._pixels = rows, kinds, ledger, degree, pixels
        self._at = columns(degree)
        own, lasts = kinds & 127, kinds >= 128
        num = len(rows)
        place = np.concatenate([rows[:, self._at["loc"]], rows[:, self._at["coefficients"]]], 1)
        self._place = place.reshape(num, degree + 1, 2).astype(float) * pixels
        self._added = np.full((num, degree + 1, 2), np.inf)
        for lower in range(degree + 1):
            which = np.flatnonzero(own > lower)
            if len(which):
                self._added[which, lower, 0] = ledger.lower(self._place, lower, which)[0]
            self._added[own == lower, lower, 0] = 0
        self._added[:, :, 1] = self._added[:, :, 0] + ledger.lasting[:, None]
        self._added[lasts, :, 1], self._added[lasts, :, 0] = self._added[lasts, :, 0], np.inf
        self._numbers = NUMBERS + 2 * np.arange(degree + 1)[:, None] + OF_TIME * np.array([1, 0])

    def at(self, price: float, most_dropped: float) -> Cut:
        """The cheapest at a price of a number, in squared error."""
        num, removed = len(self._rows), self._ledger.removed
        costs = (self._added + price * self._numbers).reshape(num, -1)
        best = np.argmin(costs, 1)
        gain = costs[np.arange(num), best] - removed  # of leaving it out
        out = np.flatnonzero(gain > 0)
        most = min(int(most_dropped * num), num - 1)
        if len(out) > most:
            out = out[np.argsort(-gain[out], kind="stable")[:most]]
        stays = np.ones(num, bool)
        stays[out] = False
        stay = np.flatnonzero(stays)
        lower, lasts = np.divmod(best[stay], 2)
        added = removed[out].sum() + self._added.reshape(num, -1)[stay, best[stay]].sum()
        return Cut(stay, self._changed(stay, lower, lasts == 1), (lower + 128 * lasts).astype(np.uint8), float(added))

    def _changed(self, stay: np.ndarray, lower: np.ndarray, lasts: np.ndarray) -> np.ndarray:
        rows, own = self._rows[stay].copy(), self._kinds[stay]
        place = self._place[stay]
        for degree in range(self._degree):
            here = np.flatnonzero((lower == degree) & (own & 127 > degree))
            if len(here):
                place[here] = self._ledger.lower(self._place, degree, stay[here])[1]
        at = self._at
        now = np.flatnonzero(lasts & (own < 128))
        if len(now):
            logit = rows[now, at["time_loc_logit"].start].astype(float)
            place[now] = moved_to(place[now], 0.5 - 1 / (1 + np.exp(-logit)))
            rows[now, at["log_scale"]] += self._ledger.mean_log_envelope[stay[now], None].astype(np.float32)
            rows[now, at["time_loc_logit"].start], rows[now, at["log_time_scale"].start] = 0, LASTING
        moved = np.flatnonzero((lower < own & 127) | (lasts & (own < 128)))
        place = (place[moved] / self._pixels).astype(np.float32)
        rows[moved, at["loc"]] = place[:, 0]
        rows[moved, at["coefficients"]] = place[:, 1:].reshape(len(moved), 2 * self._degree)
        return rows
