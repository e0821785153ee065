"""Frames cropped, resized and converted to RGB, and stacked without a second copy in memory."""

import os
from collections.abc import Callable, Iterable

import cv2
import numpy as np

from foldgauss.io.media.clip import Size, format_size, video_error

BLOCK_BYTES = 64 << 20
#: Fraction of a frame, above which a crop to another aspect is reported: 16:9 to 2:1, a ninth, is not.
CROP_REPORTED = 0.15


def memory_limit() -> int:
    """Bytes that a clip may take: a third of the machine's memory, since a fit holds it twice."""
    try:
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") // 3
    except (AttributeError, ValueError, OSError):  # not POSIX
        return 8 << 30


def make_resizer(size: Size | None, crop: Size | None = None) -> Callable[[np.ndarray], np.ndarray]:
    """A function from BGR frames to RGB frames: crop the central window `crop`, then the aspect of `size`, then resize.

    It raises `VideoError` once its outputs add up to more than `memory_limit()`.
    """
    limit, num_bytes, num_frames = memory_limit(), 0, 0

    def prepare(image: np.ndarray) -> np.ndarray:
        nonlocal num_bytes, num_frames
        if crop is not None:
            image = image[center_window(image.shape[:2], crop)]
        height, width = image.shape[:2] if size is None else size
        channels = image.shape[2]
        num_bytes, num_frames = num_bytes + channels * height * width, num_frames + 1
        if num_bytes > limit:
            expected = f"a clip of at most {limit / 2**30:.1f} GiB, a third of this machine's memory"
            got = f"more, at frame {num_frames} of {height}x{width}"
            raise video_error("size", expected=expected, got=got, cure="Take fewer frames or a smaller size.")
        if size is not None and image.shape[:2] != size:
            image = image[aspect_window(image.shape[:2], size)]
        if image.shape[:2] != (height, width):
            shrinks = image.shape[0] >= height and image.shape[1] >= width
            image = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_CUBIC)
        return cv2.cvtColor(image, cv2.COLOR_BGR2RGB if channels == 3 else cv2.COLOR_BGRA2RGBA)

    return prepare


def aspect_window(have: Size, want: Size) -> tuple[slice, slice]:
    """The largest central window of `have` with the aspect of `want`, to whole pixels."""
    height, width = have
    if width * want[0] > height * want[1]:
        window = height, max(1, round(height * want[1] / want[0]))
    else:
        window = max(1, round(width * want[0] / want[1])), width
    return center_window(have, window)


def describe_crop(sizes: Iterable[Size], want: Size) -> tuple[str, ...]:
    """A note if the aspect of `want` keeps little of frames of these `sizes`; otherwise nothing."""
    for height, width in sizes:
        rows, columns = aspect_window((height, width), want)
        lost = 1 - (rows.stop - rows.start) * (columns.stop - columns.start) / (height * width)
        scale = (want[0] * want[1] / (height * width)) ** 0.5
        whole = max(1, round(scale * height)), max(1, round(scale * width))
        if lost > CROP_REPORTED and whole != tuple(want):
            cure = f"{whole[0]}x{whole[1]} keeps all of them."
            return (f"{want[0]}x{want[1]} crops {lost:.0%} of frames of {height}x{width}; {cure}",)
    return ()


def center_window(have: Size, window: Size) -> tuple[slice, slice]:
    """Rows and columns of the central (height, width) `window`. Raises `VideoError` where it does not fit."""
    if window[0] > have[0] or window[1] > have[1]:
        expected, got = f"at most the frame's {format_size(have)}", f"{window[0]}x{window[1]}"
        cure = "Crop a smaller window, or enlarge with size=(height, width) instead."
        raise video_error("center_crop", expected=expected, got=got, cure=cure)
    top, left = (have[0] - window[0]) // 2, (have[1] - window[1]) // 2
    return slice(top, top + window[0]), slice(left, left + window[1])


def convert_channels(frame: np.ndarray, channels: int) -> np.ndarray:
    """An RGB or RGBA frame with 3 or 4 channels: alpha is dropped, or added as opaque."""
    if frame.shape[2] == channels:
        return frame
    return cv2.cvtColor(frame, cv2.COLOR_RGB2RGBA) if channels == 4 else frame[..., :3]


def copy_to_blocks(frames: Iterable[np.ndarray]) -> list[np.ndarray]:
    """Copies of the frames in large blocks, each of which is returned to the system when its last frame is freed.

    Views of the frames are made last: made in between, these small objects would lie where large ones of the decoder
    were, and it would take new memory for each frame.
    """
    blocks, used = [], []
    for frame in frames:
        if not blocks or used[-1] == len(blocks[-1]) or blocks[-1].shape[1:] != frame.shape:
            blocks.append(np.empty((max(1, BLOCK_BYTES // frame.nbytes), *frame.shape), np.uint8))
            used.append(0)
        blocks[-1][used[-1]] = frame
        used[-1] += 1
    return [frame for block, num in zip(blocks, used, strict=True) for frame in block[:num]]


def stack_frames(frames: list[np.ndarray]) -> np.ndarray:
    """All frames in one array: with alpha where any is transparent anywhere, otherwise without.

    The list is emptied as it goes, so that the peak is one copy of the clip and not two.
    """
    channels = 4 if any(frame.shape[2] == 4 and frame[..., 3].min() < 255 for frame in frames) else 3
    clip = np.empty((len(frames), *frames[0].shape[:2], channels), np.uint8)
    for number in range(len(frames)):
        clip[number] = convert_channels(frames[number], channels)
        frames[number] = None
    return clip
