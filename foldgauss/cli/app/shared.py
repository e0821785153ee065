"""What the commands share: consoles, options, arguments and how results are shown."""

import dataclasses
import json
import os
import re
from collections.abc import Callable, Collection, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Table

from foldgauss._runtime.checks import invalid
from foldgauss.cli.app.application import Stopped as Stopped
from foldgauss.cli.app.application import WrongUse, as_option, err, out
from foldgauss.cli.app.application import app as app
from foldgauss.cli.app.completion import clip_files, model_files
from foldgauss.io._atomic import atomic_path
from foldgauss.io.media.clip import Clip
from foldgauss.io.media.frame_index import index_video
from foldgauss.io.media.frame_rate import MAX_FPS
from foldgauss.io.media.lazy_frames import LazyFrames
from foldgauss.io.media.resizing import memory_limit
from foldgauss.io.media.video_reading import read_video
from foldgauss.io.media.video_writing import ANIMATION_SUFFIXES, MAX_GIF_FPS, VIDEO_SUFFIXES, write_image, write_video
from foldgauss.io.models.segmented import is_segmented
from foldgauss.io.models.video_model import load_video_model, read_origin
from foldgauss.io.provenance import describe_source as describe_source
from foldgauss.io.provenance import fingerprint as fingerprint
from foldgauss.io.provenance import has_other_frames
from foldgauss.render import RenderOptions
from foldgauss.video.editing.edited_video import EditedVideo
from foldgauss.video.models.background import BLACK
from foldgauss.video.models.metrics import Evaluation, evaluate
from foldgauss.video.models.video_model import VideoModel
from foldgauss.video.segmented.segmented_video import SegmentedVideo

#: What a model file holds.
Video = VideoModel | EditedVideo | SegmentedVideo

#: Of a bar, after the time that has gone.
TIME_LEFT = (TextColumn("left"), TimeRemainingColumn())

PICTURE_SUFFIX = ".png"
MAX_SHOWN = 100_000  # above, a clip of seconds plays for days

#: Panels of `--help`, beside that of the plain options.
PICTURE = "What a picture leaves out"

ModelFile = Annotated[Path, typer.Argument(metavar="MODEL", help="Model file.", autocompletion=model_files)]
FittedClip = Annotated[Path, typer.Argument(help="The clip it was fitted to.", autocompletion=clip_files)]
NewClip = Annotated[
    Path,
    typer.Argument(help="Video file, folder of images in natural order, or one image.", autocompletion=clip_files),
]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace an output that exists.")]
Size = Annotated[str | None, typer.Option(metavar="HxW", help="Height x width in pixels, as 160x320.")]
Frames = Annotated[
    str | None, typer.Option(metavar="A:B", help="Frames A up to, not including, B; either may be left out.")
]
#: Constants of the picture, `RenderOptions`.
AlphaCutoff = Annotated[
    float | None,
    typer.Option(
        help="Leave a Gaussian out where its alpha is below this [default: 1/255, or what was fitted with].",
        rich_help_panel=PICTURE,
    ),
]
SupportRadius = Annotated[
    float | None,
    typer.Option(
        help="Leave a Gaussian out beyond so many of its deviations [default: none, or as fitted].",
        rich_help_panel=PICTURE,
    ),
]
TransmittanceStop = Annotated[
    float | None,
    typer.Option(
        help="A pixel is finished once so little light is left [default: 1e-4, or as fitted].",
        rich_help_panel=PICTURE,
    ),
]


def parse_size(text: str | None) -> tuple[int, int] | None:
    if text is None:
        return None
    height, cross, width = text.lower().partition("x")
    if not (cross and height.isdecimal() and width.isdecimal() and int(height) > 0 and int(width) > 0):
        raise WrongUse(f"--size: expected HxW with both at least 1, as 160x320, got {text!r}.")
    return int(height), int(width)


def parse_frames(text: str | None) -> tuple[int | None, int | None] | None:
    if text is None:
        return None
    first, colon, last = text.partition(":")
    if not colon or any(part and not part.isdecimal() for part in (first, last)):
        raise WrongUse(f"--frames: expected A:B with whole numbers >= 0, as 0:24, got {text!r}.")
    return (int(first) if first else None), (int(last) if last else None)


def parse_color(text: str) -> tuple[float, float, float]:
    digits = text.removeprefix("#")
    if not re.fullmatch("[0-9a-fA-F]{6}", digits):
        raise WrongUse(f"--background: expected six hexadecimal digits RRGGBB, as ffffff for white, got {text!r}.")
    return tuple(byte / 255 for byte in bytes.fromhex(digits))


