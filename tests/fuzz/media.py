"""Targets: pictures, videos, HDF5 and arrays of NumPy, which libraries decode."""

import contextlib
import functools
import io
import warnings
from pathlib import Path
from random import Random

import av
import cv2
import numpy as np
from PIL import Image

from foldgauss.io import VideoError, read_masks, read_video, write_video
from foldgauss.io.media.clip import MAX_PIXELS

from .models import written
from .mutate import by_chance, png_resealed
from .target import CONSTANT, Target, chance

_NUMBERS = np.array([[0, 1, 1, 2], [0, 0, 2, 255], [3, 1, 0, 0]], np.uint8)


def _image(mode: str, format: str, **options) -> bytes:
    file = io.BytesIO()
    image = Image.fromarray(_NUMBERS)
    if mode == "P":
        image = Image.fromarray(_NUMBERS, "L").convert("P")
        image.putpalette(bytes(range(256)) * 3)
    elif mode == "1":
        image = Image.fromarray(np.where(_NUMBERS > 0, 255, 0).astype(np.uint8)).convert("1")
    elif mode != "L":
        image = image.convert(mode)
    image.save(file, format, **options)
    return file.getvalue()


def _images() -> list[bytes]:
    made = [_image(mode, "PNG") for mode in ("P", "L", "1", "RGB", "RGBA")]
    made += [_image("L", "BMP"), _image("L", "TIFF"), _image("L", "TIFF", compression="tiff_lzw")]
    return [*made, _image("RGB", "WEBP", lossless=True)]


def _picture_memory(size: int) -> int:
    """As many pixels as are taken, 4 channels of a byte, decoded and copied."""
    return 2 * CONSTANT + 12 * MAX_PIXELS


#: What is asked for besides: a label, a size, the folder that the image is alone in, frames of it.
_ASKED = ({}, {}, {"label": 1}, {"size": (2, 3)}, {"folder": True}, {"folder": True, "frames": (0, 1)})


#: What no image, folder or video bears being asked for.
_REFUSED = ({"label": 0}, {"label": 255}, {"level": 0.5}, {"frames": (0, 9)}, {"level": 2.0}, {"size": (0, 1)})


def _refused(path: Path) -> None:
    for given in _REFUSED:
        with contextlib.suppress(ValueError):
            read_masks(path, **given)


def _read_mask(path: Path) -> None:
    given = dict(_ASKED[chance(path) % len(_ASKED)])
    folder = given.pop("folder", False)
    if chance(path) % 8 == 0:
        _refused(path.parent if folder else path)
    masks = read_masks(path.parent if folder else path, **given)
    assert (masks.dtype, masks.ndim) == (bool, 3 if folder else 2)


MASKS = Target(
    "masks",
    ".png",
    _images,
    _read_mask,
    (ValueError, VideoError),
    (png_resealed,),
    lambda data: 8 if data.startswith(b"\x89PNG") else 2,
    _picture_memory,
)


# ---------------------------------------------------------------------------------------------- pictures, videos


def _more_images() -> list[bytes]:
    """What masks cannot be: of 16 bits, JPEG, gray with alpha, and those that move."""
    deep = cv2.imencode(".png", _NUMBERS.astype(np.uint16) << 8)[1].tobytes()
    frames = np.random.default_rng(0).integers(0, 255, (3, 6, 8, 3), np.uint8)
    moving = [written(lambda path: write_video(path, frames, 10), suffix) for suffix in (".webp", ".gif")]
    file = io.BytesIO()
    first, *others = (Image.fromarray(frame).convert("RGBA") for frame in frames)
    first.save(file, "PNG", save_all=True, append_images=others, duration=[40, 120, 40])
    return [
        deep,
        _image("LA", "TIFF"),
        _image("RGB", "JPEG"),
        _image("L", "JPEG", progressive=True),
        *moving,
        file.getvalue(),
    ]


def _read_picture(path: Path) -> None:
    clip = read_video(path.parent if chance(path) % 4 == 0 else path)
    assert (clip.frames.dtype, clip.frames.ndim) == (np.uint8, 4)


PICTURES = Target(
    "pictures",
    ".png",
    lambda: [*_images(), *_more_images()],
    _read_picture,
    (VideoError,),
    (png_resealed,),
    lambda data: 8,
    lambda size: 1 << 32,  # the library's own limit is 2^30 pixels
)


