"""The commands that make a picture of pictures from any model: `figure interpolation` and `figure reconstruction`."""

from pathlib import Path
from typing import Annotated

import cv2
import numpy as np
import typer

from foldgauss.cli.app.application import WrongUse, app, err, out, wrong_use
from foldgauss.cli.app.help import App
from foldgauss.cli.shared.arguments import FittedClip, ModelFile, Overwrite
from foldgauss.cli.shared.clips import Video, read_fitted_clip
from foldgauss.cli.shared.outputs import IMAGE_SUFFIX, name_after, refuse_existing, refuse_huge
from foldgauss.io._atomic import check_writable
from foldgauss.io.media.contact_sheet import make_comparison_sheet, make_contact_sheet
from foldgauss.io.media.video_writing import write_image
from foldgauss.io.models.video_model import load_video_model
from foldgauss.video.models.frame_times import times_at
from foldgauss.video.models.metrics import psnr

#: As in the paper: t, t + 1/4, t + 2/4, t + 3/4, t + 1.
PARTS, MAX_PARTS = 4, 32
#: Frames that a reconstruction shows unasked, rows that a picture may have, and the least width of a picture in it.
SHOWN, MAX_ROWS, LEAST_WIDTH = 3, 32, 16

figure = App(no_args_is_help=True)
app.add_typer(figure, name="figure", help="Make a labeled figure of images from a model: PNG.")

Out = Annotated[
    Path | None,
    typer.Option("--out", metavar="FILE.png", help="The picture [default: by the model's name, in this folder]."),
]
Width = Annotated[int | None, typer.Option(help="Pixels of each picture across [default: the model's own].")]


@figure.command()
def interpolation(
    model_path: ModelFile,
    out_path: Out = None,
    at: Annotated[
        str | None,
        typer.Option(metavar="K,K,..", help="Frames that rows begin with, from 0 [default: one near the middle]."),
    ] = None,
    parts: Annotated[int, typer.Option(help="Of the way to the next frame: 4 shows t, t+1/4, .. t+1.")] = PARTS,
    width: Width = None,
    overwrite: Overwrite = False,
) -> None:
    """What the model shows between two frames: t, t+1/4, t+2/4, t+3/4, t+1."""
    if not 2 <= parts <= MAX_PARTS:
        raise wrong_use("--parts", expected=f"a whole number from 2 to {MAX_PARTS}", got=parts)
    out_path = _checked_out(out_path, model_path, "interpolation", overwrite)
    model = load_video_model(model_path)
    if model.num_frames < 2:
        cure = "Between the frames of one picture lies nothing."
        raise wrong_use("MODEL", expected="at least 2 frames", got=model.num_frames, cure=cure)
    size, times = _size(model, width), np.asarray(model.frame_times.times())
    chosen = [_near_the_middle(model)] if at is None else _parse_at(at, model.num_frames - 1)
    for k in sorted(set(chosen)):
        if model.frame_times.cut_after(k):
            text = f"warning: --at: between frames {k} and {k + 1} is a cut: each half is the nearer frame."
            err.print(text, soft_wrap=True)
    shares = np.arange(parts + 1) / parts
    rows = [list(model.frames(times_at(times, k + shares), size)) for k in chosen]
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
        typer.Option(metavar="K,K,..", help=f"Frames of the model, from 0 [default: {SHOWN}, evenly spread]."),
    ] = None,
    width: Width = None,
    frames: Annotated[
        str | None, typer.Option(metavar="A:B", help="Frames of VIDEO [default: those that it was fitted to].")
    ] = None,
    overwrite: Overwrite = False,
) -> None:
    """Frames as they were, as the model has them, and the difference, magnified.

    The PSNR above a row is that of the frame at the model's own size, in 8 bits.
    """
    out_path = _checked_out(out_path, model_path, "reconstruction", overwrite)
    model = load_video_model(model_path)
    size, num = _size(model, width), model.num_frames
    if size[1] > model.size[1]:
        cure = "Frames are not enlarged."
        raise wrong_use("--width", expected=f"at most the model's {model.size[1]}", got=width, cure=cure)
    spread = sorted({int((k + 0.5) * num / SHOWN) for k in range(SHOWN)})
    chosen = spread if at is None else _parse_at(at, num)
    clip = read_fitted_clip(model, model_path, video, frames)
    originals = [np.ascontiguousarray(clip.frames[k][..., :3]) for k in chosen]  # over black
    pictures = list(model.frames(np.asarray(model.frame_times.times())[chosen]))
    quality = [psnr(*pair) for pair in zip(originals, pictures, strict=True)]
    captions = [f"frame {k}, {each:.1f} dB" for k, each in zip(chosen, quality, strict=True)]
    small = (
        [cv2.resize(one, size[::-1], interpolation=cv2.INTER_AREA) for one in every] for every in (originals, pictures)
    )
    _write(out_path, make_comparison_sheet(*small, captions), "; ".join(captions))


def _checked_out(path: Path | None, model_path: Path, kind: str, overwrite: bool) -> Path:
    path = name_after(model_path, f".{kind}{IMAGE_SUFFIX}") if path is None else path
    if path.suffix.lower() != IMAGE_SUFFIX:
        raise wrong_use("--out", expected="a name ending in .png", got=path)
    refuse_existing(path, overwrite)
    check_writable(path)
    return path


def _size(model: Video, width: int | None) -> tuple[int, int]:
    """Height and width of each picture: the model's, or in proportion."""
    if width is None:
        return model.size
    if width < LEAST_WIDTH:
        raise wrong_use("--width", expected=f"at least {LEAST_WIDTH}", got=width)
    size = max(round(width * model.size[0] / model.size[1]), 1), width
    try:
        refuse_huge(size)
    except WrongUse as error:
        raise WrongUse(str(error).replace("--size", "--width")) from error
    return size


def _parse_at(text: str, count: int) -> list[int]:
    """Frame numbers below `count`, in the order given."""
    parts = [part.strip() for part in text.split(",")]
    if not all(part.isdecimal() for part in parts) or any(int(part) >= count for part in parts):
        raise wrong_use("--at", expected=f"frames from 0 to {count - 1}, as 0,{count - 1}", got=text)
    if len(parts) > MAX_ROWS:
        raise wrong_use("--at", expected=f"at most {MAX_ROWS} frames", got=len(parts))
    return [int(part) for part in parts]


def _near_the_middle(model: Video) -> int:
    """The first frame of the interval nearest the middle that is no cut."""
    num = model.num_frames - 1
    nearest_first = sorted(range(num), key=lambda k: abs(k - (num - 1) / 2))
    return next((k for k in nearest_first if not model.frame_times.cut_after(k)), 0)


def _write(path: Path, picture: np.ndarray, what: str) -> None:
    write_image(path, picture)
    out.print(f"{path}: {what}", soft_wrap=True)
