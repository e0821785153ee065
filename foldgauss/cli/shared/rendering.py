"""Frames of models with a progress bar: rendered to files, and evaluated."""

import os
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
import typer
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from foldgauss.cli.app.application import WrongUse, err, name_option, out, wrong_use
from foldgauss.cli.app.completion import complete_choice
from foldgauss.cli.shared.clips import Video
from foldgauss.cli.shared.log_lines import FIRST_LINE_SECONDS, LINE_SECONDS
from foldgauss.cli.shared.outputs import IMAGE_SUFFIX, write_result
from foldgauss.cli.shared.tables import format_count
from foldgauss.cli.shared.timeline import Timeline
from foldgauss.io.media.frame_rate import MAX_FPS
from foldgauss.io.media.indexing import LazyFrames
from foldgauss.io.media.writing import (
    ANIMATION_SUFFIXES,
    CODECS,
    MAX_GIF_FPS,
    VIDEO_SUFFIXES,
    Sound,
    choose_encoding,
    write_image,
    write_video,
)
from foldgauss.video.models.background import BLACK, Background
from foldgauss.video.models.metrics import Evaluation, evaluate
from foldgauss.video.motion.slow_motion import interpolate_frames

CodecName = Annotated[
    str | None,
    typer.Option(
        "--codec",
        help="h264 (default of .mp4), h265, av1, vp9 (of .webm), prores (of .mov) or ffv1 (of .mkv; lossless).",
        autocompletion=complete_choice(tuple(CODECS)),
    ),
]
Crf = Annotated[
    int | None, typer.Option(help="Constant rate factor: smaller makes better and larger files [default: h264 16].")
]
PixelFormat = Annotated[
    str | None, typer.Option(metavar="NAME", help="FFmpeg's name of the pixel format, such as yuv444p or yuv420p10le.")
]
SoundFile = Annotated[
    Path | None,
    typer.Option(
        "--sound",
        help="File whose sound the video gets, usually the fitted clip; stretched in slow motion, with its pitch kept.",
    ),
]

Flow = Annotated[
    bool,
    typer.Option(
        "--flow/--no-flow", help="Between frames, average with a prediction by optical flow from the frames around."
    ),
]


def video_option(suffix: str) -> Any:
    """The option `--out` of a command that writes a video, by default the model's name with this suffix."""
    kinds = "FILE.mp4, .webm, .mov, .mkv, .gif or .webp; a folder for images"
    return typer.Option("--out", help=f"{kinds} [default: the model's name in this folder, {suffix}].")


class VideoOptions(NamedTuple):
    """Options of `write_video` for video files."""

    codec: str | None = None
    crf: int | None = None
    pixel_format: str | None = None
    sound: Sound | None = None


def check_video_options(
    path: Path, size: tuple[int, int], fps: float, options: VideoOptions, background: Background = BLACK
) -> None:
    """Refuse options that do not fit the output `path` for such frames, before they are computed."""
    suffix = path.suffix.lower()
    _check_rate(path, fps)
    _refuse_transparent(path, background)
    if suffix not in VIDEO_SUFFIXES:
        _refuse_options(path, options)
    if suffix not in VIDEO_SUFFIXES or path.is_dir():
        return
    try:
        choose_encoding(
            suffix, options.codec, options.crf, options.pixel_format, (*size, 4 if background is None else 3)
        )
    except ValueError as error:
        raise WrongUse(name_option(str(error)) if str(error).startswith(options._fields) else str(error)) from error


def _refuse_transparent(path: Path, background: Background) -> None:
    """Refuse images with alpha for a GIF or WebP."""
    suffix = path.suffix.lower()
    if background is None and suffix in ANIMATION_SUFFIXES and not path.is_dir():
        expected, cure = f"a color for {suffix}", "Take .webm, .mov, .mkv or a folder."
        raise wrong_use("--background", expected=expected, got="none", cure=cure)


def _check_rate(path: Path, fps: float) -> None:
    most = MAX_GIF_FPS if path.suffix.lower() == ".gif" else MAX_FPS
    if path.suffix and not path.is_dir() and fps > most:
        expected, cure = f"at most {most:g} frames per second in it", "Choose a lower rate, another format or a folder."
        raise wrong_use("--out", expected=expected, got=f"{fps:g} for {path}", cure=cure)


def _refuse_options(path: Path, options: VideoOptions) -> None:
    """Refuse options of video files for another kind of output."""
    given = [name for name, value in options._asdict().items() if value is not None]
    if given:
        cure = f"Leave it out, or write {', '.join(VIDEO_SUFFIXES[:-1])} or {VIDEO_SUFFIXES[-1]}."
        raise wrong_use(
            f"--{given[0].replace('_', '-')}", expected="a video file for it", got=repr(path.name), cure=cure
        )


