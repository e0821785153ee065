"""A reader of compact models, written from docs/format.md alone: what the page says is enough to read a file.

It favors clarity over speed, and reads some thousand numbers in a second.
"""

import json
import math
import struct
import zlib

import numpy as np

MAGIC = b"\x8bFGZ\r\n\x1a\n"
INTEGRAL = ("cell", "class", "degree", "path")
FEATURES = ("class", "size", "stretch", "duration", "opacity")
LARGEST_STEPS = {"time": 0.125, "angle": 0.125, "size": 0.35, "stretch": 0.5, "duration": 0.5, "opacity": 1.0}
LN2, SQRT2, SQRT_HALF = 0.6931471805599453, 1.4142135623730951, 0.7071067811865476
AXES = (
    (0.5773502691896258, 0.5773502691896258, 0.5773502691896258),
    (-0.7071067811865476, 0.0, 0.7071067811865476),
    (-0.408248290463863, 0.8164965809277261, -0.408248290463863),
)


def read(data, chunks=None):
    """The header and the arrays of a file's bytes.

    `chunks`: the numbers, from 0, of the chunks to read (default: all). Damaged chunks are left out.
    """
    version, length, crc = struct.unpack_from("<3I", data, 8)
    if data[:8] != MAGIC or version != 6:
        raise ValueError("not a compact model of version 6")
    text, at = data[20 : 20 + length], 20 + length
    if zlib.crc32(text) != crc:
        raise ValueError("the header is damaged")
    header = json.loads(text)
    motion, at = _streams(data, at, header["motion"])
    if motion is None:
        raise ValueError("the motion is damaged")
    arrays = _motion(header, motion)
    decoded = []
    for number, chunk in enumerate(header["chunks"]):
        streams, at = _streams(data, at, chunk)
        if streams is not None and (chunks is None or number in chunks):
            decoded.append(_leaves(header, _Chunk(header, chunk, streams)))
    for name in decoded[0] if decoded else ():
        arrays[name] = np.concatenate([leaves[name] for leaves in reversed(decoded)])
    return header, arrays


def split_layers(data):
    """The bytes of each layer of a file by its name, from back to front; "" where there is one without a name."""
    layers = {}
    while data:
        (length,) = struct.unpack_from("<I", data, 12)
        header = json.loads(data[20 : 20 + length])
        size = 20 + length + sum(sum(block["streams"]) for block in (header["motion"], *header["chunks"]))
        layers[header.get("layer", "")], data = data[:size], data[size:]
    return layers


def _streams(data, at, block):
    """Streams of the block that begins here, None if it is damaged, and where it ends."""
    end = at + sum(block["streams"])
    if end > len(data) or zlib.crc32(data[at:end]) != block["crc"]:
        return None, end
    streams = []
    for length in block["streams"]:
        streams.append(data[at : at + length])
        at += length
    return streams, end


# --------------------------------------------------------------------------------------- numbers of a stream

KNOTS = [22, 36, 60, 98, 162, 267, 439, 720, 1179, 1921, 3108, 4971, 7812, 11955, 17625, 24743, 32768]
KNOTS += [65536 - knot for knot in KNOTS[-2::-1]]


def _logistic(d):
    k, r = (d + 2048) >> 7, (d + 2048) & 127
    return (KNOTS[k] * (128 - r) + KNOTS[k + 1] * r + 64) >> 7


LOGISTIC = [_logistic(d) for d in range(-2048, 2048)]
STRETCH = [next((d for d in range(-2048, 2048) if LOGISTIC[d + 2048] >= 16 * i + 8), 2047) for i in range(4096)]


