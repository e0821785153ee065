"""The command `render`."""

from functools import partial
from pathlib import Path
from typing import Annotated, Any

import cv2
import numpy as np
import typer

from foldgauss._runtime.checks import check_one_of, invalid, require
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
    advance_over,
    choose_sound,
)
from foldgauss.io._atomic import resolve
from foldgauss.io.media.frame_rate import MAX_FPS, MIN_FPS
from foldgauss.io.media.masks import read_masks
from foldgauss.io.media.reading import stack_frames
from foldgauss.io.media.writing import CODECS, IMAGE_FORMATS, VIDEO_SUFFIXES
from foldgauss.io.models.video_model import load_video_model, read_frame_seconds, read_origin
from foldgauss.video.models.background import Background
from foldgauss.video.motion.background_plate import Alignment, Frames, Masks, fill_background
from foldgauss.video.motion.moving_object import LEAST_FRAMES, NothingMoves, find_moving_object
from foldgauss.video.motion.slow_motion import interpolate_frames
from foldgauss.video.motion.stabilization import BORDERS, MAX_ZOOM, SMOOTHING, stabilize

#: Panels of `--help`.
STABILIZED = "Stabilized"
PLATE = "Without an object"
#: What can be done where the search finds nothing, or the wrong thing.
_CURE = "Give masks of the object by --masks, or remove it by foldgauss edit; see docs/editing.md."
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
    plate: Annotated[
        bool,
        typer.Option(
            "--plate",
            help="Without the moving object, with what other frames show behind it.",
            rich_help_panel=PLATE,
        ),
    ] = False,
    masks_path: Annotated[
        Path | None,
        typer.Option(
            "--masks",
            help="Masks of what is removed: an image, a folder with one for each frame, or a video "
            "[default: the object that moves is searched for].",
            rich_help_panel=PLATE,
        ),
    ] = None,
    save_masks: Annotated[
        Path | None,
        typer.Option(
            metavar="FOLDER",
            help="Also write the masks that were used here, for edit scripts: PNGs.",
            rich_help_panel=PLATE,
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
    """Render a model as a video: also between its frames, stabilized, or without an object."""
    timeline = Timeline(fps, speed, parse_remap(remap), parse_times(times), frame)
    image_size, background_color = parse_size(size), parse_color(background)
    if camera is not None:
        check_one_of("--stabilize", camera, CAMERAS)
    check_one_of("--border", border or BORDERS[0], BORDERS)
    needed = {"--smoothing": smoothing, "--border": border} if camera is None else {}
    needed |= {} if plate else {"--masks": masks_path, "--save-masks": save_masks}
    for option, value in needed.items():
        other = "--plate" if "masks" in option else "--stabilize"
        require(value is None, option, expected=f"{other} too", got=f"{option} alone")
    if camera == "fixed":
        refuse_together("--stabilize fixed", {"--smoothing": smoothing})
    if plate:
        others = {"--stabilize": camera, "--fps": fps}
        refuse_together("--plate", others | timeline.ways | {"--background none": background_color is None})
    kind = ".plate" if plate else "" if camera is None else ".stable"
    out_path = _name_output(model_path, timeline, image_format, kind) if out_path is None else out_path
    if image_format is not None:
        check_one_of("--format", image_format, IMAGE_FORMATS)
        require(not out_path.suffix or out_path.is_dir(), "--format", expected="a folder as --out", got=out_path)
    inputs = {"model": model_path, "masks": masks_path, "sound": sound}
    check_images_output(out_path, overwrite, inputs, others=() if plate else (IMAGE_SUFFIX,))
    model, about = load_video_model(model_path), read_origin(model_path)
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
    if plate:
        _make_plate(model, about, output, image_size, background_color, masks_path, save_masks, inputs)
        return
    video = model
    if camera is not None:
        video = _stabilize(model, camera, SMOOTHING if smoothing is None else smoothing, border or BORDERS[0])
    draw = partial(interpolate_frames, video) if flow else video.frames
    output.write(partial(draw, shown, image_size, background=background_color), len(shown))


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
        return name_after(model_path, f"{kind}-frames")
    suffix = IMAGE_SUFFIX if timeline.is_single else VIDEO_SUFFIXES[0]
    path = name_after(model_path, f"{kind}{suffix}")
    clip = read_origin(model_path).get("clip", path.name)  # if unknown, it may have that name
    return name_after(model_path, f".rendered{suffix}") if path.name == clip and not kind else path


# ------------------------------------------------------------------------------------------- without an object


def _make_plate(
    model: Video,
    about: dict[str, Any],
    output: Output,
    size: tuple[int, int],
    background: Background,
    masks_path: Path | None,
    save_masks: Path | None,
    inputs: dict[str, Path | None],
) -> None:
    """Write the frames of `model` without the object of the masks, or else of what moves; and the masks if wanted."""
    if save_masks is not None:
        require(not save_masks.suffix, "--save-masks", expected="a folder, without extension", got=save_masks)
        check_images_output(save_masks, output.overwrite, inputs, "--save-masks")
        require(
            resolve(save_masks) != resolve(output.path),
            "--save-masks",
            expected="another folder than --out",
            got=save_masks,
        )
    require(
        model.num_frames >= LEAST_FRAMES,
        "MODEL",
        expected=f"at least {LEAST_FRAMES} frames",
        got=model.num_frames,
        cure="Fit more frames: a plate is what other frames show behind the object.",
    )
    masks = None if masks_path is None else _read_masks(masks_path, model, size, about)
    with progress_bar("Rendering", model.num_frames) as advance:
        frames = stack_frames(advance_over(model.frames(size=size, background=background), advance))
    out.print("Searching for what moves against the background ..." if masks is None else "Aligning frames ...")
    alignment = Alignment.from_frames(frames)
    print_shots(alignment.starts, np.asarray(model.frame_times.times()))
    masks = _find_object(frames, alignment) if masks is None else masks
    plate = fill_background(frames, masks, alignment=alignment)
    output.write(lambda: plate, len(plate))
    if save_masks is not None:
        images = partial(map, lambda mask: np.repeat(np.uint8(255 * mask)[..., None], 3, -1), masks)
        Output(save_masks, output.fps, output.overwrite).write(images, len(masks))


def _read_masks(path: Path, model: Video, size: tuple[int, int], about: dict[str, Any]) -> Masks:
    """The user's masks, one for each frame of the model, at the size of the images."""
    masks = read_masks(path, size=model.size)
    masks = masks.reshape(-1, *masks.shape[-2:])  # one image is for all frames
    first, num = (about.get("frames") or (0,))[0] or 0, model.num_frames
    if len(masks) >= first + num:
        masks = masks[first : first + num]  # of the whole clip
    require(
        len(masks) in (1, num),
        "--masks",
        expected=f"one mask, or one for each of {num} frames",
        got=f"{len(masks)} masks",
    )
    resized = [cv2.resize(np.uint8(mask), size[::-1], interpolation=cv2.INTER_NEAREST) > 0 for mask in masks]
    require(np.any(resized), "--masks", expected="masks that are not empty", got=path)
    return np.broadcast_to(resized, (num, *size))


def _find_object(frames: Frames, alignment: Alignment) -> Masks:
    """The masks of what moves; prints how much that is, which may be a part of the object."""
    try:
        masks = find_moving_object(frames, shadow=True, alignment=alignment)
    except NothingMoves as error:
        raise invalid(
            "MODEL", expected="an object that moves against the background", got="none", cure=_CURE
        ) from error
    covered = masks.mean((1, 2))[masks.any((1, 2))]
    if len(covered):
        size = f"{covered.min():.1%} to {covered.max():.1%}"
        out.print(
            f"Motion against the background covers {size} of the image, in {len(covered)} of {len(masks)} frames. "
            "Parts that stand still are not found and stay; --masks takes masks of the whole object.",
            soft_wrap=True,
        )
    return masks
