"""An adaptive binary range coder for columns of integers, with the same bits on every platform.

An integer becomes a zero flag, a sign and an exponential Golomb code of its magnitude. Flag, sign, exponent and the two
leading bits below it are coded with adaptive probabilities; further bits are nearly uniform and cost one bit each.
Each value has three contexts, small integers known to encoder and decoder. Their probabilities are mixed as logits with
adaptive weights. The third context is a prediction from nearby Gaussians, computed in float64 in a fixed order; all
else is integer arithmetic.

Source: G. N. N. Martin, "Range encoding" (1979); P. Elias' gamma code (1975), in exponential Golomb form; M. Mahoney,
"Adaptive weighing of context models for lossless data compression" (2005).
"""

from typing import NamedTuple

import numba as nb
import numpy as np
from jaxtyping import Bool, Float, Int32, UInt8

from foldgauss._runtime.kernels import exact_kernel

#: Magnitudes stay below 2^LARGEST_BITS.
LARGEST_BITS = 30
#: Probabilities of one context: zero flag, sign, unary exponent, and 1 + 2 for the leading bits of each exponent.
NODES = 2 + 32 + 3 * 32
#: Values of a context.
CONTEXTS = 256
#: Contexts of an integer.
MODELS = 3
#: Bound on the bytes of an integer's code: 2 + 31 + 30 bits of four bytes each.
MAX_CODE_BYTES = 256
#: A probability is the fraction of ones in up to this many bits, and then an exponential mean.
MEMORY = 400
#: Initial weights of the mixture, times 65536.
WEIGHT = 29491
#: Learning rate of the weights, times 2^18.
RATE = 6
#: Least distance of mixed probabilities from 0 and 1, times 65536.
MARGIN = 32
#: Logits are whole multiples of 1/256 from -8 to 8. Knots of the logistic function every half, and lines between them.
_KNOTS = [
    22, 36, 60, 98, 162, 267, 439, 720, 1179, 1921, 3108, 4971, 7812, 11955, 17625, 24743, 32768,
    40793, 47911, 53581, 57724, 60565, 62428, 63615, 64357, 64816, 65097, 65269, 65374, 65438, 65476, 65500, 65514,
]  # fmt: skip

_i = nb.int64


#: Probability times 65536 of the logit (place - 2048) / 256, to nearest; exact, as lines have steps of 1/128.
LOGISTIC = np.floor(np.interp(np.arange(4096), 128 * np.arange(33), _KNOTS) + 0.5).astype(np.int64)
#: Its inverse, for the upper 12 bits of a probability: the least logit that gives as much.
LOGIT = np.minimum(np.searchsorted(LOGISTIC, np.arange(4096) * 16 + 8), 4095) - 2048


class Column(NamedTuple):
    """What encoder and decoder know of a column before its values.

    `present`: which rows have an integer; others are 0. `contexts`: below 256. An integer q encodes the value
    `origin + q step`. A row's value is predicted by the mean over the rows `near` (-1: none) of value / `scale`, times
    its own scale. Absent rows count as 0.
    """

    present: Bool[np.ndarray, " num"]
    contexts: UInt8[np.ndarray, "num 2"]
    origin: Float[np.ndarray, " num"]
    step: Float[np.ndarray, " num"]
    scale: Float[np.ndarray, " num"]
    near: Int32[np.ndarray, "num neighbors"]

    @classmethod
    def without_contexts(cls, num: int) -> "Column":
        """A column without contexts."""
        one, none = np.ones(num), np.zeros((num, 0), np.int32)
        return cls(np.ones(num, bool), np.zeros((num, 2), np.uint8), np.zeros(num), one, one, none)


# ------------------------------------------------------------------------------------------ coding


@exact_kernel
def _predict_context(i, near, seen, origin, step, scale):
    """The context predicted from nearby rows: 0 without any, else 16 plus the signed class of magnitude."""
    total, count = 0.0, 0
    for k in range(near.shape[1]):
        if near[i, k] >= 0:
            total += seen[near[i, k]]
            count += 1
    if count == 0:
        return 0
    ratio = (total / count * scale[i] - origin[i]) / step[i]
    size, level, bound = abs(ratio), 0, 0.5
    while level < 15 and size >= bound:
        level += 1
        bound = 1.5 if level == 1 else 2 * bound
    return 16 + level if ratio >= 0 else 16 - level


@exact_kernel
def _code_bit(data, interval, decodes, p, bit):
    """Code a bit and return it; the interval is (low, high, the decoder's number in it, place of the next byte)."""
    span = interval[1] - interval[0]
    middle = interval[0] + (span >> 16) * p + (((span & 0xFFFF) * p) >> 16)  # a one, of probability p / 65536, is below
    if decodes:
        bit = interval[2] <= middle
    if bit:
        interval[1] = middle
    else:
        interval[0] = middle + 1
    while (interval[0] ^ interval[1]) & 0xFF000000 == 0:
        place = interval[3]
        if decodes:
            interval[2] = ((interval[2] << 8) & 0xFFFFFFFF) | _i(data[place])
        else:
            data[place] = interval[1] >> 24
        interval[0] = (interval[0] << 8) & 0xFFFFFFFF
        interval[1] = ((interval[1] << 8) & 0xFFFFFFFF) | 255
        interval[3] = place + 1
    return bit