def with_constants(options: RenderOptions, **constants: float | None) -> RenderOptions:
    """`options` with those constants that were given. Raises WrongUse for one out of its bounds."""
    try:
        return dataclasses.replace(options, **{name: value for name, value in constants.items() if value is not None})
    except ValueError as error:
        raise WrongUse(as_option(str(error).removeprefix("RenderOptions."))) from error


def drawn_with(model: Video, **constants: float | None) -> Video:
    """The model, drawn with those constants that were given instead of its own. Raises as `with_constants`."""
    return model.with_options(with_constants(model.options, **constants))


def refuse_segments(model_path: Path) -> None:
    """For commands that take a model of one piece alone. Raises WrongUse, and as `load_video_model`."""
    if is_segmented(model_path):
        got = f"one of {len(load_video_model(model_path).segments):,} segments"
        cure = f"Take one out: foldgauss segment {model_path} 0."
        raise WrongUse(str(invalid("MODEL", expected="a model of one piece", got=got, cure=cure)))


def refuse_huge(size: tuple[int, int] | None) -> None:
    """A picture is held in floats, some copies of it."""
    if size is not None and 64 * size[0] * size[1] > memory_limit():
        raise WrongUse(f"--size: expected a picture that fits in memory, got {size[0]}x{size[1]}. Take a smaller one.")


def refuse_existing(path: Path, overwrite: bool, option: str = "--out") -> None:
    if os.path.exists(path) and not overwrite:
        raise WrongUse(f"{option}: {path} exists. Choose another path, or add --overwrite.")


def refuse_input(path: Path, what: str, source: Path, option: str = "--out") -> None:
    """An output in place of what it is made of would be lost with the first error."""
    # os.path: a name that is too long is none, here; making the file says so.
    if os.path.exists(path) and os.path.exists(source) and path.samefile(source):
        raise WrongUse(f"{option}: expected another file than the {what}, got {path}.")


def named_after(source: Path, ending: str) -> Path:
    """Where an output goes that was given no name: into this folder, by the name of what it is made of."""
    whole = source if source.name not in ("", "..") else source.resolve()
    return Path(f"{whole.name if whole.is_dir() else whole.stem}{ending}")


@contextmanager
def progress_bar(title: str, total: int, shown: bool = True) -> Iterator[Callable[[], None]]:
    columns = (
        TextColumn("{task.description}"),
        BarColumn(bar_width=24),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        *TIME_LEFT,
    )
    with Progress(*columns, console=err, disable=not (shown and err.is_terminal)) as progress:
        task = progress.add_task(title, total=total)
        yield lambda: progress.advance(task)


def counted(items: Iterable[Any], advance: Callable[[], None]) -> Iterator[Any]:
    for item in items:
        yield item
        advance()


def evaluate_with_progress(
    model: Video,
    frames: np.ndarray | LazyFrames,
    keep: Callable[[np.ndarray], None] = lambda picture: None,
    *,
    shown: bool = True,
    background: tuple[float, float, float] = BLACK,
) -> Evaluation:
    """Scores of every frame; `keep` is handed the pictures they were read off."""
    with progress_bar("Evaluating", model.num_frames, shown) as advance:

        def on_frame(picture: np.ndarray) -> None:
            keep(picture)
            advance()

        return evaluate(model, frames, on_frame, background=background)


def figures_of(model: Video, scores: Evaluation) -> dict[str, Any]:
    return {
        "mean_psnr": round(scores.mean_psnr, 3),
        "mean_ssim": round(scores.mean_ssim, 4),
        "lowest_psnr": round(min(scores.psnr), 3),
        "num_frames": model.num_frames,
        "height": model.size[0],
        "width": model.size[1],
        "num_gaussians": model.num_gaussians,
        "degree": model.degree,
    }


def scores_of(scores: Evaluation) -> dict[str, Any]:
    return {"mean_psnr": round(scores.mean_psnr, 3), "mean_ssim": round(scores.mean_ssim, 4)}


def tell_of(clip: Clip) -> None:
    """Say what of a clip is not as one would think: frames that are missing, uneven times."""
    if clip.num_declared > clip.num_frames:
        err.print(
            f"warning: only {clip.num_frames} of {clip.num_declared} frames of {clip.source} decode; those are used.",
            soft_wrap=True,
        )
    for note in clip.notes:
        err.print(f"warning: {clip.source}: {note}", soft_wrap=True)