#: Files that PyAV writes: extension, encoder, pixel format, options.
_ENCODED = (
    (".avi", "mjpeg", "yuvj420p", {}), (".mp4", "mpeg4", "yuv420p", {"bf": "2"}), (".ts", "mpeg2video", "yuv420p", {}),
    (".mkv", "ffv1", "yuva420p", {}), (".webm", "libvpx-vp9", "yuva420p", {}), (".mov", "prores_ks", "yuv422p10le", {}),
    (".mkv", "libx264", "yuv420p", {"flags": "+ilme+ildct", "bf": "2"}), (".wmv", "wmv2", "yuv420p", {}),
    (".flv", "flv", "yuv420p", {}), (".mp4", "libx264", "yuv420p", {"movflags": "frag_keyframe+empty_moov"}),
    (".mp4", "libx264", "yuv420p10le", {"color_trc": "arib-std-b67"}),
    (".mkv", "ffv1", "yuva420p10le", {"color_trc": "smpte2084"}),
)  # fmt: skip


def _encode(path: Path, frames: np.ndarray, codec: str, pixel_format: str, options: dict[str, str]) -> None:
    muxing = {name: options[name] for name in ("movflags",) if name in options}
    with av.open(str(path), "w", options=muxing) as container:
        rest = {name: value for name, value in options.items() if name not in muxing}
        stream = container.add_stream(codec, rate=10, options=rest)
        stream.height, stream.width, stream.pix_fmt = *frames.shape[1:3], pixel_format
        for frame in frames:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format="rgb24")))
        container.mux(stream.encode())


@functools.cache
def _clips() -> tuple[bytes, ...]:
    frames = np.random.default_rng(0).integers(0, 255, (5, 16, 24, 3), np.uint8)
    found = [written(lambda path: write_video(path, frames, 10), suffix) for suffix in (".mp4", ".webm", ".gif")]
    for suffix, *encoding in _ENCODED:
        found.append(written(lambda path, how=encoding: _encode(path, frames, *how), suffix))
    uneven = [0, 0.1, 0.3, 0.32, 0.5, 1.5]
    found += [written(lambda path: write_video(path, frames, 10, times=uneven), suffix) for suffix in (".mp4", ".mkv")]
    return tuple(found)


def _clip_body(data: bytes) -> int:
    """Past what tells the kind: the first box of an MP4, Matroska's own header, a GIF's screen, an AVI's list."""
    if data[4:8] == b"ftyp":
        return min(int.from_bytes(data[:4], "big"), len(data))
    return min({b"\x1aE\xdf\xa3": 40, b"GIF8": 13, b"RIFF": 12}.get(data[:4], 0), len(data))


_WANTED = (
    {}, {"size": (8, 12), "frames": (0, 2)}, {"center_crop": (4, 4)}, {"frames": (1, 3)},
    {"fps": 12.5, "size": (4, 20)}, {"frames": (0, 1)}, {"frames": (1, None)}, {},
)  # fmt: skip


def _resized_box(data: bytes, random: Random) -> bytes:
    """A box of an MP4 of another size: none, one of 64 bits, the rest, beyond the end."""
    boxes = (b"ftyp", b"free", b"mdat", b"moov", b"trak", b"edts", b"elst", b"mdia", b"hdlr")
    at = data.index(random.choice([box for box in boxes if box in data]), 4)
    return data[: at - 4] + random.choice((0, 1, 4, 8, 60, 1 << 31)).to_bytes(4, "big") + data[at:]


def _read_clip(path: Path) -> None:
    number = chance(path) % 8
    if number == 0:
        with warnings.catch_warnings(action="ignore"):  # about how the clip was read
            assert read_masks(path).dtype == bool
            _refused(path)
    clip = read_video(path, **_WANTED[number])
    assert clip.num_frames >= 1


VIDEO = Target(
    "video",
    ".mp4",
    lambda: list(_clips()),
    _read_clip,
    (VideoError,),
    (by_chance, _resized_box),
    _clip_body,
    lambda size: 1 << 32,
)

TARGETS = (MASKS, PICTURES, VIDEO)
