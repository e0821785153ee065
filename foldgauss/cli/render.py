"""The commands that show a model: `render`, `evaluate` and `info`."""

import dataclasses
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.table import Table

from foldgauss._runtime.checks import invalid, is_within
from foldgauss.cli.app.completion import among
from foldgauss.cli.app.shared import (
    MAX_SHOWN,
    PICTURE_SUFFIX,
    AlphaCutoff,
    FittedClip,
    ModelFile,
    Overwrite,
    Size,
    SupportRadius,
    TransmittanceStop,
    Video,
    WrongUse,
    app,
    check_picture_path,
    clip_of_model,
    draw,
    drawn_with,
    err,
    evaluate_with_progress,
    figures_of,
    named_after,
    out,
    parse_color,
    parse_size,
    parse_times,
    print_figures,
    print_frames,
    refuse_existing,
    refuse_huge,
    refuse_input,
    short,
    write_json,
)
from foldgauss.io._atomic import check_writable
from foldgauss.io.media.frame_rate import MAX_FPS
from foldgauss.io.media.video_writing import IMAGE_FORMATS, VIDEO_SUFFIXES
from foldgauss.io.models.compact import is_compact
from foldgauss.io.models.video_model import load_video_model, read_metadata, read_origin
from foldgauss.video.editing.edited_video import EditedVideo, as_edited
from foldgauss.video.models.frame_times import interpolated_times, played_positions, remapped_positions, times_at
from foldgauss.video.models.metrics import Evaluation
from foldgauss.video.models.sparse_storage import stored_counts, to_stored
from foldgauss.video.models.video_model import VideoModel
from foldgauss.video.segmented.segmented_video import SegmentedVideo
from foldgauss.video.tradeoff import measure_frame_rate

MAX_UPSAMPLE, MAX_PICTURES = MAX_SHOWN, 10 * MAX_SHOWN
MIN_SPEED, MAX_SECONDS = 1e-4, 1e6
#: That `info` lists one by one.
MOST_SEGMENTS = 100


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
        float | None, typer.Option(help="Frames a second [default: the clip's; with --upsample K, K times that].")
    ] = None,
    speed: Annotated[
        float | None, typer.Option(help="How fast time goes by: 0.25 is slow motion, -1 backwards.")
    ] = None,
    remap: Annotated[
        str | None,
        typer.Option(metavar="S=C,S=C,..", help="Second C of the clip at second S: 0=0,1=1,3=1,4=2 holds second 1."),
    ] = None,
    times: Annotated[
        str | None, typer.Option(metavar="T,T,..|A:B:N", help="These times of the model, in [0, 1]; or N from A to B.")
    ] = None,
    background: Annotated[
        str, typer.Option(metavar="RRGGBB", help="Colour behind a model of a clip with alpha, as ffffff.")
    ] = "000000",
    image_format: Annotated[
        str | None,
        typer.Option(
            "--format",
            help="Of the images in a folder: png or webp, both exact [default: png].",
            autocompletion=among(IMAGE_FORMATS),
        ),
    ] = None,
    alpha_cutoff: AlphaCutoff = None,
    support_radius: SupportRadius = None,
    transmittance_stop: TransmittanceStop = None,
    overwrite: Overwrite = False,
) -> None:
    """Draw a model as a video, in between its frames too."""
    course = _Course(upsample, fps, speed, _parse_remap(remap), parse_times(times))
    picture_size, behind = parse_size(size), parse_color(background)
    if out_path is None:
        out_path = _named_after_model(model_path, course, image_format)
    check_picture_path(out_path, single=True)
    if image_format is not None and (out_path.suffix and not out_path.is_dir()):
        raise WrongUse(str(invalid("--format", expected="a folder as --out", got=out_path)))
    if image_format is not None and image_format not in IMAGE_FORMATS:
        raise WrongUse(str(invalid("--format", expected="one of " + ", ".join(IMAGE_FORMATS), got=image_format)))
    if not out_path.is_dir():
        refuse_input(out_path, "model", model_path)
        refuse_existing(out_path, overwrite)
        check_writable(out_path)
    constants = {"support_radius": support_radius, "transmittance_stop": transmittance_stop}
    model = drawn_with(load_video_model(model_path), alpha_cutoff=alpha_cutoff, **constants)
    refuse_huge(picture_size or model.size)
    shown, rate = course.times(np.asarray(model.frame_times.times()), model.fps), course.rate(model.fps)
    course.warn_of_end(model.num_frames, model.fps)
    how = {"size": picture_size, "background": behind, "overwrite": overwrite}
    draw(model, out_path, shown, rate, image_format=image_format or "png", **how)


