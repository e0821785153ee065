"""Image regions: masks, boxes and polygons on some frames, as one type, at the model's own size."""

import dataclasses
import math
import os
from collections.abc import Callable, Mapping

import cv2
import numpy as np
import skimage
from jaxtyping import ArrayLike, Bool, Float, Float32

from foldgauss._runtime.checks import invalid, is_integer, require, short_repr
from foldgauss.video.models.video_model import VideoModel, check_model

Mask = Bool[np.ndarray, "height width"] | Float[np.ndarray, "height width"]
Masks = Mask | Bool[np.ndarray, "num_frames height width"] | Mapping[int, Mask]

#: A mask's aspect may differ from the model's by this many of the model's pixels: sizes are rounded.
ROUNDING = 1.0


@dataclasses.dataclass(frozen=True, eq=False)
class Region:
    """Pixels of some frames: `at(k)` is float32 (height, width) in [0, 1], the fraction of each pixel inside."""

    frames: tuple[int, ...]
    at: Callable[[int], Float32[np.ndarray, "height width"]]


def region_from_mask(model: VideoModel, mask: Masks, frame: int | None, frames: tuple[int, int] | None) -> Region:
    """From one mask for one frame or several, one mask for each of several frames, or {frame: mask}."""
    check_model(model)
    if isinstance(mask, Mapping):
        require(
            frame is None and frames is None,
            "mask",
            expected="its frames given once",
            got="{frame: mask}, and frame or frames as well",
        )
        found = {_check_frame(model.num_frames, k): _check_mask(model, one, ndim=2) for k, one in mask.items()}
    elif isinstance(mask, str | os.PathLike):
        raise invalid(
            "mask",
            expected="bool (height, width)",
            got=f"the path {str(mask)!r}",
            cure="Read it: mask=foldgauss.io.read_masks(path).",
        )
    else:
        mask = np.asarray(mask)
        require(
            mask.ndim != 2 or frame is not None or frames is not None,
            "mask",
            expected=f"({model.num_frames}, height, width)",
            got=f"{mask.shape}",
            cure="Name its frame: frame=k.",
        )
        numbers = resolve_frames(model.num_frames, frame, frames)
        require(
            mask.ndim == 2 or (mask.ndim == 3 and len(mask) == len(numbers)),
            "mask",
            expected=f"one of shape (height, width), or {len(numbers)} of them",
            got=f"shape {mask.shape}",
            cure="Name their frames: frame=k, frames=(first, stop) or mask={frame: mask}.",
        )
        _check_mask(model, mask, mask.ndim)
        found = dict(zip(numbers, mask, strict=True)) if mask.ndim == 3 else dict.fromkeys(numbers, mask)
    require(any(one.any() for one in found.values()), "mask", expected="a mask that is not empty", got="an empty one")
    return Region(tuple(sorted(found)), lambda k: _resize(found[k], model.size))


def region_from_box(
    model: VideoModel, box: tuple[float, float, float, float], frame: int | None, frames: tuple[int, int] | None
) -> Region:
    """The pixels whose centers lie in x0 <= x < x1, y0 <= y < y1."""
    check_model(model)
    edges = _as_array(box)
    require(
        edges.shape == (4,) and edges.dtype.kind in "fiu" and np.isfinite(edges).all(),
        "box",
        expected="(x0, y0, x1, y1) in pixels",
        got=short_repr(box),
    )
    require(
        edges[0] < edges[2] and edges[1] < edges[3],
        "box",
        expected="x0 < x1 and y0 < y1",
        got=box,
        cure="x is right, y is down.",
    )
    (height, width), (x0, y0, x1, y1) = model.size, edges
    x, y = np.arange(width) + 0.5, np.arange(height)[:, None] + 0.5
    return _constant_region("box", model, (x0 <= x) & (x < x1) & (y0 <= y) & (y < y1), frame, frames)


def region_from_polygon(
    model: VideoModel, polygon: Float[ArrayLike, "corners 2"], frame: int | None, frames: tuple[int, int] | None
) -> Region:
    """The pixels whose centers lie in a polygon of corners (x, y), even-odd."""
    check_model(model)
    corners = _as_array(polygon)
    bad = corners.ndim != 2 or corners.shape[1:] != (2,) or len(corners) < 3 or corners.dtype.kind not in "fiu"
    require(
        not bad and np.isfinite(corners).all(),
        "polygon",
        expected="at least 3 corners (x, y) in pixels",
        got=short_repr(polygon),
    )
    # scikit-image has pixel centers at integers, and rows first.
    return _constant_region(
        "polygon", model, skimage.draw.polygon2mask(model.size, corners[:, ::-1] - 0.5), frame, frames
    )


