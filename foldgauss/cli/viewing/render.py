"""The command `render`."""

import dataclasses
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from foldgauss.cli.app.application import app, warn, wrong_use
from foldgauss.cli.app.completion import complete_choice
from foldgauss.cli.shared.arguments import (
    MAX_TIMES,
    AlphaCutoff,
    ModelFile,
    Overwrite,
    Size,
    SupportRadius,
    TransmittanceStop,
    override_constants,
    parse_color,
    parse_size,
    parse_times,
)
from foldgauss.cli.shared.outputs import (
    IMAGE_SUFFIX,
    check_image_path,
    name_after,
    refuse_existing,
    refuse_huge,
    refuse_input,
)
from foldgauss.cli.shared.rendering import render_to_file
from foldgauss.io._atomic import check_writable
from foldgauss.io.media.frame_rate import MAX_FPS
from foldgauss.io.media.video_writing import IMAGE_FORMATS, VIDEO_SUFFIXES
from foldgauss.io.models.video_model import load_video_model, read_origin
from foldgauss.video.models.frame_times import interpolated_times, played_positions, remapped_positions, times_at

MAX_UPSAMPLE, MAX_IMAGES = MAX_TIMES, 10 * MAX_TIMES
MIN_SPEED, MAX_SECONDS = 1e-4, 1e6


@app.command()
def render(
    model_path: ModelFile,
    out_path: Annotated[
        Path | None,
        typer.Option(
            "--out",
            help="FILE.mp4, .webm, .gif or .webp; a folder for images; FILE.png for one time "
            "[default: the model's name in this folder, .mp4, or .png for one time].",
        ),
    ] = None,
    size: Size = None,
    upsample: Annotated[int | None, typer.Option(help="Frames per original interval [default: 1].")] = None,
    fps: Annotated[
        float | None, typer.Option(help="Frames per second [default: as the clip; with --upsample K, K times as many].")
    ] = None,
    speed: Annotated[float | None, typer.Option(help="Playback speed: 0.25 is slow motion, -1 backwards.")] = None,
    remap: Annotated[
        str | None,
        typer.Option(metavar="S=C,S=C,..", help="Second C of the clip at second S: 0=0,1=1,3=1,4=2 holds second 1."),
    ] = None,
    times: Annotated[
        str | None, typer.Option(metavar="T,T,..|A:B:N", help="These times of the model, in [0, 1]; or N from A to B.")
    ] = None,
    background: Annotated[
        str, typer.Option(metavar="RRGGBB", help="Background color of a model of a clip with alpha, as ffffff.")
    ] = "000000",
    image_format: Annotated[
        str | None,
        typer.Option(
            "--format",
            help="Format of the images in a folder: png or webp, both lossless [default: png].",
            autocompletion=complete_choice(IMAGE_FORMATS),
        ),
    ] = None,
    alpha_cutoff: AlphaCutoff = None,
    support_radius: SupportRadius = None,
    transmittance_stop: TransmittanceStop = None,
    overwrite: Overwrite = False,
) -> None:
    """Render a model as a video, also between its frames."""
    timeline = _Timeline(upsample, fps, speed, _parse_remap(remap), parse_times(times))
    image_size, background_color = parse_size(size), parse_color(background)
    if out_path is None:
        out_path = _name_output(model_path, timeline, image_format)
    check_image_path(out_path, single=True)
    if image_format is not None and (out_path.suffix and not out_path.is_dir()):
        raise wrong_use("--format", expected="a folder as --out", got=out_path)
    if image_format is not None and image_format not in IMAGE_FORMATS:
        raise wrong_use("--format", expected="one of " + ", ".join(IMAGE_FORMATS), got=image_format)
    if not out_path.is_dir():
        refuse_input(out_path, "model", model_path)
        refuse_existing(out_path, overwrite)
        check_writable(out_path)
    model = load_video_model(model_path)
    constants = override_constants(model.options, alpha_cutoff, support_radius, transmittance_stop)
    model = model.with_options(constants)
    refuse_huge(image_size or model.size)
    shown, rate = timeline.times(np.asarray(model.frame_times.times()), model.fps), timeline.rate(model.fps)
    timeline.warn_of_end(model.num_frames, model.fps)
    render_to_file(
        model,
        out_path,
        shown,
        rate,
        size=image_size,
        background=background_color,
        image_format=image_format or "png",
        overwrite=overwrite,
    )