def choose_sound(path: Path | None, timeline: Timeline, about: dict[str, Any], fps: float) -> Sound | None:
    """The sound of the fitted frames in the file `path`. `about`: the model's metadata; `fps`: of the clip."""
    if path is None:
        return None
    if timeline.remap is not None or timeline.chosen is not None or timeline.is_single or (timeline.speed or 1.0) < 0:
        raise wrong_use("--sound", expected="a constant speed forwards", got="other times", cure="Leave --sound out.")
    if not path.is_file():
        got = f"{str(path)!r}, which is {'none' if os.path.exists(path) else 'missing'}"
        raise wrong_use("--sound", expected="a file", got=got)
    first = (about.get("frames") or (0,))[0] or 0
    return Sound(path, about.get("first_second", first / fps), timeline.playing_speed(fps))


#: Columns of a progress bar after the elapsed time.
TIME_LEFT = (TextColumn("left"), TimeRemainingColumn())


@contextmanager
def progress_bar(title: str, total: int, shown: bool = True) -> Iterator[Callable[[], None]]:
    """A progress bar on a terminal, elsewhere a line now and then; yields the function that advances it."""
    columns = TextColumn("{task.description}"), BarColumn(bar_width=24), MofNCompleteColumn(), TimeElapsedColumn()
    with Progress(*columns, *TIME_LEFT, console=err, disable=not (shown and err.is_terminal)) as progress:
        task = progress.add_task(title, total=total)
        due = time.monotonic() + FIRST_LINE_SECONDS

        def advance() -> None:
            nonlocal due
            progress.advance(task)
            if shown and not err.is_terminal and time.monotonic() > due:
                due = time.monotonic() + LINE_SECONDS
                done = progress.tasks[task].completed
                err.print(f"{title}: {done:,.0f} of {total:,}", soft_wrap=True)

        yield advance


def advance_over(items: Iterable[Any], advance: Callable[[], None]) -> Iterator[Any]:
    """The items; `advance` is called after each."""
    for item in items:
        yield item
        advance()


def evaluate_with_progress(
    model: Video,
    frames: np.ndarray | LazyFrames,
    on_image: Callable[[np.ndarray], None] = lambda image: None,
    *,
    shown: bool = True,
    background: tuple[float, float, float] = BLACK,
) -> Evaluation:
    """Scores of every frame; `on_image` receives the rendered images."""
    with progress_bar("Evaluating", model.num_frames, shown) as advance:

        def on_frame(image: np.ndarray) -> None:
            on_image(image)
            advance()

        return evaluate(model, frames, on_frame, background=background)


def render_to_file(
    model: Video,
    path: Path,
    times: np.ndarray,
    fps: float,
    *,
    size: tuple[int, int] | None = None,
    background: Background = BLACK,
    image_format: str = "png",
    overwrite: bool = False,
    options: VideoOptions = VideoOptions(),  # noqa: B008
    flow: bool = True,
    stamps: np.ndarray | None = None,
) -> None:
    """Write the images at `times` as a video or to a folder, or a single image to a .png.

    `flow`: between frames, averages with predictions by optical flow, see `interpolate_frames`. `stamps`: seconds at
    which the images are shown; None where they are evenly spaced at `fps`.
    """
    _refuse_transparent(path, background)
    render = partial(interpolate_frames, model) if flow else model.frames
    images = partial(render, times, size, background=background)
    if path.suffix.lower() == IMAGE_SUFFIX and not path.is_dir():
        if len(times) != 1:
            cure = "Choose it by --times T, or write to a folder (a name without extension)."
            raise wrong_use("--out", expected="one image for a .png", got=f"{len(times):,} images", cure=cure)
        _refuse_options(path, options)
        image = next(images())
        path = write_result(path, lambda path: write_image(path, image))
        out.print(f"{path}: the image at time {times[0]:g}", soft_wrap=True)
        return
    how = {"image_format": image_format, "overwrite": overwrite, "options": options, "stamps": stamps}
    write_images(path, images, len(times), fps, **how)


def write_images(
    path: Path,
    images: Callable[[], Iterable[np.ndarray]],
    num: int,
    fps: float,
    *,
    image_format: str = "png",
    overwrite: bool = False,
    options: VideoOptions = VideoOptions(),  # noqa: B008
    stamps: np.ndarray | None = None,
) -> None:
    """Write `num` images as a video or to a folder, elsewhere if that fails. `stamps`: as in `render_to_file`."""
    _check_rate(path, fps)

    def write(path: Path) -> Path:
        how = {"overwrite": overwrite, "image_format": image_format, "times": stamps, **options._asdict()}
        with progress_bar("Rendering", num) as advance:
            try:
                return write_video(path, advance_over(images(), advance), min(fps, MAX_FPS), **how)
            except ValueError as error:
                if not str(error).startswith(VideoOptions._fields):
                    raise
                raise WrongUse(name_option(str(error))) from error

    path = write_result(path, write)
    rate = f"at {fps:g} frames per second"
    if stamps is not None and path.suffix and not path.is_dir():
        rate = f"unevenly spaced as in the clip, {num / stamps[-1]:.4g} per second on average"
    out.print(f"{path}: {format_count(num, 'frame')} {rate}", soft_wrap=True)
