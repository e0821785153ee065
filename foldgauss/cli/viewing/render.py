"""The command `render`."""

from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from foldgauss.cli.app.application import app, wrong_use
from foldgauss.cli.app.completion import complete_choice
from foldgauss.cli.shared.arguments import (
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
    check_images_output,
    name_after,
    refuse_huge,
)
from foldgauss.cli.shared.rendering import (
    CodecName,
    Crf,
    Flow,
    PixelFormat,
    SoundFile,
    VideoOptions,
    choose_sound,
    render_to_file,
)
from foldgauss.cli.shared.timeline import Fps, SkipRepeats, Speed, Timeline, Upsample, parse_remap
from foldgauss.io.media.writing import IMAGE_FORMATS, VIDEO_SUFFIXES
from foldgauss.io.models.video_model import load_video_model, read_frame_seconds, read_origin


@app.command()
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
    upsample: Upsample = None,
    fps: Fps = None,
    speed: Speed = None,
    skip_repeats: SkipRepeats = False,
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
    background: Annotated[
        str,
        typer.Option(
            metavar="RRGGBB",
            help="Background color of a model of a clip with alpha, such as ffffff; none: images with alpha.",
        ),
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
    codec: CodecName = None,
    crf: Crf = None,
    pixel_format: PixelFormat = None,
    sound: SoundFile = None,
    flow: Flow = True,
    overwrite: Overwrite = False,
) -> None:
    """Render a model as a video, also between its frames."""
    timeline = Timeline(upsample, fps, speed, parse_remap(remap), parse_times(times), frame)
    image_size, background_color = parse_size(size), parse_color(background)
    if out_path is None:
        out_path = _name_output(model_path, timeline, image_format)
    check_image_path(out_path, single=True)
    if image_format is not None and (out_path.suffix and not out_path.is_dir()):
        raise wrong_use("--format", expected="a folder as --out", got=out_path)
    if image_format is not None and image_format not in IMAGE_FORMATS:
        raise wrong_use("--format", expected="one of " + ", ".join(IMAGE_FORMATS), got=image_format)
    check_images_output(out_path, {"model": model_path, "sound": sound}, overwrite)
    model = load_video_model(model_path)
    constants = override_constants(model.options, alpha_cutoff, support_radius, transmittance_stop)
    model = model.with_options(constants)
    refuse_huge(image_size or model.size)
    about = read_origin(model_path)
    options = VideoOptions(codec, crf, pixel_format, choose_sound(sound, timeline, about, model.fps))
    seconds = read_frame_seconds(about, model.num_frames)
    rate = timeline.rate(model.fps, seconds)
    if skip_repeats:
        timeline, seconds = timeline.without_repeats(model, seconds, sound)
    shown = timeline.times(np.asarray(model.frame_times.times()), model.fps, seconds)
    timeline.warn_of_end(model.num_frames, model.fps, seconds)
    render_to_file(
        model,
        out_path,
        shown,
        rate,
        size=image_size,
        background=background_color,
        image_format=image_format or "png",
        overwrite=overwrite,
        options=options,
        flow=flow,
        stamps=timeline.stamps(model.fps, seconds),
    )


def _name_output(model_path: Path, timeline: Timeline, image_format: str | None) -> Path:
    """The default name of the video, image or folder; never that of the clip, which may be in this folder."""
    if image_format is not None:
        return name_after(model_path, "-frames")
    suffix = IMAGE_SUFFIX if timeline.is_single else VIDEO_SUFFIXES[0]
    path = name_after(model_path, suffix)
    clip = read_origin(model_path).get("clip", path.name)  # if unknown, it may have that name
    return name_after(model_path, f".rendered{suffix}") if path.name == clip else path
