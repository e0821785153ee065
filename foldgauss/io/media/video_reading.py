"""Reading clips: `read_video`, and `read_frames`, which detects the format."""

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from foldgauss.io._atomic import PathLike
from foldgauss.io.media.clip import (
    Clip,
    Levels,
    Range,
    Reading,
    ReadResult,
    Size,
    check_fps,
    check_frame_size,
    check_range,
    check_readable,
    check_reading,
    clamp_stop,
    describe_clamped,
    read_head,
    translate_os_errors,
    video_error,
)
from foldgauss.io.media.format_detection import may_be_animation
from foldgauss.io.media.frame_rate import DEFAULT_FPS, FrameRate, describe_rate
from foldgauss.io.media.image_files import choose_images, describe_missing, is_image_file, read_animation, read_images
from foldgauss.io.media.resizing import copy_to_blocks, describe_crop, make_resizer, stack_frames
from foldgauss.io.media.video_decoding import DecodeReport, decode_file


def read_video(
    path: PathLike,
    *,
    frames: Range | None = None,
    size: Size | None = None,
    fps: float | None = None,
    center_crop: Size | None = None,
    deinterlace: str = "frames",
    levels: int | None = None,
) -> Clip:
    """Read a video file, a folder of images in natural order (img2 before img10), or one image as a clip of one frame.

    `frames = (A, B)` keeps frames A <= i < B, None for an open end; of a clip that ends before
    B, those up to its end, with a note. `size = (height, width)` crops each frame to that
    aspect around its center (to whole pixels), then resizes it, by area averaging to shrink and by cubic interpolation
    to enlarge: (160, 320) of a 1280x720 clip is rows 40 to 680. `fps` overrides the rate of the container (25 for
    images). `center_crop = (height, width)` first crops that window around the center (an odd remainder is cut below
    and to the right). Frames are decoded one by one: memory is that of the output plus two source frames, and a clip
    that would take over a third of the machine's memory is refused. `Clip.notes` reports a `size` that crops much.

    Images of 16 bits are scaled to 8, and so are videos of 10 or more; gray ones get three equal channels. `levels`:
    the value of white in images and videos (RGB or gray) of 16 bits, 65,535 by default; 4095 for data of 12 bits, which
    are dark otherwise, as `Clip.notes` reports. HDR videos (PQ, HLG) are tone-mapped to SDR (ITU-R BT.2390). Colors of
    videos are converted by the matrix and the range that the file declares (BT.601 and limited where it does not), with
    interpolated chroma.

    Where any frame is transparent anywhere, the clip has alpha (see `Clip`), and opaque frames get an alpha of 255.
    Interlaced frames are converted to progressive ones by FFmpeg's bwdif. `deinterlace`: "frames" makes one of each,
    "fields" two, one of each field, at twice the rate (50i becomes 50p), and "refuse" raises. Where pixels are not
    square, frames are enlarged along one side until they are. Videos are rotated upright. A damaged one yields the
    frames that decode; see `Clip.num_declared`. Unevenly spaced frames are all kept; see `Clip.times`.

    The format is detected from the first bytes, not from the name. No file or address that `path` refers to is opened,
    such as the entries of a playlist. Images of more than 16384x16384 pixels are refused by their header.

    Raises `FileNotFoundError` for a missing path, `VideoError` for everything else that cannot be read.
    """
    path = check_readable(path)
    start, stop = check_range(frames)
    reading = check_reading(deinterlace, levels)
    resize = make_resizer(check_frame_size(size), check_frame_size(center_crop, "center_crop"))
    sizes = set()

    def prepare(image):
        sizes.add(image.shape[:2])
        return resize(image)

    if fps is not None:
        check_fps(fps)
    with translate_os_errors(path):
        found, report = read_frames(path, start, stop, lambda images: copy_to_blocks(map(prepare, images)), reading)
    kept, num_declared, rate, notes = found
    rate = rate if fps is None else FrameRate(fps)
    notes += describe_rate(rate)
    if size is not None and center_crop is None:
        notes += describe_crop(sizes, size)
    about = float(rate.fps), str(path), num_declared, rate.times, notes, rate.first_second, rate.duration, reading
    return Clip(stack_frames(kept), *about, report and report.stretched)


def read_frames(
    path: Path, start: int, stop: int | None, keep: Callable[[Iterator[np.ndarray]], list], reading: Reading
) -> tuple[ReadResult, DecodeReport | None]:
    """The frames of a clip from `start` up to `stop`, of which `keep` makes a list, and the report of a video file.

    They are BGR or premultiplied BGRA, as stored. Raises `VideoError` and OSError.
    """
    (kept, num_declared, rate, notes), report = _read_format(path, start, stop, keep, reading)
    return (kept, num_declared, rate, describe_clamped(num_declared, start, stop) + tuple(notes)), report


def _read_format(
    path: Path, start: int, stop: int | None, keep: Callable[[Iterator[np.ndarray]], list], reading: Reading
) -> tuple[ReadResult, DecodeReport | None]:
    """As `read_frames`, without the note about a range that ends beyond the clip."""
    may_move = not path.is_dir() and may_be_animation(read_head(path))
    if not (may_move or path.is_dir() or is_image_file(path)):
        return decode_file(path, start, stop, keep, reading)
    if reading.deinterlace == "fields":
        got, cure = f"images, {str(path)!r}", "Leave deinterlace='fields' out."
        raise video_error("deinterlace", expected="a video of interlaced frames", got=got, cure=cure)
    levels = Levels(reading.levels)
    if may_move and (found := read_animation(path, start, stop, keep)) is not None:
        levels.describe(path)
        return found, None
    if path.is_dir():
        paths = choose_images(path, start, stop)
    else:
        clamp_stop(start, stop, 1, path)
        paths = [path]
    kept, rate = keep(read_images(paths, levels)), FrameRate(DEFAULT_FPS)
    return (kept, len(paths), rate, describe_missing(paths) + levels.describe(path)), None
