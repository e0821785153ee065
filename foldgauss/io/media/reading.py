"""Reading clips: `read_video`, and `scan_clip`, which detects the format."""

import math
import os
from collections.abc import Callable, Iterable, Iterator, Sized
from pathlib import Path

import cv2
import numpy as np

from foldgauss._runtime.checks import require
from foldgauss.io._atomic import PathLike
from foldgauss.io.media.clip import (
    Clip,
    ClipFacts,
    Range,
    Size,
    VideoError,
    check_fps,
    check_frame_size,
    check_range,
    check_readable,
    format_size,
    read_head,
    translate_os_errors,
)
from foldgauss.io.media.decoder import scan_video
from foldgauss.io.media.images import is_bare_jpegs, is_image, scan_folder, scan_picture

BLOCK_BYTES = 64 << 20
#: Fraction of a frame, above which a crop to another aspect is reported: 16:9 to 2:1, a ninth, is not.
CROP_REPORTED = 0.15


def scan_clip(
    path: Path, start: int, stop: int | None, keep: Callable[[Iterator[np.ndarray]], Sized]
) -> tuple[Sized, ClipFacts]:
    """What `keep` makes of the frames of a clip from `start` up to `stop`, and the facts about the clip.

    The frames are BGR, or premultiplied BGRA if any pixel is transparent, as stored. Raises `VideoError` and OSError.
    """
    head = b"" if path.is_dir() else read_head(path)
    if not path.is_dir() and (not is_image(head) or is_bare_jpegs(path, head)):
        return scan_video(path, start, stop, keep)
    scan = scan_folder if path.is_dir() else scan_picture
    return scan(path, start, stop, keep)


def read_video(
    path: PathLike,
    *,
    frames: Range | None = None,
    size: Size | None = None,
    fps: float | None = None,
    center_crop: Size | None = None,
    scan: Callable[..., tuple[Sized, ClipFacts]] = scan_clip,
) -> Clip:
    """Read a video file, a folder of images in natural order (img2 before img10), or one image as a clip of one frame.

    `frames = (A, B)` keeps frames A <= i < B, None for an open end; of a clip that ends before
    B, those up to its end, with a note. `size = (height, width)` crops each frame to that
    aspect around its center (to whole pixels), then resizes it, by area averaging to shrink and by cubic interpolation
    to enlarge: (160, 320) of a 1280x720 clip is rows 40 to 680. `fps` overrides the rate of the container (25 for
    images). `center_crop = (height, width)` first crops that window around the center (an odd remainder is cut below
    and to the right). Frames are decoded one by one: memory is that of the output plus two source frames, and a clip
    that would take over a third of the machine's memory is refused. `Clip.notes` reports a `size` that crops much.

    Images of 16 bits are scaled to 8, and so are videos of 10 or more; gray ones get three equal channels. HDR videos
    (PQ, HLG) are tone-mapped to SDR (ITU-R BT.2390). Colors of videos are converted by the matrix and the range that
    the file declares (BT.601 and limited where it does not), with interpolated chroma.

    Where any frame is transparent anywhere, the clip has alpha (see `Clip`), and opaque frames get an alpha of 255.
    Each interlaced frame is converted to a progressive one by FFmpeg's bwdif. Where pixels are not square, frames are
    enlarged along one side until they are. Videos are rotated upright. A damaged one yields the frames that decode; see
    `Clip.num_declared`. Unevenly spaced frames are all kept; see `Clip.times`.

    The format is detected from the first bytes, not from the name. No file or address that `path` refers to is opened,
    such as the entries of a playlist. Images of more than 178,956,970 pixels are refused by their header. `scan` reads
    files of other formats, as `scan_clip` does.

    Raises `FileNotFoundError` for a missing path, `VideoError` for everything else that cannot be read.
    """
    path = check_readable(path)
    start, stop = check_range(frames)
    size, center_crop = check_frame_size(size), check_frame_size(center_crop, "center_crop")
    sizes = set()

    def prepare(image):
        sizes.add(image.shape[:2])
        return resize_frame(image, size, center_crop)

    if fps is not None:
        check_fps(fps)
    with translate_os_errors(path):
        kept, facts = scan(path, start, stop, lambda images: stack_frames(map(prepare, images)))
    num_declared, rate, notes = facts.describe_span(start, len(facts.stamps), stop, fps)
    if size is not None and center_crop is None:
        notes += describe_crop(sizes, size)
    about = str(path), num_declared, rate.times, notes, rate.first_second, rate.duration
    return Clip(kept, float(rate.fps), *about)


# -------------------------------------------------------------------------------------- sizes and memory


def memory_limit() -> int:
    """Bytes that a clip may take: a third of the machine's memory, since a fit holds it twice."""
    try:
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") // 3
    except (AttributeError, ValueError, OSError):  # not POSIX
        return 8 << 30


def check_memory(num: int, shape: tuple[int, int, int]) -> None:
    """Raise `VideoError` where so many frames of a `shape` take more than `memory_limit()`."""
    limit = memory_limit()
    require(
        num * math.prod(shape) <= limit,
        "size",
        expected=f"a clip of at most {limit / 2**30:.1f} GiB, a third of this machine's memory",
        got=f"more, at frame {num} of {shape[0]}x{shape[1]}",
        cure="Take fewer frames or a smaller size.",
        kind=VideoError,
    )


def resize_frame(image: np.ndarray, size: Size | None, crop: Size | None = None) -> np.ndarray:
    """A BGR frame as RGB: its central window `crop`, of that the aspect of `size`, resized."""
    if crop is not None:
        image = image[center_window(image.shape[:2], crop)]
    if size is not None and image.shape[:2] != size:
        check_memory(1, (*size, image.shape[2]))
        image = image[aspect_window(image.shape[:2], size)]
        shrinks = image.shape[0] >= size[0] and image.shape[1] >= size[1]
        image = cv2.resize(image, size[::-1], interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_CUBIC)
    return cv2.cvtColor(image, cv2.COLOR_BGR2RGB if image.shape[2] == 3 else cv2.COLOR_BGRA2RGBA)


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
    require(
        window[0] <= have[0] and window[1] <= have[1],
        "center_crop",
        expected=f"at most the frame's {format_size(have)}",
        got=f"{window[0]}x{window[1]}",
        cure="Crop a smaller window, or enlarge with size=(height, width) instead.",
        kind=VideoError,
    )
    top, left = (have[0] - window[0]) // 2, (have[1] - window[1]) // 2
    return slice(top, top + window[0]), slice(left, left + window[1])


def stack_frames(frames: Iterable[np.ndarray], channels: int = 3) -> np.ndarray:
    """All frames in one array, of 4 channels where any frame has as many, at least `channels`; others are opaque.

    The array grows by blocks, which the system moves without a copy, so that the peak is one copy of the clip. Raises
    `VideoError` where it is larger than `memory_limit()`.
    """
    clip, num = np.empty(0, np.uint8), 0
    for frame in frames:
        if num == 0:
            clip = np.empty((0, *frame.shape[:2], max(channels, frame.shape[2])), np.uint8)
        if frame.shape[2] > clip.shape[3]:
            clip = np.concatenate([clip, np.full_like(clip[..., :1], 255)], axis=-1)
        check_memory(num + 1, clip.shape[1:])
        if num == len(clip):
            clip.resize((num + max(1, BLOCK_BYTES // frame.nbytes), *clip.shape[1:]), refcheck=False)
        clip[num, ..., 3:] = 255
        clip[num, ..., : frame.shape[2]] = frame
        num += 1
    clip.resize((num, *clip.shape[1:]), refcheck=False)
    return clip