def _named_after_model(model_path: Path, course: "_Course", image_format: str | None) -> Path:
    """A video, a picture or a folder by the model's name: never that of the clip, which may well lie here."""
    if image_format is not None:
        return named_after(model_path, "-frames")
    suffix = PICTURE_SUFFIX if course.chosen is not None and len(course.chosen) == 1 else VIDEO_SUFFIXES[0]
    path = named_after(model_path, suffix)
    clip = read_origin(model_path).get("clip", path.name)  # where it is not known, it may be of that name
    return named_after(model_path, f".rendered{suffix}") if path.name == clip else path


@dataclasses.dataclass(frozen=True)
class _Course:
    """Which times are shown, and how fast: the options of `render`, at most one of the last four but `fps`."""

    upsample: int | None
    fps: float | None
    speed: float | None
    remap: list[tuple[float, float]] | None
    chosen: np.ndarray | None

    def __post_init__(self) -> None:
        ways = {"upsample": self.upsample, "speed": self.speed, "remap": self.remap, "times": self.chosen}
        given = [f"--{name}" for name, value in ways.items() if value is not None]
        if len(given) > 1:
            raise WrongUse(str(invalid(given[0], expected="one way to choose times", got=" and ".join(given))))
        if self.upsample is not None and not 1 <= self.upsample <= MAX_UPSAMPLE:
            expected = f"a whole number from 1 to {MAX_UPSAMPLE:,}"
            raise WrongUse(str(invalid("--upsample", expected=expected, got=self.upsample)))
        if self.fps is not None and not 0 < self.fps <= MAX_FPS:
            raise WrongUse(str(invalid("--fps", expected=f"a rate in (0, {MAX_FPS:g}]", got=self.fps)))
        if self.speed is not None and not MIN_SPEED <= abs(self.speed) <= 1 / MIN_SPEED:
            expected = f"a number from {MIN_SPEED:g} to {1 / MIN_SPEED:g}, or the same below 0"
            raise WrongUse(str(invalid("--speed", expected=expected, got=self.speed)))

    def rate(self, fps: float) -> float:
        """Frames a second of what is shown, given the clip's."""
        return fps * (self.upsample or 1) if self.fps is None else self.fps

    def times(self, frame_times: np.ndarray, fps: float) -> np.ndarray:
        """The model times that are shown, in their order."""
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
        if self.speed is not None or self.fps is not None:  # a clip's own frames are as many as there are
            self._refuse_long("--speed", (len(frame_times) - 1) * rate / abs(speed))
        return times_at(frame_times, played_positions(len(frame_times), rate, speed=speed))

    def warn_of_end(self, num_frames: int, fps: float) -> None:
        """Say so where more of the clip is asked for than there is: its last frame lasts until num_frames / fps."""
        asked = 0.0 if self.remap is None else max(of_clip for _, of_clip in self.remap)
        if asked > num_frames / fps * (1 + 1e-6):
            err.print(
                f"warning: --remap: the clip ends at second {num_frames / fps:.4g}, {asked:.4g} was asked for: "
                "its last frame is held from there on.",
                soft_wrap=True,
            )

    def _refuse_long(self, option: str, num_pictures: float) -> None:
        if num_pictures > MAX_PICTURES:
            expected = f"at most {MAX_PICTURES:,} pictures"
            raise WrongUse(str(invalid(option, expected=expected, got=f"{num_pictures:,.0f} of them")))


