"""The command `render`."""

from functools import partial, reduce
from operator import or_
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from foldgauss._runtime.checks import check_one_of, require
from foldgauss.cli.app.application import command, out
from foldgauss.cli.app.help import complete_choice
from foldgauss.cli.shared.arguments import (
    AlphaCutoff,
    ModelFile,
    Overwrite,
    Size,
    SupportRadius,
    Timeline,
    TransmittanceStop,
    override_constants,
    parse_color,
    parse_remap,
    parse_size,
    parse_times,
    refuse_together,
)
from foldgauss.cli.shared.console import Video, print_shots, progress_bar
from foldgauss.cli.shared.files import IMAGE_SUFFIX, check_images_output, name_after, refuse_huge
from foldgauss.cli.shared.rendering import (
    Output,
    SoundFile,
    choose_sound,
)
from foldgauss.io.media.frame_rate import MAX_FPS, MIN_FPS
from foldgauss.io.media.writing import CODECS, IMAGE_FORMATS, VIDEO_SUFFIXES
from foldgauss.io.models.video_model import load_video_model, read_frame_seconds, read_origin
from foldgauss.video.editing.chain import edit
from foldgauss.video.editing.edited_video import as_edited
from foldgauss.video.motion.slow_motion import interpolate_frames
from foldgauss.video.motion.stabilization import BORDERS, MAX_ZOOM, SMOOTHING, stabilize
from foldgauss.video.segmented.segmented_video import SegmentedVideo

#: Panel of `--help`.
STABILIZED = "Stabilized"
#: How `--stabilize` moves the camera.
CAMERAS = ("smooth", "fixed")


@command("render")
def render(
    model_path: ModelFile,
    out_path: Annotated[
        Path | None,
        typer.Option(
            "--out",
            help="FILE.mp4, .webm, .mov, .mkv, .gif or .webp; a folder for images; FILE.png for one time "
            "[default: the model's name in this folder, .mp4, or .png for one time].",
        ),
    ] = None,
    size: Size = None,
    fps: Annotated[
        float | None,
        typer.Option(metavar="RATE", help="Frames per second [default: as the clip].", min=MIN_FPS, max=MAX_FPS),
    ] = None,
    speed: Annotated[float | None, typer.Option(help="Playback speed: 0.25 is slow motion, -1 backwards.")] = None,
    remap: Annotated[
        str | None,
        typer.Option(metavar="S=C,S=C,..", help="Second C of the clip at second S: 0=0,1=1,3=1,4=2 holds second 1."),
    ] = None,
    times: Annotated[
        str | None, typer.Option(metavar="T,T,..|A:B:N", help="These times of the model, in [0, 1]; or N from A to B.")
    ] = None,
    frame: Annotated[
        int | None, typer.Option(metavar="K", help="Frame K alone, at its learned time; -1 is the last.")
    ] = None,
    flow: Annotated[
        bool,
        typer.Option(
            "--flow/--no-flow", help="Between frames, average with a prediction by optical flow from the frames around."
        ),
    ] = True,
    background: Annotated[
        str,
        typer.Option(
            metavar="RRGGBB",
            help="Background color of a model of a clip with alpha, such as ffffff; none: images with alpha.",
        ),
    ] = "000000",
    layer: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME", help="Only this layer of a fit with masks; may be repeated."),
    ] = None,
    overwrite: Overwrite = False,
    camera: Annotated[
        str | None,
        typer.Option(
            "--stabilize",
            metavar="smooth|fixed",
            help="As a steadier camera would show it; fixed: one that stands still, each shot as its middle frame.",
            autocompletion=complete_choice(CAMERAS),
            rich_help_panel=STABILIZED,
        ),
    ] = None,
    smoothing: Annotated[
        float | None,
        typer.Option(
            metavar="SECONDS",
            help=f"Standard deviation of the filter that smooths the camera's path [default: {SMOOTHING:g}].",
            rich_help_panel=STABILIZED,
        ),
    ] = None,
    border: Annotated[
        str | None,
        typer.Option(
            help=f"Where frames end: crop (enlarge, at most {MAX_ZOOM:g}x), fill (by other frames), "
            "keep (background) [default: crop].",
            autocompletion=complete_choice(BORDERS),
            rich_help_panel=STABILIZED,
        ),
    ] = None,
    image_format: Annotated[
        str | None,
        typer.Option(
            "--format",
            help="Format of the images in a folder: png or webp, both lossless [default: png].",
            autocompletion=complete_choice(IMAGE_FORMATS),
        ),
    ] = None,
    codec: Annotated[
        str | None,
        typer.Option(
            help="h264 (default of .mp4), h265, av1, vp9 (of .webm), prores (of .mov) or ffv1 (of .mkv; lossless).",
            autocompletion=complete_choice(tuple(CODECS)),
        ),
    ] = None,
    crf: Annotated[
        int | None, typer.Option(help="Constant rate factor: smaller makes better and larger files [default: h264 16].")
    ] = None,
    pixel_format: Annotated[
        str | None,
        typer.Option(metavar="NAME", help="FFmpeg's name of the pixel format, such as yuv444p or yuv420p10le."),
    ] = None,
    sound: SoundFile = None,
    alpha_cutoff: AlphaCutoff = None,
    support_radius: SupportRadius = None,
    transmittance_stop: TransmittanceStop = None,
) -> None:
    """Render a model as a video: also between its frames, stabilized, or some of its layers."""
    timeline = Timeline(fps, speed, parse_remap(remap), parse_times(times), frame)
    image_size, background_color = parse_size(size), parse_color(background)
    if camera is not None:
        check_one_of("--stabilize", camera, CAMERAS)
    check_one_of("--border", border or BORDERS[0], BORDERS)
    for option, value in ({"--smoothing": smoothing, "--border": border} if camera is None else {}).items():
        require(value is None, option, expected="--stabilize too", got=f"{option} alone")
    if camera == "fixed":
        refuse_together("--stabilize fixed", {"--smoothing": smoothing})
    kind = "".join(f".{name}" for name in layer or ()) + ("" if camera is None else ".stable")
    out_path = _name_output(model_path, timeline, image_format, kind) if out_path is None else out_path
    if image_format is not None:
        check_one_of("--format", image_format, IMAGE_FORMATS)
        require(not out_path.suffix or out_path.is_dir(), "--format", expected="a folder as --out", got=out_path)
    check_images_output(out_path, overwrite, {"model": model_path, "sound": sound}, others=(IMAGE_SUFFIX,))
    model, about = _choose_layers(load_video_model(model_path), layer), read_origin(model_path)
    model = model.with_options(override_constants(model.options, alpha_cutoff, support_radius, transmittance_stop))
    image_size = image_size or model.size
    refuse_huge(image_size)
    seconds, sounding = read_frame_seconds(about, model.num_frames), choose_sound(sound, timeline, about, model.fps)
    rate = timeline.rate(model.fps, seconds)
    shown = timeline.times(np.asarray(model.frame_times.times()), model.fps, seconds)
    timeline.warn_of_end(model.num_frames, model.fps, seconds)
    stamps = timeline.stamps(seconds)
    encoding = {"codec": codec, "crf": crf, "pixel_format": pixel_format, "sound": sounding}
    output = Output(out_path, rate, overwrite, stamps, image_format or "png", encoding)
    output.check(image_size, len(shown), background_color)
    video = model
    if camera is not None:
        video = _stabilize(model, camera, SMOOTHING if smoothing is None else smoothing, border or BORDERS[0])
    draw = partial(interpolate_frames, video) if flow else video.frames
    output.write(partial(draw, shown, image_size, background=background_color), len(shown))