def clip_of_model(model: Video, model_path: Path, video: Path, frames: str | None, *, as_many: bool = True) -> Clip:
    """The frames that a model was fitted to, at its size, or those named; says so where they are others.

    Those of a model in segments are `LazyFrames`: the clip may be larger than memory.

    Raises WrongUse, with `as_many`, for another number of frames than the model's.
    """
    about = read_origin(model_path)
    kept = about.get("frames")
    wanted = parse_frames(frames) if frames is not None else (tuple(kept) if kept else None)
    try:
        read = _lazy_clip if isinstance(model, SegmentedVideo) else read_video
        clip = read(video, frames=wanted, size=model.size)
    except ValueError as error:
        if frames is not None or not str(error).startswith("frames:"):
            raise
        asked = f"the clip that the model was fitted to, frames {wanted[0]}:{wanted[1]} of {about.get('clip')}"
        raise WrongUse(f"VIDEO: expected {asked}, got {str(video)!r}, which has fewer. Give that clip.") from error
    if as_many and clip.num_frames != model.num_frames:
        raise WrongUse(
            f"--frames: expected {model.num_frames} frames as in the model, got {clip.num_frames} of {clip.source!r}. "
            f"Name those that it was fitted to, as 0:{model.num_frames}."
        )
    _say_other_frames(about, clip)
    return clip


def _lazy_clip(video: Path, *, frames: tuple[int | None, int | None] | None, size: tuple[int, int]) -> Clip:
    """As `read_video`; no more than some frames are in memory."""
    with err.status(f"Looking through {video.name}"):
        index = index_video(video, frames=frames, find_cuts=False)
    lazy = LazyFrames(index, size)
    return Clip(lazy, index.fps, index.source, index.num_declared, index.times, index.notes)


def is_other_clip(model_path: Path, clip: Clip, got: Callable[[], float]) -> bool:
    """Whether `clip` is not what the model was fitted to: other frames, which it shows worse by `OTHER` dB.

    `got` gives the mean PSNR, and is asked only where the frames differ in some bit.
    """
    about = read_origin(model_path)
    had = about.get("mean_psnr")
    return had is not None and has_other_frames(about, clip) and got() < had - OTHER


#: dB: decoders differ by less.
OTHER = 3.0


def _say_other_frames(about: dict[str, Any], clip: Clip) -> None:
    """Any clip of the right size may be compared with a model, but not unawares."""
    if has_other_frames(about, clip):
        err.print(
            f"warning: the frames of {clip.source} are not those that the model was fitted to ({about.get('clip')}): "
            "another clip or range, or the same one decoded by another version of OpenCV.",
            soft_wrap=True,
        )


_LABELS = {
    "mean_psnr": ("mean PSNR", "{:.2f} dB"),
    "mean_psnr_on_white": ("mean PSNR over white", "{:.2f} dB"),
    "mean_ssim": ("mean SSIM", "{:.4f}"),
    "lowest_psnr": ("lowest PSNR of a frame", "{:.2f} dB"),
    "num_frames": ("frames", "{:,}"),
    "height": ("height", "{:,} px"),
    "width": ("width", "{:,} px"),
    "num_gaussians": ("Gaussians", "{:,}"),
    "degree": ("degree of the folds", "{}"),
    "fit_seconds": ("time spent fitting", "{:.1f} s"),
    "wall_seconds": ("time in all", "{:.1f} s"),
    "peak_mib": ("most memory of a process that fits", "{:,} MiB"),
    "num_segments": ("segments", "{:,}"),
    "seam_drop": ("PSNR lost where segments meet", "{:.2f} dB"),
    "steps": ("steps", "{:,}"),
    "stopped_by": ("stopped by", "{}"),
    "loss_db": ("loss", "{:.3f} dB"),
    "num_dropped": ("Gaussians left out", "{:,}"),
    "bytes_before": ("before", "{:,} bytes"),
    "file_bytes": ("model file", "{:,} bytes"),
    "frames_per_second": ("played", "{:.0f} frames a second"),
    "ratio": ("smaller by a factor of", "{:.2f}"),
    "bits_per_pixel": ("bits per pixel", "{:.3f}"),
}


def print_figures(title: str, figures: dict[str, Any]) -> None:
    table = Table(title=title, show_header=False)
    for name, value in figures.items():
        label, form = _LABELS[name]
        table.add_row(label, form.format(value))
    out.print(table)


def print_frames(scores: Evaluation) -> None:
    table = Table("frame", "PSNR (dB)", "SSIM")
    for k, (psnr, ssim) in enumerate(zip(scores.psnr, scores.ssim, strict=True)):
        table.add_row(str(k), f"{psnr:.2f}", f"{ssim:.4f}")
    out.print(table)