class Numbers:
    """The numbers of a stream, one after another."""

    def __init__(self, stream):
        self.stream, self.at = stream, 4
        self.low, self.high = 0, 0xFFFFFFFF
        self.code = int.from_bytes(stream[:4].ljust(4, b"\0"), "big")
        self.models, self.weights = {}, {}

    def next(self, *contexts):
        """The next number, with its three contexts."""
        if self._bit(0, contexts):
            return 0
        negative, e = self._bit(1, contexts), 0
        while self._bit(2 + e, contexts):
            e += 1
            if e > 29:
                raise ValueError("a stream is damaged")
        size = 1
        for place in range(e):
            if place < 2:
                node = 34 + 3 * e + (0 if place == 0 else 1 + (size & 1))
                size = 2 * size + self._bit(node, contexts)
            else:
                size = 2 * size + self._decode(32768)
        return -size if negative else size

    def end(self):
        """After the last number: four bytes were read at first, and the writer ended with one."""
        if self.at != len(self.stream) + 3:
            raise ValueError("a stream is damaged")

    def _bit(self, node, contexts):
        own = [self.models.setdefault((node, m, context), [32768, 2]) for m, context in enumerate(contexts)]
        weights = self.weights.setdefault(node, [29491] * 3)
        stretched = [STRETCH[p >> 4] for p, _ in own]
        dot = sum(w * s for w, s in zip(weights, stretched, strict=True)) >> 16
        mixed = min(max(LOGISTIC[min(max(dot, -2047), 2047) + 2048], 32), 65504)
        bit = self._decode(mixed)
        for m, s in enumerate(stretched):
            weights[m] += (6 * s * (65536 * bit - mixed)) >> 18
        for model in own:
            p, n = model
            model[:] = p + (65536 - p) // n if bit else p - p // n, min(n + 1, 400)
        return bit

    def _decode(self, p):
        span = self.high - self.low
        split = self.low + (span >> 16) * p + ((span & 0xFFFF) * p >> 16)
        bit = int(self.code <= split)
        if bit:
            self.high = split
        else:
            self.low = split + 1
        while self.low >> 24 == self.high >> 24:
            byte = self.stream[self.at] if self.at < len(self.stream) else 0
            self.at += 1
            self.low = self.low << 8 & 0xFFFFFFFF
            self.high = self.high << 8 & 0xFFFFFFFF | 0xFF
            self.code = self.code << 8 & 0xFFFFFFFF | byte
        return bit


def _level(x):
    """How many of 1/2, 3/2, 3, 6, 12, ... (15 of them) the absolute value reaches."""
    bounds = [0.5, *(1.5 * 2.0**k for k in range(14))]
    return sum(abs(x) >= bound for bound in bounds)


def signed_level(r):
    return 16 + _level(r) if r >= 0 else 16 - _level(r)


# --------------------------------------------------------------------------------------- motion


def _motion(header, streams):
    numbers = Numbers(streams[0])
    logits = [numbers.next(0, 0, 0) * 2.0 ** -header["time_bits"] for _ in range(header["num_frames"] - 1)]
    numbers.end()
    arrays = {"frame_times": _single(logits)}
    if "paths" not in header:
        return arrays
    paths = header["paths"]
    num_paths, num_knots = paths["num_paths"], paths["num_knots"]
    if paths["at_frames"]:
        times = [_frame_times(logits)] * num_paths
    else:
        numbers = Numbers(streams[1])
        steps = [[numbers.next(0, 0, 0) for _ in range(num_knots)] for _ in range(num_paths)]
        numbers.end()
        times = np.cumsum(np.array(steps, np.int64), 1) * 2.0**-24
    numbers, maps, one = Numbers(streams[2]), [], 2 ** paths["bits"]
    for _ in range(num_paths):
        place, before = [one, 0, 0, 0, one, 0], None
        for _ in range(num_knots):
            third = [0] * 6 if before is None else [signed_level(own) for own in before]
            before = [numbers.next(i, 0, third[i]) for i in range(6)]
            place = [x + step for x, step in zip(place, before, strict=True)]
            maps.append(place)
    numbers.end()
    arrays["path_times"] = _single(times)
    arrays["path_matrices"] = _single(np.array(maps) * 2.0 ** -paths["bits"]).reshape(num_paths, num_knots, 2, 3)
    return arrays


def _frame_times(logits):
    largest, sums = max(logits, default=0.0), [0.0]
    for logit in logits:
        sums.append(sums[-1] + _exp(logit - largest))
    return [0.0, *(own / sums[-1] for own in sums[1:])]


# --------------------------------------------------------------------------------------- columns of a chunk


def column_names(header):
    """The names of the columns in the order of their streams."""
    names = ["cell", "class", "degree", *(["path"] if "paths" in header else [])]
    names += ["size", "stretch", "duration", "opacity", "time"]
    names += [axis + str(k) for k in range(header["degree"] + 1) for axis in "xy"]
    return [*names, "angle", "luma", "blue", "green"]


