"""An adaptive binary range coder for columns of whole numbers: 32-bit integer arithmetic, the same bits everywhere.

A number becomes a zero flag, a sign and an exponential Golomb code of its magnitude. Flag, sign, exponent and the two
leading bits below it are coded with a probability each that learns from what came before, apart for each *context*, a
small number that both sides know; further bits are as good as random and cost one bit each.

Source: G. N. N. Martin, "Range encoding" (1979); P. Elias' gamma code (1975), in exponential Golomb form.
"""

import numba as nb
import numpy as np
from jaxtyping import Int32, UInt8

from foldgauss._kernels import inline, kernel

#: Magnitudes stay below 2^LARGEST_BITS.
LARGEST_BITS = 30
#: Probabilities of one context: zero flag, sign, unary exponent, and 1 + 2 for the leading bits of each exponent.
NODES = 2 + 32 + 3 * 32
#: Contexts of a column.
CONTEXTS = 32
#: Bytes that no number's code exceeds: 2 + 31 + 30 bits of four bytes each.
ROOM = 256
#: A probability is the share of ones so far, until so many bits were seen; from then on old ones are forgotten.
MEMORY = 400

_i = nb.int64


@inline
def _learn(states, node, bit):
    """A state is (probability of one times 65536, bits seen + 2)."""
    p, count = states[node, 0], states[node, 1]
    if bit:
        states[node, 0] = p + (65536 - p) // count
    else:
        states[node, 0] = p - p // count
    if count < MEMORY:
        states[node, 1] = count + 1


@inline
def _middle(low, high, p):
    """Where the interval is parted: below lie ones, of probability p / 65536."""
    span = high - low
    return low + (span >> 16) * p + (((span & 0xFFFF) * p) >> 16)


@kernel
def _put(out, place, interval, p, bit):
    middle = _middle(interval[0], interval[1], p)
    if bit:
        interval[1] = middle
    else:
        interval[0] = middle + 1
    while (interval[0] ^ interval[1]) & 0xFF000000 == 0:
        out[place] = interval[1] >> 24
        place += 1
        interval[0] = (interval[0] << 8) & 0xFFFFFFFF
        interval[1] = ((interval[1] << 8) & 0xFFFFFFFF) | 255
    return place


@kernel
def _put_learned(out, place, interval, states, node, bit):
    place = _put(out, place, interval, states[node, 0], bit)
    _learn(states, node, bit)
    return place


@kernel
def _encode(values, contexts, nodes, states, out):
    interval, place = np.zeros(2, np.int64), 0
    interval[1] = 0xFFFFFFFF
    for k in range(len(values)):
        if place + ROOM > len(out):
            return 0
        value, base = _i(values[k]), _i(contexts[k]) * nodes
        place = _put_learned(out, place, interval, states, base, value == 0)
        if value == 0:
            continue
        place = _put_learned(out, place, interval, states, base + 1, value < 0)
        magnitude, exponent = abs(value), 0
        while magnitude >> (exponent + 1):
            place = _put_learned(out, place, interval, states, base + 2 + exponent, True)
            exponent += 1
        place = _put_learned(out, place, interval, states, base + 2 + exponent, False)
        leading = 1
        for b in range(exponent - 1, -1, -1):
            bit = (magnitude >> b) & 1
            if leading < 4:
                node = base + 34 + 3 * exponent + leading - 1
                place = _put_learned(out, place, interval, states, node, bit == 1)
                leading = 2 * leading + bit
            else:
                place = _put(out, place, interval, 32768, bit == 1)
    # The shortest run of bytes that points into the interval whatever follows: zeros are read after the end.
    out[place] = (interval[0] >> 24) + (1 if interval[0] & 0xFFFFFF else 0)
    return place + 1


@kernel
def _get(data, state, p):
    """One bit; state is (low, high, code, next byte)."""
    middle = _middle(state[0], state[1], p)
    bit = state[2] <= middle
    if bit:
        state[1] = middle
    else:
        state[0] = middle + 1
    while (state[0] ^ state[1]) & 0xFF000000 == 0:
        state[0] = (state[0] << 8) & 0xFFFFFFFF
        state[1] = ((state[1] << 8) & 0xFFFFFFFF) | 255
        byte = _i(data[state[3]]) if state[3] < len(data) else 0
        state[2] = ((state[2] << 8) & 0xFFFFFFFF) | byte
        state[3] += 1
    return bit


@kernel
def _get_learned(data, state, states, node):
    bit = _get(data, state, states[node, 0])
    _learn(states, node, bit)
    return bit


@kernel
def _decode(data, contexts, nodes, most, states, values):
    """Whether the data is one that the encoder may have written."""
    state = np.zeros(4, np.int64)
    state[1] = 0xFFFFFFFF
    for k in range(4):
        state[2] = (state[2] << 8) | (_i(data[k]) if k < len(data) else 0)
    state[3] = 4
    for k in range(len(values)):
        if state[3] > len(data) + 4:
            return False
        base = _i(contexts[k]) * nodes
        if _get_learned(data, state, states, base):
            values[k] = 0
            continue
        negative = _get_learned(data, state, states, base + 1)
        exponent = 0
        while _get_learned(data, state, states, base + 2 + exponent):
            exponent += 1
            if exponent >= most:
                return False
        magnitude, leading = 1, 1
        for _ in range(exponent):
            if leading < 4:
                bit = _get_learned(data, state, states, base + 34 + 3 * exponent + leading - 1)
                leading = 2 * leading + bit
            else:
                bit = _get(data, state, 32768)
            magnitude = 2 * magnitude + bit
        values[k] = -magnitude if negative else magnitude
    return state[3] == len(data) + 3  # the encoder ends with one byte where four are looked at


def encode(values: Int32[np.ndarray, "num"], contexts: UInt8[np.ndarray, "num"]) -> bytes:
    """The bytes of a column; magnitudes below 2^30, contexts below 32."""
    room = 4 * len(values) + 2 * ROOM
    while True:
        out = np.empty(room, np.uint8)
        if length := _encode(values, contexts, NODES, _states(), out):
            return out[:length].tobytes()
        room *= 4  # a column that is dearer than the numbers themselves: it jumps about


def decode(data: bytes, contexts: UInt8[np.ndarray, "num"]) -> Int32[np.ndarray, "num"]:
    """The column that `encode` had; raises ValueError for bytes that it cannot have written."""
    values = np.empty(len(contexts), np.int32)
    if not _decode(np.frombuffer(data, np.uint8), contexts, NODES, LARGEST_BITS, _states(), values):
        raise ValueError("a column of numbers is damaged")
    return values


def _states() -> np.ndarray:
    return np.tile(np.array([32768, 2]), (CONTEXTS * NODES, 1))