def _as_array(given: object) -> np.ndarray:
    """As an array; an empty one for rows of different lengths."""
    try:
        return np.asarray(given)
    except ValueError:
        return np.zeros(0)


def resolve_frames(num_frames: int, frame: int | None, frames: tuple[int | None, int | None] | None) -> range:
    """The frame `frame`, the frames first <= k < stop, or all, of a clip."""
    require(frame is None or frames is None, "frame, frames", expected="one of the two", got="both")
    if frame is not None:
        k = _check_frame(num_frames, frame)
        return range(k, k + 1)
    pair = tuple(frames) if isinstance(frames, tuple | list | np.ndarray) else (None, None) if frames is None else ()
    if len(pair) == 2:
        pair = tuple(end if given is None else given for given, end in zip(pair, (0, num_frames), strict=True))
    require(
        len(pair) == 2 and all(is_integer(k, 0) for k in pair) and pair[0] < pair[1] <= num_frames,
        "frames",
        expected=f"(first, stop) with 0 <= first < stop <= {num_frames}",
        got=repr(frames),
        cure="None is the clip's own end; for one frame give frame=k.",
    )
    return range(*map(int, pair))


def check_times(times: object) -> tuple[float, float]:
    """As floats (start, stop). Raises ValueError unless 0 <= start <= stop <= 1."""
    pair = _as_array(times)
    require(
        pair.shape == (2,) and pair.dtype.kind in "fiu" and 0 <= pair[0] <= pair[1] <= 1,
        "times",
        expected="(start, stop), rising, in [0, 1]",
        got=times,
    )
    return float(pair[0]), float(pair[1])


def _constant_region(name, model, inside: Bool[np.ndarray, "height width"], frame, frames) -> Region:
    """The same pixels in all of the frames."""
    if not inside.any():
        height, width = model.size
        raise invalid(
            name,
            expected=f"pixels of a {height}x{width} frame in it",
            got="none",
            cure="x is right, y is down, in pixels of the model's own size.",
        )
    fraction = inside.astype(np.float32)
    return Region(tuple(resolve_frames(model.num_frames, frame, frames)), lambda k: fraction)


def _check_frame(num_frames: int, k: object) -> int:
    require(
        is_integer(k, 0) and k < num_frames, "frame", expected=f"a whole number in [0, {num_frames - 1}]", got=repr(k)
    )
    return int(k)


def _check_mask(model: VideoModel, mask: np.ndarray, ndim: int) -> np.ndarray:
    """A mask or a stack of masks of the model's aspect; bool, or float in [0, 1]."""
    mask = np.asarray(mask)
    require(
        mask.ndim == ndim and mask.size != 0 and mask.dtype.kind in "bf",
        "mask",
        expected="bool (height, width)",
        got=f"{mask.dtype} {mask.shape}",
        cure="From labels take those of one object: mask=(labels == 1); from gray levels, mask=(levels > 127).",
    )
    require(
        mask.dtype.kind != "f" or ((mask >= 0) & (mask <= 1)).all(),
        "mask",
        expected="bool, or fractions in [0, 1]",
        got="other values",
    )
    (height, width), (rows, columns) = model.size, mask.shape[-2:]
    off = min(abs(columns * height / rows - width), abs(rows * width / columns - height))
    # The sides of a smaller mask are rounded, too.
    require(
        off <= max(ROUNDING, 0.5 * max(height, width) / max(rows, columns)) + 1e-6,
        "mask",
        expected=f"the aspect of the model's {height}x{width}",
        got=f"{rows}x{columns}",
        cure="Crop it as the frames were cropped.",
    )
    return mask


def _resize(mask: np.ndarray, size: tuple[int, int]) -> Float32[np.ndarray, "height width"]:
    """By area averaging where it shrinks, so that border pixels are partly inside."""
    fraction = np.ascontiguousarray(mask, np.float32)
    if fraction.shape == size:
        return fraction
    shrinks = math.prod(fraction.shape) > math.prod(size)
    return cv2.resize(fraction, size[::-1], interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR)
