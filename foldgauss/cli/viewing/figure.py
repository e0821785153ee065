"""The commands `figure interpolation` and `figure reconstruction`: labeled figures of rendered images."""

from functools import partial
from pathlib import Path
from typing import Annotated

import cv2
import numpy as np
import typer

from foldgauss.cli.app.application import app, out, warn, wrong_use
from foldgauss.cli.app.help import App
from foldgauss.cli.shared.arguments import FittedClip, FittedFrames, ModelFile, Overwrite
from foldgauss.cli.shared.clips import Video, read_fitted_clip
from foldgauss.cli.shared.contact_sheet import make_comparison_sheet, make_contact_sheet
from foldgauss.cli.shared.outputs import (
    IMAGE_SUFFIX,
    name_after,
    refuse_existing,
    refuse_huge,
    refuse_inputs,
    write_result,
)
from foldgauss.cli.shared.rendering import Flow
from foldgauss.io._atomic import check_writable
from foldgauss.io.media.writing import write_image
from foldgauss.io.models.video_model import load_video_model
from foldgauss.video.models.frame_times import times_at
from foldgauss.video.models.metrics import psnr
from foldgauss.video.motion.slow_motion import interpolate_frames

#: Parts of the interval between two frames; by default as in the paper: t, t + 1/4, t + 2/4, t + 3/4, t + 1.
PARTS, MAX_PARTS = 4, 32
#: Default number of frames of a reconstruction, largest number of rows, and smallest width of an image in pixels.
DEFAULT_FRAMES, MAX_ROWS, MIN_WIDTH = 3, 32, 16

figure = App(no_args_is_help=True)
app.add_typer(figure, name="figure", help="Make a labeled figure of images from a model: PNG.")

Out = Annotated[
    Path | None,
    typer.Option("--out", metavar="FILE.png", help="The figure [default: the model's name, in this folder]."),
]
Width = Annotated[int | None, typer.Option(help="Width of each image in pixels [default: that of the model].")]


@figure.command()
def interpolation(
    model_path: ModelFile,
    out_path: Out = None,
    at: Annotated[
        str | None,
        typer.Option(metavar="K,K,..", help="First frame of each row, from 0 [default: one near the middle]."),
    ] = None,
    parts: Annotated[int, typer.Option(help="Number of parts of the interval: 4 shows t, t+1/4, .. t+1.")] = PARTS,
    width: Width = None,
    flow: Flow = True,
    overwrite: Overwrite = False,
) -> None:
    """Show images between two frames: t, t+1/4, t+2/4, t+3/4, t+1."""
    if not 2 <= parts <= MAX_PARTS:
        raise wrong_use("--parts", expected=f"a whole number from 2 to {MAX_PARTS}", got=parts)
    out_path = _check_output(out_path, {"model": model_path}, "interpolation", overwrite)
    model = load_video_model(model_path)
    if model.num_frames < 2:
        raise wrong_use("MODEL", expected="at least 2 frames", got=model.num_frames)
    size, times = _size(model, width), np.asarray(model.frame_times.times())
    chosen = [_find_middle_interval(model)] if at is None else _parse_at(at, model.num_frames - 1)
    for k in sorted(set(chosen)):
        if model.frame_times.cut_after(k):
            warn(f"--at: there is a cut between frames {k} and {k + 1}: each time shows the nearer frame.")
    fractions = np.arange(parts + 1) / parts
    draw = partial(interpolate_frames, model) if flow else model.frames
    rows = [list(draw(times_at(times, k + fractions), size)) for k in chosen]
    inner = [f"t + {part}/{parts}" for part in range(1, parts)]
    titles = [[f"t: frame {k}", *inner, f"t + 1: frame {k + 1}"] for k in chosen]
    _write(out_path, make_contact_sheet(rows, titles), ", ".join(f"from frame {k} to {k + 1}" for k in chosen))


@figure.command()
def reconstruction(
    model_path: ModelFile,
    video: FittedClip,
    out_path: Out = None,
    at: Annotated[
        str | None,
        typer.Option(metavar="K,K,..", help=f"Frames of the model, from 0 [default: {DEFAULT_FRAMES}, evenly spaced]."),
    ] = None,
    width: Width = None,
    frames: FittedFrames = None,
    overwrite: Overwrite = False,
) -> None:
    """Show original frames, their reconstruction, and the difference, magnified.

    The PSNR above a row is measured at the size of the model, in 8 bits.
    """
    out_path = _check_output(out_path, {"model": model_path, "clip": video}, "reconstruction", overwrite)
    model = load_video_model(model_path)
    size, num = _size(model, width), model.num_frames
    if size[1] > model.size[1]:
        cure = "Frames are not enlarged."
        raise wrong_use("--width", expected=f"at most the model's {model.size[1]}", got=width, cure=cure)
    spread = sorted({int((k + 0.5) * num / DEFAULT_FRAMES) for k in range(DEFAULT_FRAMES)})
    chosen = spread if at is None else _parse_at(at, num)
    clip = read_fitted_clip(model, model_path, video, frames)
    originals = [np.ascontiguousarray(clip.frames[k][..., :3]) for k in chosen]  # over black
    images = list(model.frames(np.asarray(model.frame_times.times())[chosen]))
    quality = [psnr(*pair) for pair in zip(originals, images, strict=True)]
    captions = [f"frame {k}, {each:.1f} dB" for k, each in zip(chosen, quality, strict=True)]
    small = (
        [cv2.resize(one, size[::-1], interpolation=cv2.INTER_AREA) for one in every] for every in (originals, images)
    )
    _write(out_path, make_comparison_sheet(*small, captions), "; ".join(captions))


def _check_output(path: Path | None, inputs: dict[str, Path], kind: str, overwrite: bool) -> Path:
    path = name_after(inputs["model"], f".{kind}{IMAGE_SUFFIX}") if path is None else path
    if path.suffix.lower() != IMAGE_SUFFIX:
        raise wrong_use("--out", expected="a name ending in .png", got=path)
    refuse_inputs(path, inputs)
    refuse_existing(path, overwrite)
    check_writable(path)
    return path


def _size(model: Video, width: int | None) -> tuple[int, int]:
    """Height and width of each image, with the aspect ratio of the model."""
    if width is None:
        return model.size
    if width < MIN_WIDTH:
        raise wrong_use("--width", expected=f"at least {MIN_WIDTH}", got=width)
    size = max(round(width * model.size[0] / model.size[1]), 1), width
    refuse_huge(size, "--width")
    return size


def _parse_at(text: str, count: int) -> list[int]:
    """Frame numbers below `count`, in the order given."""
    parts = [part.strip() for part in text.split(",")]
    if not all(part.isdecimal() for part in parts) or any(int(part) >= count for part in parts):
        raise wrong_use("--at", expected=f"frames from 0 to {count - 1}, as 0,{count - 1}", got=text)
    if len(parts) > MAX_ROWS:
        raise wrong_use("--at", expected=f"at most {MAX_ROWS} frames", got=len(parts))
    return [int(part) for part in parts]


def _find_middle_interval(model: Video) -> int:
    """The first frame of the interval without a cut that is nearest the middle."""
    num = model.num_frames - 1
    nearest_first = sorted(range(num), key=lambda k: abs(k - (num - 1) / 2))
    return next((k for k in nearest_first if not model.frame_times.cut_after(k)), 0)


def _write(path: Path, image: np.ndarray, what: str) -> None:
    path = write_result(path, lambda path: write_image(path, image))
    out.print(f"{path}: {what}", soft_wrap=True)