@app.command(name="evaluate")
def evaluate_command(
    model_path: ModelFile,
    video: FittedClip,
    json_path: Annotated[
        Path | None, typer.Option("--json", metavar="FILE.json", help="Write the figures here, too.")
    ] = None,
    frames: Annotated[
        str | None,
        typer.Option(
            metavar="A:B",
            help="Frames A up to, not including, B of the clip, as many as the model has "
            "[default: those that it was fitted to].",
        ),
    ] = None,
    alpha_cutoff: AlphaCutoff = None,
    support_radius: SupportRadius = None,
    transmittance_stop: TransmittanceStop = None,
    overwrite: Overwrite = False,
) -> None:
    """Compare a model with its clip: PSNR and SSIM of every frame.

    Of a model in segments those of each segment are shown; --json has the frames'.

    Tells the size of the file, its bits per pixel and how fast it is drawn, too.
    """
    if json_path is not None:
        for what, source in (("model", model_path), ("clip", video)):
            refuse_input(json_path, what, source, "--json")
        refuse_existing(json_path, overwrite, "--json")
        check_writable(json_path)
    constants = {"support_radius": support_radius, "transmittance_stop": transmittance_stop}
    model = drawn_with(load_video_model(model_path), alpha_cutoff=alpha_cutoff, **constants)
    clip = clip_of_model(model, model_path, video, frames)
    scores = evaluate_with_progress(model, clip.frames)
    num_bytes = model_path.stat().st_size
    figures = figures_of(model, scores) | {"file_bytes": num_bytes}
    if clip.has_alpha:
        on_white = evaluate_with_progress(model, clip.frames, background=(1.0, 1.0, 1.0))
        figures["mean_psnr_on_white"] = round(on_white.mean_psnr, 3)
    figures["bits_per_pixel"] = 8 * num_bytes / (model.num_frames * model.size[0] * model.size[1])
    figures["frames_per_second"] = round(measure_frame_rate(model), 1)
    if json_path is not None:
        write_json(json_path, figures | {"psnr": scores.psnr, "ssim": scores.ssim})
    _print_segments(model, scores) if isinstance(model, SegmentedVideo) else print_frames(scores)
    print_figures(str(model_path), figures)


def _print_segments(model: SegmentedVideo, scores: Evaluation) -> None:
    """A row for each segment, by the frames that it begins: those of a clip of hours are too many for a screen."""
    table = Table("segment", "frames", "PSNR (dB)", "lowest", "SSIM")
    stops = [segment.first for segment in model.segments[1:]] + [model.num_frames]
    for number, (segment, stop) in enumerate(zip(model.segments, stops, strict=True)):
        psnr, ssim = scores.psnr[segment.first : stop], scores.ssim[segment.first : stop]
        quality = (f"{np.mean(psnr):.2f}", f"{min(psnr):.2f}", f"{np.mean(ssim):.4f}")
        table.add_row(str(number), f"{segment.first:,}:{stop:,}", *quality)
    out.print(table)


@app.command()
def info(model_path: ModelFile) -> None:
    """Say what a model file holds."""
    model = load_video_model(model_path)
    about = read_metadata(model_path)
    if isinstance(model, SegmentedVideo):
        _tell_of_segments(model_path, model, about)
        return
    powers = sorted({f"{float(one.model.splats.envelope.power):g}" for one in as_edited(model).layers})
    figures = {
        "frames": _frames_told(model),
        "Gaussians": f"{model.num_gaussians:,}",
        "fold": f"polynomial of degree {model.degree}",
        **_economies(model),
        "envelope": f"time likelihood, power {' and '.join(powers)} (paper's text 1, its code 2)",
        "frame times": _about_times(np.asarray(model.frame_times.times())),
        "parameters stored": f"{model.num_parameters:,}",
        "file": _size_of(model_path, model),
    }
    if isinstance(model, EditedVideo):
        figures["edits"] = ", ".join(
            f"{len(one.overlays) + len(one.clocks)} on {one.num_gaussians:,} Gaussians" for one in model.layers
        )
    _print_facts(model_path, figures, about)