@exact_kernel
def _code_adaptive(data, interval, decodes, state, node, bit):
    """Code a bit with the probability that its node's contexts `own` mix, and adapt these to the bit; returns it."""
    own, chances, weights, logits, logistic, logit = state
    total = 0
    for m in range(MODELS):
        logits[m] = logit[chances[m, own[m], node, 0] >> 4]
        total += logits[m] * weights[node, m]
    p = min(max(logistic[min(max(total >> 16, -2047), 2047) + 2048], MARGIN), 65536 - MARGIN)
    bit = _code_bit(data, interval, decodes, p, bit)
    error = (65536 if bit else 0) - p
    for m in range(MODELS):
        weights[node, m] += (logits[m] * error * RATE) >> 18
        chance = chances[m, own[m], node]
        if bit:
            chance[0] += (65536 - chance[0]) // chance[1]
        else:
            chance[0] -= chance[0] // chance[1]
        if chance[1] < MEMORY:
            chance[1] += 1
    return bit


@exact_kernel
def _code(values, present, contexts, origin, step, scale, near, state, data, interval, decodes, last_start):
    """Encode `values` into `data`, or, if `decodes`, decode `data` into `values`. Returns False on failure.

    Decoding fails for bytes that `encode` cannot have written. `last_start` is the last offset in `data` at which
    coding a value may begin; `MAX_CODE_BYTES` follow it. Both directions take the same steps: the decoder ignores the
    bits that are passed to `_code_adaptive`.
    """
    seen, own = np.zeros(len(values)), state[0]
    for k in range(len(values)):
        if not present[k]:
            continue
        if interval[3] > last_start:  # the offset of the next byte
            return False
        own[0], own[1] = contexts[k, 0], contexts[k, 1]
        own[2] = _predict_context(k, near, seen, origin, step, scale)
        value = _i(values[k])
        if not _code_adaptive(data, interval, decodes, state, 0, value == 0):
            negative = _code_adaptive(data, interval, decodes, state, 1, value < 0)
            magnitude, exponent = abs(value), 0
            while _code_adaptive(data, interval, decodes, state, 2 + exponent, magnitude >> (exponent + 1) > 0):
                exponent += 1
                if decodes and exponent >= LARGEST_BITS:
                    return False
            coded, leading = 1, 1
            for b in range(exponent - 1, -1, -1):
                bit = (magnitude >> b) & 1 == 1
                if leading < 4:
                    bit = _code_adaptive(data, interval, decodes, state, 34 + 3 * exponent + leading - 1, bit)
                    leading = 2 * leading + bit
                else:
                    bit = _code_bit(data, interval, decodes, 32768, bit)
                coded = 2 * coded + bit
            values[k] = -coded if negative else coded
        seen[k] = (origin[k] + values[k] * step[k]) / scale[k]
    return True


def encode(values: Int32[np.ndarray, " num"], column: Column) -> bytes:
    """The bytes of a column; magnitudes below 2^30."""
    values, last_start = np.array(values, np.int32), MAX_CODE_BYTES * len(values)
    data, interval = np.empty(last_start + MAX_CODE_BYTES, np.uint8), np.array([0, 0xFFFFFFFF, 0, 0])
    _code(values, *column, _initial_state(), data, interval, False, last_start)
    low, place = interval[0], interval[3]
    # The shortest bytes that identify the interval: zeros are read after the end.
    data[place] = (low >> 24) + (1 if low & 0xFFFFFF else 0)
    return data[: place + 1].tobytes()


def decode(data: bytes, column: Column) -> Int32[np.ndarray, " num"]:
    """The inverse of `encode`. Raises ValueError for bytes that it cannot have written."""
    padded = np.frombuffer(data + bytes(4 + MAX_CODE_BYTES), np.uint8).copy()
    values = np.zeros(len(column.present), np.int32)
    interval = np.array([0, 0xFFFFFFFF, int.from_bytes(data[:4].ljust(4, b"\0"), "big"), 4])
    fits = _code(values, *column, _initial_state(), padded, interval, True, len(data) + 4)
    if not fits or interval[3] != len(data) + 3:  # the encoder ends with one byte, the decoder reads four
        raise ValueError("a column of numbers is damaged")
    return values


def _initial_state() -> tuple[np.ndarray, ...]:
    """The state of `_code_adaptive`; chances are (probability of a one times 65536, bits seen + 2)."""
    chances = np.empty((MODELS, CONTEXTS, NODES, 2), np.int64)
    chances[..., 0], chances[..., 1] = 32768, 2
    weights = np.full((NODES, MODELS), WEIGHT, np.int64)
    return np.zeros(MODELS, np.int64), chances, weights, np.zeros(MODELS, np.int64), LOGISTIC, LOGIT