def _choose_layers(video: Video, chosen: list[str] | None) -> Video:
    """The video without the layers that have other names than those chosen."""
    if not chosen:
        return video
    parts = [one.model for one in video.segments] if isinstance(video, SegmentedVideo) else [video]
    names = {layer.name for part in parts for layer in as_edited(part).layers if layer.name}
    have = " or ".join(map(repr, sorted(names))) or "a file with layers, as fit --masks writes it"
    for name in chosen:
        require(name in names, "--layer", expected=have, got=repr(name))
    whole = edit(video)
    others = ~reduce(or_, (whole.select(layer=name).selection for name in chosen))
    return whole.select(others).vanish().video() if len(others) else video


def _stabilize(model: Video, camera: str, smoothing: float, border: str) -> Video:
    with progress_bar("Estimating the camera's path", model.num_frames) as advance:
        video = stabilize(model, smoothing=smoothing, fixed=camera == "fixed", border=border, on_frame=advance)
    print_shots(video.path.starts, video.path.times)
    if border == "crop" and f"{video.zoom:.2f}" != "1.00":
        out.print(f"Enlarged by {video.zoom:.2f} to hide the borders.")
    return video


def _name_output(model_path: Path, timeline: Timeline, image_format: str | None, kind: str) -> Path:
    """The default name of the video, image or folder; never that of the clip, which may be in this folder."""
    if image_format is not None:
        return Path(str(name_after(model_path, f"{kind}-frames")).replace(".", "-"))  # a folder has no extension
    suffix = IMAGE_SUFFIX if timeline.is_single else VIDEO_SUFFIXES[0]
    path = name_after(model_path, f"{kind}{suffix}")
    clip = read_origin(model_path).get("clip", path.name)  # if unknown, it may have that name
    return name_after(model_path, f".rendered{suffix}") if path.name == clip and not kind else path