def short(value: Any) -> str:
    text = json.dumps(value) if isinstance(value, list | dict) else str(value)
    return text if len(text) <= 60 else text[:57] + "..."


def write_json(path: Path, figures: dict[str, Any]) -> None:
    with atomic_path(path) as temporary:
        temporary.write_text(json.dumps(figures, indent=2) + "\n")


def refuse_foreign(
    folder: Path, own: Collection[str], command: str, *, record: str, known: bool, cure: str = ""
) -> None:
    """A command replaces the files that it wrote into a folder, `own`, so nothing else may be among them.

    Nor may others of these names: they are its own if its `record` stands beside them, which is `known`.
    """
    try:
        names = {entry.name for entry in folder.iterdir() if not entry.name.startswith(".")}
    except OSError:  # missing, or no folder: making it says so
        return
    foreign, expected = sorted(names - set(own)), f"--out: expected a new folder or one that a {command} wrote"
    if foreign:
        raise WrongUse(f"{expected}, got {folder} with {foreign[0]!r} in it. Choose another folder.")
    if names and not known:
        got = f"{folder} with {min(names)!r} in it, but no {record} of a {command}"
        raise WrongUse(f"{expected}, got {got}. Choose another folder{cure}.")


def check_picture_path(path: Path, *, others: str = "", single: bool = False) -> None:
    """Refuse a name that pictures cannot be written to; with `single`, FILE.png is one for a picture alone."""
    wanted = (*VIDEO_SUFFIXES, *ANIMATION_SUFFIXES, *([PICTURE_SUFFIX] if single else []))
    if path.suffix and not path.is_dir() and path.suffix.lower() not in wanted:
        expected = ", ".join((others, *wanted) if others else wanted) + ", or a folder without extension"
        is_picture = path.suffix.lower() == PICTURE_SUFFIX
        cure = "One picture of a model: foldgauss render MODEL --times T --out FILE.png." if is_picture else ""
        raise WrongUse(str(invalid("--out", expected=expected, got=path, cure=cure)))


def draw(
    model: Video,
    path: Path,
    times: np.ndarray,
    rate: float,
    *,
    size: tuple[int, int] | None = None,
    background: tuple[float, float, float] = BLACK,
    image_format: str = "png",
    overwrite: bool = False,
) -> None:
    """Write the pictures at `times` to `path`, `rate` a second, with a bar; a picture alone to a .png."""
    if path.suffix.lower() == PICTURE_SUFFIX and not path.is_dir():
        if len(times) != 1:
            cure = "Choose it by --times T, or write to a folder (a name without extension)."
            got = f"{len(times):,} of them"
            raise WrongUse(str(invalid("--out", expected="one picture for a .png", got=got, cure=cure)))
        write_image(path, next(model.frames(times, size, background=background)))
        out.print(f"{path}: the picture at time {times[0]:g}", soft_wrap=True)
        return
    most = MAX_GIF_FPS if path.suffix.lower() == ".gif" else MAX_FPS
    if path.suffix and not path.is_dir() and rate > most:
        expected, cure = f"at most {most:g} frames a second", "Give a lower one, or write to a folder instead."
        raise WrongUse(str(invalid("--fps", expected=expected, got=f"{rate:g}", cure=cure)))
    with progress_bar("Rendering", len(times)) as advance:
        pictures = counted(model.frames(times, size, background=background), advance)
        kind = {"overwrite": overwrite, "image_format": image_format}
        write_video(path, pictures, min(rate, MAX_FPS), **kind)
    frames = "1 frame" if len(times) == 1 else f"{len(times):,} frames"
    out.print(f"{path}: {frames} at {rate:g} frames a second", soft_wrap=True)


def parse_times(text: str | None) -> np.ndarray | None:
    if text is None:
        return None
    expected = "numbers in [0, 1] as 0,0.5,1, or first:last:count as 0:1:50"
    try:
        if text.count(":") == 2:
            first, last, count = text.split(":")
            times = np.linspace(float(first), float(last), min(int(count), MAX_SHOWN + 1))
        else:
            times = np.array([float(part) for part in text.split(",")])
    except ValueError as error:
        raise WrongUse(str(invalid("--times", expected=expected, got=text))) from error
    if not (0 < len(times) <= MAX_SHOWN and ((times >= 0) & (times <= 1)).all()):
        raise WrongUse(str(invalid("--times", expected=expected, got=text)))
    return times