def _name_output(model_path: Path, timeline: "_Timeline", image_format: str | None) -> Path:
    """The default name of the video, image or folder; never that of the clip, which may be in this folder."""
    if image_format is not None:
        return name_after(model_path, "-frames")
    suffix = IMAGE_SUFFIX if timeline.chosen is not None and len(timeline.chosen) == 1 else VIDEO_SUFFIXES[0]
    path = name_after(model_path, suffix)
    clip = read_origin(model_path).get("clip", path.name)  # if unknown, it may have that name
    return name_after(model_path, f".rendered{suffix}") if path.name == clip else path


@dataclasses.dataclass(frozen=True)
class _Timeline:
    """Chooses the rendered times and the frame rate; `upsample`, `speed`, `remap` and `chosen` exclude each other."""

    upsample: int | None
    fps: float | None
    speed: float | None
    remap: list[tuple[float, float]] | None
    chosen: np.ndarray | None

    def __post_init__(self) -> None:
        ways = {"upsample": self.upsample, "speed": self.speed, "remap": self.remap, "times": self.chosen}
        given = [f"--{name}" for name, value in ways.items() if value is not None]
        if len(given) > 1:
            raise wrong_use(given[0], expected="one way to choose times", got=" and ".join(given))
        if self.upsample is not None and not 1 <= self.upsample <= MAX_UPSAMPLE:
            expected = f"a whole number from 1 to {MAX_UPSAMPLE:,}"
            raise wrong_use("--upsample", expected=expected, got=self.upsample)
        if self.fps is not None and not 0 < self.fps <= MAX_FPS:
            raise wrong_use("--fps", expected=f"a rate in (0, {MAX_FPS:g}]", got=self.fps)
        if self.speed is not None and not MIN_SPEED <= abs(self.speed) <= 1 / MIN_SPEED:
            expected = f"a number from {MIN_SPEED:g} to {1 / MIN_SPEED:g}, or the same below 0"
            raise wrong_use("--speed", expected=expected, got=self.speed)

    def rate(self, fps: float) -> float:
        """Frames per second of the output, given those of the clip."""
        return fps * (self.upsample or 1) if self.fps is None else self.fps

    def times(self, frame_times: np.ndarray, fps: float) -> np.ndarray:
        """The model times to render, in order."""
        if self.chosen is not None:
            return self.chosen
        if self.upsample is not None:
            self._refuse_long("--upsample", (len(frame_times) - 1) * self.upsample)
            return interpolated_times(frame_times, self.upsample)
        rate = self.rate(fps) / fps
        if self.remap is not None:
            self._refuse_long("--remap", self.remap[-1][0] * fps * rate)
            return times_at(frame_times, remapped_positions(self.remap, fps, rate))
        speed = self.speed or 1.0
        if self.speed is not None or self.fps is not None:  # otherwise it has as many frames as the clip
            self._refuse_long("--speed", (len(frame_times) - 1) * rate / abs(speed))
        return times_at(frame_times, played_positions(len(frame_times), rate, speed=speed))

    def warn_of_end(self, num_frames: int, fps: float) -> None:
        """Warn if `remap` exceeds the clip, whose last frame ends at num_frames / fps."""
        last = 0.0 if self.remap is None else max(of_clip for _, of_clip in self.remap)
        if last > num_frames / fps * (1 + 1e-6):
            warn(
                f"--remap: expected seconds up to the end of the clip, {num_frames / fps:.4g}, got {last:.4g}. "
                "Its last frame is held from there on."
            )

    def _refuse_long(self, option: str, num_images: float) -> None:
        if num_images > MAX_IMAGES:
            expected = f"at most {MAX_IMAGES:,} images"
            raise wrong_use(option, expected=expected, got=f"{num_images:,.0f}")


def _parse_remap(text: str | None) -> list[tuple[float, float]] | None:
    if text is None:
        return None
    pairs = [part.partition("=") for part in text.split(",")]
    try:
        points = [(float(shown), float(of_clip)) for shown, _, of_clip in pairs]
        if points[-1][0] > MAX_SECONDS:
            raise ValueError("too long")
        remapped_positions(points, fps=1.0)
    except ValueError as error:
        expected = "seconds shown = seconds of the clip, the former rising from 0, as 0=0,1=1,3=1,4=2"
        raise wrong_use("--remap", expected=expected, got=text) from error
    return points
