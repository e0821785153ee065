"""The command `stabilize`."""

from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from foldgauss.cli.app.application import WrongUse, app, name_option, out, wrong_use
from foldgauss.cli.app.completion import complete_choice
from foldgauss.cli.shared.arguments import ModelFile, Overwrite, Size, parse_color, parse_size
from foldgauss.cli.shared.log_lines import print_shots
from foldgauss.cli.shared.outputs import check_image_path, check_images_output, name_after, refuse_huge
from foldgauss.cli.shared.rendering import (
    CodecName,
    Crf,
    Flow,
    PixelFormat,
    SoundFile,
    VideoOptions,
    check_video_options,
    choose_sound,
    progress_bar,
    render_to_file,
    video_option,
)
from foldgauss.cli.shared.timeline import Fps, SkipRepeats, Speed, Timeline, Upsample
from foldgauss.io.media.writing import VIDEO_SUFFIXES
from foldgauss.io.models.video_model import load_video_model, read_frame_seconds, read_origin
from foldgauss.video.motion.stabilization import BORDERS, MAX_ZOOM, SMOOTHING, stabilize


@app.command("stabilize")
def stabilize_command(
    model_path: ModelFile,
    out_path: Annotated[Path | None, video_option(".stable.mp4")] = None,
    smoothing: Annotated[
        float, typer.Option(metavar="SECONDS", help="Standard deviation of the filter that smooths the camera's path.")
    ] = SMOOTHING,
    fixed: Annotated[
        bool, typer.Option("--fixed", help="The camera stands still: each shot as its middle frame shows it.")
    ] = False,
    border: Annotated[
        str,
        typer.Option(
            help=f"Where frames end: crop (enlarge, at most {MAX_ZOOM:g}x), fill (by other frames), keep (background).",
            autocompletion=complete_choice(BORDERS),
        ),
    ] = "crop",
    size: Size = None,
    upsample: Upsample = None,
    fps: Fps = None,
    speed: Speed = None,
    skip_repeats: SkipRepeats = False,
    background: Annotated[
        str, typer.Option(metavar="RRGGBB", help="Background color, such as ffffff; none: with alpha.")
    ] = "000000",
    codec: CodecName = None,
    crf: Crf = None,
    pixel_format: PixelFormat = None,
    sound: SoundFile = None,
    flow: Flow = True,
    overwrite: Overwrite = False,
) -> None:
    """Render a model as a steadier camera would show it."""
    timeline, image_size, background_color = Timeline(upsample, fps, speed), parse_size(size), parse_color(background)
    if border not in BORDERS:
        raise wrong_use("--border", expected="one of " + ", ".join(BORDERS), got=border)
    if out_path is None:
        out_path = name_after(model_path, f".stable{VIDEO_SUFFIXES[0]}")
    check_image_path(out_path)
    check_images_output(out_path, {"model": model_path, "sound": sound}, overwrite)
    if fixed and smoothing != SMOOTHING:
        raise wrong_use("--fixed", expected="no --smoothing", got="both; the camera stands still")
    model = load_video_model(model_path)
    refuse_huge(image_size or model.size)
    about = read_origin(model_path)
    options = VideoOptions(codec, crf, pixel_format, choose_sound(sound, timeline, about, model.fps))
    seconds = read_frame_seconds(about, model.num_frames)
    rate = timeline.rate(model.fps, seconds)
    if skip_repeats:
        timeline, seconds = timeline.without_repeats(model, seconds, sound)
    shown = timeline.times(np.asarray(model.frame_times.times()), model.fps, seconds)
    check_video_options(out_path, image_size or model.size, rate, options, background_color)
    with progress_bar("Estimating the camera's path", model.num_frames) as advance:
        try:
            video = stabilize(model, smoothing=smoothing, fixed=fixed, border=border, on_frame=advance)
        except ValueError as error:
            raise WrongUse(name_option(str(error))) from error
    print_shots(video.path.starts, video.path.times)
    if border == "crop" and f"{video.zoom:.2f}" != "1.00":
        out.print(f"Enlarged by {video.zoom:.2f} to hide the borders.")
    render_to_file(
        model=video,
        path=out_path,
        times=shown,
        fps=rate,
        size=image_size,
        background=background_color,
        overwrite=overwrite,
        options=options,
        flow=flow,
        stamps=timeline.stamps(model.fps, seconds),
    )