def _print_facts(model_path: Path, figures: dict[str, str], about: dict) -> None:
    table = Table(title=str(model_path), show_header=False)
    # What was noted of the frames fitted to stands beside what the model's own frames are.
    noted = {f"{k} of the clip" if k in figures else k: short(v) for k, v in about.items() if v is not None}
    for name, value in (figures | noted).items():
        table.add_row(name, value)
    out.print(table)


def _tell_of_segments(model_path: Path, model: SegmentedVideo, about: dict) -> None:
    """What the header says: no model is loaded."""
    cuts, fades = len(model.cuts), len(model.segments) - 1 - len(model.cuts)
    joints = f"; begin at a cut: {cuts:,}; fade in: {fades:,}" if len(model.segments) > 1 else ""
    figures = {
        "frames": _frames_told(model),
        "segments": f"{len(model.segments):,}{joints}",
        "Gaussians": f"{model.num_gaussians:,} in all",
        "fold": f"polynomial of degree {model.degree}",
        "parameters stored": f"{model.num_parameters:,}",
        "file": _size_of(model_path, model),
    }
    _print_facts(model_path, figures, about)
    table = Table("segment", "frames", "begins", "Gaussians", "PSNR (dB)")
    before = None
    for number, segment in enumerate(model.segments[:MOST_SEGMENTS]):
        shared = 0 if before is None else before.stop - segment.first
        begins = "" if before is None else f"fading in over {shared:,}" if shared else "at a cut"
        quality = segment.metadata.get("mean_psnr")
        row = (f"{segment.first:,}:{segment.stop:,}", begins, f"{segment.num_gaussians:,}")
        table.add_row(str(number), *row, f"{quality:.2f}" if is_within(quality, "(0, 100]") else "")
        before = segment
    out.print(table)
    if len(model.segments) > MOST_SEGMENTS:
        out.print(f"and {len(model.segments) - MOST_SEGMENTS:,} more segments")


def _frames_told(model: Video) -> str:
    return f"{model.num_frames:,} of {model.size[0]}x{model.size[1]} (height x width), {model.fps:g} a second"


def _economies(model: VideoModel | EditedVideo) -> dict[str, str]:
    """What Gaussians do without, where some do."""
    parts = [layer.model.splats for layer in as_edited(model).layers]
    degrees = np.concatenate([splats.degrees for splats in parts])
    told = {}
    if any((splats.degrees < splats.degree).any() for splats in parts):
        counts = zip(*np.unique(degrees, return_counts=True), strict=True)
        told["degrees"] = ", ".join(f"{degree} of {count:,} Gaussians" for degree, count in counts)
    if static := sum(int(splats.static.sum()) for splats in parts):
        told["static"] = f"{static:,} of {len(degrees):,} Gaussians, throughout the clip"
    if opaque := sum(int(splats.opaque.sum()) for splats in parts):
        told["opaque"] = f"{opaque:,} of {len(degrees):,} Gaussians, without transmittance"
    counted = [(splats.num_gaussians, stored_counts(to_stored(splats))) for splats in parts]
    for what, name in (("colors", "colours"), ("shapes", "shapes")):
        # Where most have their own, what is alike is so by chance, as of rounded numbers.
        few = [(num, counts[what]) for num, counts in counted if 2 * counts.get(what, num) <= num]
        shared = [f"{count:,}, shared by {num:,} Gaussians" for num, count in few]
        if shared:
            told[name] = ", ".join(shared)
    return told


def _about_times(times: np.ndarray) -> str:
    if len(times) == 1:
        return "one frame alone, shown at all times"
    return f"learned, steps {np.diff(times).min():.2e} to {np.diff(times).max():.2e}"


def _size_of(path: Path, model: Video) -> str:
    num_bytes, num_pixels = path.stat().st_size, model.num_frames * model.size[0] * model.size[1]
    kind = "compact, " if is_compact(path) else ""
    return f"{kind}{num_bytes:,} bytes, {8 * num_bytes / num_pixels:.3f} bits per pixel of the frames"


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
        raise WrongUse(str(invalid("--remap", expected=expected, got=text))) from error
    return points
