"""Tone mapping: HDR video, of the transfer functions PQ and HLG, as SDR video.

FFmpeg's `tonemap` filter needs linear light, which only its `zscale` filter makes, and PyAV's builds have none.

Signals become light of an HDR display (ITU-R BT.2100; for HLG one of 1,000 cd/m2), in the primaries of BT.709. The
curve of ITU-R BT.2390 lowers the highest of the three channels from at most 1,000 cd/m2 to at most 203, which is white
in the result, and the others by the same factor, which keeps the hue. HDR reference white, 203 cd/m2 (BT.2408), becomes
90% of the signal. The result is the signal of a display with gamma 2.4 (BT.1886).
"""

import functools

import av
import cv2
import numpy as np
from av.video.reformatter import ColorPrimaries, ColorRange, ColorTrc
from jaxtyping import Float, Float32, UInt8, UInt16

#: Transfer functions of HDR.
HDR = {ColorTrc.SMPTE2084: "PQ", ColorTrc.ARIB_STD_B67: "HLG"}
#: cd/m2 that become white, and of white in the result.
PEAK = 1000.0
WHITE = 203.0
#: Luminance of linear red, green and blue of BT.2020.
_LUMINANCE = np.array([[0.2627, 0.6780, 0.0593]], np.float32)
#: Linear red, green and blue to those of BT.709, from BT.2020 and from P3 with the white of D65.
_FROM_BT2020 = [
    [1.6604910021, -0.5876411388, -0.0728498633],
    [-0.1245504745, 1.1328998971, -0.0083494226],
    [-0.0181507634, -0.1005788980, 1.1187296614],
]
_FROM_P3 = [
    [1.2249401763, -0.2249401763, 0.0],
    [-0.0420569547, 1.0420569547, 0.0],
    [-0.0196375546, -0.0786360454, 1.0982736000],
]
#: By the primaries of the video; without an entry they are kept. BT.2100 defines PQ and HLG with those of BT.2020.
_TO_BT709 = {
    ColorPrimaries.BT2020: _FROM_BT2020,
    ColorPrimaries.UNSPECIFIED: _FROM_BT2020,
    ColorPrimaries.SMPTE432: _FROM_P3,
}
#: Signal of white that FFmpeg makes of YUV of limited range, in 16 bits.
_LIMITED_WHITE = 65283
#: Tables have an entry for each value of 16 bits, at equal steps of the square root of light, up to `_BRIGHTEST` times
#: `PEAK`: PQ has up to 10,000 cd/m2, and colors outside BT.709 have higher channels than that.
_LAST = (1 << 16) - 1
_BRIGHTEST = 20.0


def pq_signal(light: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
    """The PQ signal, from 0 to 1, of light in cd/m2. Source: BT.2100, table 4."""
    power = np.power(light / 10_000, 2610 / 16384)
    return np.power((3424 / 4096 + 2413 / 128 * power) / (1 + 2392 / 128 * power), 2523 / 32)


def pq_light(signal: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
    """The inverse of `pq_signal`."""
    power = np.power(signal, 32 / 2523)
    return 10_000 * np.power(np.maximum(power - 3424 / 4096, 0) / (2413 / 128 - 2392 / 128 * power), 16384 / 2610)


def hlg_scene_light(signal: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
    """Light of the scene, from 0 to 1, of an HLG signal. Source: BT.2100, table 5."""
    a = 0.17883277
    b, c = 1 - 4 * a, 0.5 - a * np.log(4 * a)
    return np.where(signal <= 0.5, signal**2 / 3, (np.exp((signal - c) / a) + b) / 12)


def lower_highlights(light: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
    """Light of at most `PEAK` cd/m2 lowered to at most `WHITE`; dark light is kept. Source: BT.2390, section 5.4.1."""
    whole = pq_signal(np.float64(PEAK))
    value, most = pq_signal(np.minimum(light, PEAK)) / whole, pq_signal(np.float64(WHITE)) / whole
    knee = 1.5 * most - 0.5
    t = np.maximum(value - knee, 0) / (1 - knee)
    spline = (2 * t**3 - 3 * t**2 + 1) * knee + (t**3 - 2 * t**2 + t) * (1 - knee) + (3 * t**2 - 2 * t**3) * most
    return pq_light(np.where(value < knee, value, spline) * whole)


def map_tones(
    frame: av.VideoFrame, image: UInt16[np.ndarray, "height width rgb"], transfer: str
) -> UInt8[np.ndarray, "height width rgb"]:
    """A frame of the transfer function "PQ" or "HLG" as SDR. `image`: it, as FFmpeg converts it to 16 bits."""
    kind = frame.format
    is_full = kind.is_rgb or kind.name.startswith("gray") or frame.color_range == ColorRange.JPEG
    bits = kind.components[0].bits
    tables = _tables(transfer, ((1 << bits) - 1) << (16 - bits) if is_full else _LIMITED_WHITE)
    light = tables[0][image]
    if transfer == "HLG":  # light of the scene becomes that of a display of 1,000 cd/m2 by its luminance
        light *= cv2.transform(light, _LUMINANCE)[..., None] ** np.float32(0.2)
    matrix = np.array(_TO_BT709.get(frame.color_primaries, np.eye(3)), np.float32)
    light = cv2.transform(light, matrix)
    red, green, blue = cv2.split(light)
    highest = np.clip(np.maximum(np.maximum(red, green), blue) / _BRIGHTEST, 0, 1)
    light *= tables[1][np.rint(np.sqrt(highest) * _LAST).astype(np.uint16)][..., None]
    return tables[2][np.rint(np.sqrt(np.clip(light, 0, 1)) * _LAST).astype(np.uint16)]


@functools.cache
def _tables(transfer: str, white: int) -> tuple[Float32[np.ndarray, " 65536"], ...]:
    """Light of each signal of 16 bits, of the display for PQ and of the scene for HLG, in units of `PEAK`.

    And two tables by the square root of light: the factor of tone mapping to light in units of `WHITE`, and the 8-bit
    signal of such light. `white`: the largest signal.
    """
    signals, roots = np.minimum(np.arange(1 << 16) / white, 1), np.linspace(0, 1, 1 << 16)
    light = np.maximum(_BRIGHTEST * roots**2, 1e-9)
    shown = pq_light(signals) / PEAK if transfer == "PQ" else hlg_scene_light(signals)
    factor = lower_highlights(PEAK * light) / (WHITE * light)
    return shown.astype(np.float32), factor.astype(np.float32), np.rint(255 * roots ** (2 / 2.4)).astype(np.uint8)