class _Chunk:
    """Numbers and values of the columns of a chunk, by name, and the spans of its trajectories."""

    def __init__(self, header, chunk, streams):
        self.header, self.num, self.bits = header, chunk["num_gaussians"], chunk["cells"]
        self.numbers, self.values, self.nearby = {}, {}, [[]] * self.num
        for name, rule, stream in zip(column_names(header), header["rules"], streams, strict=True):
            self._decode(name, rule, Numbers(stream))
            if name == "cell":
                self.nearby = self._find_latest_of_cell()
            elif name == "y0":
                self._find_spans()
                self.nearby = self._find_nearest()

    def _decode(self, name, rule, stream):
        """Decodes a column, after the columns before it."""
        power = int(name[1:]) if name[0] in "xy" else 0
        numbers, values = [0] * self.num, [0.0] * self.num
        self.numbers[name], self.values[name] = numbers, values
        for i in range(self.num):
            if power > 0 and power > self.numbers["degree"][i]:
                continue
            h, step, origin = self._step(name, rule, i)
            third = 0
            if self.nearby[i]:
                total = 0.0
                for j in self.nearby[i]:
                    total += values[j] / self._scale(power, j)
                third = signed_level((total / len(self.nearby[i]) * self._scale(power, i) - origin) / step)
            numbers[i] = stream.next(*self._contexts(name, power, h, i), third)
            if name == "cell":
                numbers[i] = (numbers[i] + (numbers[i - 1] if i else 0)) % 2 ** sum(self.bits)
            values[i] = origin + numbers[i] * step
        stream.end()

    def _step(self, name, rule, i):
        """Of a Gaussian's number: h, the step and the origin."""
        if name in INTEGRAL:
            return 0, 1.0, 0.0
        origin, total, *slopes = rule
        for slope, feature in zip(slopes, FEATURES, strict=False):
            total = total + slope * self.values[feature][i]
        h = min(max(math.floor(2 * total + 0.5), -48), 120)
        step = min(_half_power(h), LARGEST_STEPS.get(name, math.inf))
        axis = {"x0": 0, "y0": 1, "time": 2}.get(name)
        if axis is not None and self.bits[axis] > 0:
            middle, side = self._extents()[axis]
            center = middle + ((self._cell(i)[axis] + 0.5) / 2 ** self.bits[axis] - 0.5) * side
            origin = math.floor(center / step + 0.5) * step
        return h, step, origin

    def _extents(self):
        """Middle and side of what the cells divide, along x, y and time."""
        (height, width), longer = self.header["size"], max(self.header["size"])
        middle, sides = (0.0, 0.0), (width / longer, height / longer)
        if "paths" in self.header:
            middle, sides = self.header["paths"]["middle"], self.header["paths"]["sides"]
        return [*zip(middle, sides, strict=True), (0.5, 1.0)]

    def _cell(self, i):
        """Indices of a Gaussian's cell along x, y and time."""
        cell, indices = self.numbers["cell"][i], [0, 0, 0]
        for place in range(max(self.bits)):
            for axis in range(3):
                if place < self.bits[axis]:
                    indices[axis] |= (cell & 1) << place
                    cell >>= 1
        return indices

    def _contexts(self, name, power, h, i):
        """The first two contexts."""
        t = h // 2 % 32
        if name in ("cell", "class"):
            return t, 0
        c, d = self.numbers["class"][i] % 32, self.numbers["degree"][i] if power else 0

        def level(other):
            return _level(self.numbers[other][i])

        if power == 1:
            return t + 32 * (d == 1), 17 * d if name == "x1" else 16 * level("x1") + d
        if power > 1:
            other = f"y{power - 1}" if name[0] == "x" else f"x{power}"
            return t + 32 * (d == power), 16 * level(other) + level(f"{name[0]}{power - 1}")
        if name == "blue":
            return t, 16 * level("luma")
        if name == "green":
            return t, 16 * level("luma") + level("blue")
        return t, c

    def _scale(self, power, i):
        """The power of a Gaussian's `half`, as a product from the left."""
        product = 1.0
        for _ in range(power):
            product *= self.half[i]
        return product

    def _find_latest_of_cell(self):
        """The last four previous Gaussians of the same cell, the latest first; without any, the previous one."""
        found, cells = [], {}
        for i, cell in enumerate(self.numbers["cell"]):
            own = cells.setdefault(cell, [])
            found.append(own[:-5:-1] or ([i - 1] if i else []))
            own.append(i)
        return found

    def _find_spans(self):
        """m_t, and middle and half of the length of each trajectory's span."""
        self.time, self.middle, self.half = [_clamp(time) for time in self.values["time"]], [], []
        for time, duration in zip(self.time, self.values["duration"], strict=True):
            h = math.floor(2 * (duration * (1 / LN2)) + 0.5)
            r = self.header["reach"] * _half_power(min(max(h, -120), 120))
            first, last = max(time - r, 0.0), min(time + r, 1.0)
            self.middle.append((first + last) * 0.5)
            self.half.append(max((last - first) * 0.5, 2.0**-40))

    def _find_nearest(self):
        """The four nearest previous Gaussians, the nearest first."""
        parts = 2 ** (max(self.bits[:2]) + 1)
        x, y, t = self.values["x0"], self.values["y0"], [0.3 * middle for middle in self.middle]
        if "paths" in self.header:
            (x_middle, x_side), (y_middle, y_side), _ = self._extents()
            longer = max(x_side, y_side)
            x, y = [(own - x_middle) / longer for own in x], [(own - y_middle) / longer for own in y]
            t = [own / longer for own in t]
        squares, found = {}, []
        for i in range(self.num):
            column, row = (min(max(math.floor((own[i] + 0.5) * parts), 0), parts - 1) for own in (x, y))
            candidates = []
            for c in (column - 1, column, column + 1):
                for r in (row - 1, row, row + 1):
                    for j in squares.get((c, r), [])[:-17:-1]:
                        dx, dy, dt = x[i] - x[j], y[i] - y[j], t[i] - t[j]
                        candidates.append((dx * dx + dy * dy + dt * dt, j))
            candidates.sort(key=lambda own: own[0])  # a stable sort
            found.append([j for _, j in candidates[:4]])
            squares.setdefault((column, row), []).append(i)
        return found


