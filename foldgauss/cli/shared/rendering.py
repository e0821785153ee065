"""Images of models: written as videos, folders or single images, and evaluated, with progress bars."""

import dataclasses
import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from foldgauss._runtime.checks import ParameterError, require
from foldgauss.cli.app.application import out
from foldgauss.cli.shared.arguments import Timeline
from foldgauss.cli.shared.console import Video, format_count, progress_bar
from foldgauss.cli.shared.files import IMAGE_SUFFIX
from foldgauss.io._atomic import write_or_keep
from foldgauss.io.media.frame_rate import MAX_FPS
from foldgauss.io.media.indexing import LazyFrames
from foldgauss.io.media.writing import (
    ANIMATION_SUFFIXES,
    MAX_GIF_FPS,
    VIDEO_SUFFIXES,
    Sound,
    choose_encoding,
    write_image,
    write_video,
)
from foldgauss.video.models.background import BLACK, Background
from foldgauss.video.models.metrics import Evaluation, evaluate

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
    `encoding`: options of `write_video` for video files, such as `codec`; None where they are not given.
    """

    path: Path
    fps: float
    overwrite: bool = False
    times: np.ndarray | None = None
    image_format: str = "png"
    encoding: Mapping[str, Any] = dataclasses.field(default_factory=dict)

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
            chosen = [self.encoding.get(name) for name in ("codec", "crf", "pixel_format")]
            try:
                choose_encoding(suffix, *chosen, shape)
            except ParameterError as error:
                if error.parameter != "frames":
                    raise
                raise ParameterError("--out", error.problem) from error
            return
        for name, value in self.encoding.items():
            require(
                value is None,
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
        options = {"overwrite": self.overwrite, "times": self.times, "image_format": self.image_format}

        def write(path: Path) -> Path:
            with progress_bar("Rendering", num) as advance:
                shown = advance_over(images(), advance)
                return write_video(path, shown, min(self.fps, MAX_FPS), **options, **self.encoding)

        path = write_or_keep(self.path, write)
        rate = f"at {self.fps:g} frames per second"
        if self.times is not None and self._suffix:
            rate = f"unevenly spaced as in the clip, {num / self.times[-1]:.4g} per second on average"
        out.print(f"{path}: {format_count(num, 'frame')} {rate}", soft_wrap=True)

    @property
    def _suffix(self) -> str:
        """The extension, in small letters; "" for a folder."""
        return "" if self.path.is_dir() else self.path.suffix.lower()


def advance_over(items: Iterable[Any], advance: Callable[[], None]) -> Iterator[Any]:
    """The items; after each the progress advances."""
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
    *,
    shown: bool = True,
    background: tuple[float, float, float] = BLACK,
) -> Evaluation:
    """Scores of every frame."""
    with progress_bar("Evaluating", model.num_frames, shown) as advance:
        return evaluate(model, frames, lambda _: advance(), background=background)
