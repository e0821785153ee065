"""Images of models: written as videos, folders or single images, and evaluated, with progress bars."""

import dataclasses
import os
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from foldgauss._runtime.checks import ParameterError, require
from foldgauss.cli.app.application import out
from foldgauss.cli.app.help import complete_choice
from foldgauss.cli.shared.arguments import Timeline
from foldgauss.cli.shared.console import Video, format_count, progress_bar
from foldgauss.cli.shared.files import IMAGE_SUFFIX
from foldgauss.io._atomic import write_or_keep
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


@dataclasses.dataclass(frozen=True)
class Output:
    """Where images go and how they are encoded: a video, an animation, a folder, or a .png for one image.

    `times`: seconds at which the images are shown, and the end; None where they are evenly spaced at `fps`.
    """

    path: Path
    fps: float
    overwrite: bool = False
    times: np.ndarray | None = None
    image_format: str = "png"
    codec: str | None = None
    crf: int | None = None
    pixel_format: str | None = None
    sound: Sound | None = None

    def check(self, size: tuple[int, int], num: int, background: Background = BLACK) -> None:
        """Refuse options that do not fit the kind of output, before `num` images of this size are computed."""
        suffix = self._suffix
        require(
            suffix != IMAGE_SUFFIX or num == 1,
            "--out",
            expected="one image for a .png",
            got=f"{num:,} images",
            cure="Choose it by --times T, or write to a folder (a name without extension).",
        )
        most = MAX_GIF_FPS if suffix == ".gif" else MAX_FPS
        require(
            not suffix or self.fps <= most,
            "--out",
            expected=f"at most {most:g} frames per second in it",
            got=f"{self.fps:g} for {self.path}",
            cure="Choose a lower rate, another format or a folder.",
        )
        require(
            background is not None or suffix not in ANIMATION_SUFFIXES,
            "--background",
            expected=f"a color for {suffix}",
            got="none",
            cure="Take .webm, .mov, .mkv or a folder.",
        )
        if suffix in VIDEO_SUFFIXES:
            shape = (*size, 4 if background is None else 3)
            try:
                choose_encoding(suffix, self.codec, self.crf, self.pixel_format, shape)
            except ParameterError as error:
                if error.parameter != "frames":
                    raise
                raise ParameterError("--out", error.problem) from error
            return
        for name in ("codec", "crf", "pixel_format", "sound"):
            require(
                getattr(self, name) is None,
                name,
                expected="a video file for it",
                got=repr(self.path.name),
                cure=f"Leave it out, or write {', '.join(VIDEO_SUFFIXES[:-1])} or {VIDEO_SUFFIXES[-1]}.",
            )

    def write(self, images: Callable[[], Iterable[np.ndarray]], num: int) -> None:
        """Write `num` images; where that fails, somewhere else."""
        if self._suffix == IMAGE_SUFFIX:
            image = next(iter(images()))
            out.print(f"{write_or_keep(self.path, lambda path: write_image(path, image))}: one image", soft_wrap=True)
            return
        names = ("overwrite", "times", "image_format", "codec", "crf", "pixel_format", "sound")
        options = {name: getattr(self, name) for name in names}

        def write(path: Path) -> Path:
            with progress_bar("Rendering", num) as advance:
                return write_video(path, _advance_over(images(), advance), min(self.fps, MAX_FPS), **options)

        path = write_or_keep(self.path, write)
        rate = f"at {self.fps:g} frames per second"
        if self.times is not None and self._suffix:
            rate = f"unevenly spaced as in the clip, {num / self.times[-1]:.4g} per second on average"
        out.print(f"{path}: {format_count(num, 'frame')} {rate}", soft_wrap=True)

    @property
    def _suffix(self) -> str:
        """The extension, in small letters; "" for a folder."""
        return "" if self.path.is_dir() else self.path.suffix.lower()


def _advance_over(items: Iterable[Any], advance: Callable[[], None]) -> Iterator[Any]:
    for item in items:
        yield item
        advance()


def choose_sound(path: Path | None, timeline: Timeline, about: dict[str, Any], fps: float) -> Sound | None:
    """The sound of the fitted frames in the file `path`. `about`: the model's metadata; `fps`: of the clip."""
    if path is None:
        return None
    require(
        timeline.remap is None and not timeline.is_single and timeline.chosen is None and (timeline.speed or 1.0) >= 0,
        "--sound",
        expected="a constant speed forwards",
        got="other times",
        cure="Leave --sound out.",
    )
    require(
        path.is_file(),
        "--sound",
        expected="a file",
        got=f"{str(path)!r}, which is {'none' if os.path.exists(path) else 'missing'}",
    )
    first = (about.get("frames") or (0,))[0] or 0
    return Sound(path, about.get("first_second", first / fps), timeline.speed or 1.0)


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