# --------------------------------------------------------------------------------------- leaves


def _leaves(header, chunk):
    v, num = chunk.values, chunk.num
    trajectories = [[_trajectory(header["degree"], chunk, axis, i) for axis in "xy"] for i in range(num)]
    polynomials = _single(trajectories).transpose(0, 2, 1)
    leaves = {
        "loc": polynomials[:, 0],
        "log_scale": [[v["size"][i] + v["stretch"][i], v["size"][i] - v["stretch"][i]] for i in range(num)],
        "angle_logit": [_logit(_clamp(turns)) for turns in v["angle"]],
        "time_loc_logit": [_logit(time) for time in chunk.time],
        "log_time_scale": v["duration"],
        "coefficients": polynomials[:, 1:],
        "opacity_logit": v["opacity"],
        "color_dc": [
            [v["luma"][i] * a + v["blue"][i] * b + v["green"][i] * c for a, b, c in zip(*AXES, strict=True)]
            for i in range(num)
        ],
    }
    leaves = {name: _single(leaf) for name, leaf in leaves.items()}
    if "path" in v:
        leaves["path_index"] = np.uint8(chunk.numbers["path"])
    return leaves


def _trajectory(degree, chunk, axis, i):
    """The coefficients of a trajectory along an axis, by the power of u = m_t - t."""
    powers = []
    for j in range(degree + 1):
        total = 0.0
        for k in range(j, degree + 1, 2):
            total = total + _legendre(k, j) * chunk.values[f"{axis}{k}"][i]
        powers.append(total)
    at, scale = (chunk.time[i] - chunk.middle[i]) / chunk.half[i], -1.0 / chunk.half[i]
    for j in range(degree):
        for k in range(degree - 1, j - 1, -1):
            powers[k] = powers[k] + at * powers[k + 1]
    factor = 1.0
    for k in range(degree + 1):
        powers[k] = powers[k] * factor
        factor = factor * scale
    return powers


def _legendre(k, j):
    """The coefficient of w^j in P_k, for k - j even; exact."""
    n = (k - j) // 2
    return (-1) ** n * math.comb(k, n) * math.comb(2 * k - 2 * n, k) / 2**k


# --------------------------------------------------------------------------------------- elementary functions


def _single(values):
    """As float32, +0 instead of -0."""
    return np.array(values, np.float64).astype(np.float32) + np.float32(0)


def _clamp(x):
    return min(max(x, 2.0**-24), 1 - 2.0**-24)


def _half_power(h):
    """2^(h / 2)."""
    return math.ldexp(SQRT2 if h % 2 else 1.0, h // 2)


def _logit(x):
    return _log(x) - _log(1 - x)


def _log(x):
    m, e = math.frexp(x)  # m from 1/2 to 1
    if m < SQRT_HALF:
        m, e = 2 * m, e - 1
    s = (m - 1) / (m + 1)
    z, total = s * s, 0.0
    for k in range(17, 0, -2):
        total = total * z + 1 / k
    return e * LN2 + 2 * s * total


def _exp(x):
    x = max(x, -690.0)
    e = math.floor(x * (1 / LN2) + 0.5)
    rest, total = x - e * LN2, 1.0
    for k in range(14, 0, -1):
        total = 1 + total * rest / k
    return math.ldexp(total, e)
