"""The command `plate`."""

from functools import partial
from pathlib import Path
from typing import Annotated, Any

import cv2
import numpy as np
import typer

from foldgauss.cli.app.application import app, out, wrong_use
from foldgauss.cli.shared.arguments import ModelFile, Overwrite, Size, parse_size
from foldgauss.cli.shared.clips import Video
from foldgauss.cli.shared.log_lines import print_log, print_shots
from foldgauss.cli.shared.outputs import check_image_path, check_images_output, name_after, refuse_huge
from foldgauss.cli.shared.rendering import (
    CodecName,
    Crf,
    PixelFormat,
    SoundFile,
    VideoOptions,
    check_video_options,
    choose_sound,
    progress_bar,
    video_option,
    write_images,
)
from foldgauss.cli.shared.timeline import Timeline
from foldgauss.io._atomic import resolve
from foldgauss.io.media.masks import read_masks
from foldgauss.io.media.writing import VIDEO_SUFFIXES
from foldgauss.io.models.video_model import load_video_model, read_frame_seconds, read_origin
from foldgauss.video.motion.background_plate import Alignment, Frames, Masks, fill_background
from foldgauss.video.motion.moving_object import LEAST_FRAMES, NothingMoves, find_moving_object

#: What can be done where the search finds nothing, or the wrong thing.
_CURE = "Give masks of the object by --masks, or remove it by foldgauss edit; see docs/editing.md."


@app.command("plate")
def plate_command(
    model_path: ModelFile,
    out_path: Annotated[Path | None, video_option(".plate.mp4")] = None,
    masks_path: Annotated[
        Path | None,
        typer.Option(
            "--masks",
            help="Masks of what is removed: an image, a folder with one for each frame, or a video "
            "[default: the object that moves is searched for].",
        ),
    ] = None,
    save_masks: Annotated[
        Path | None,
        typer.Option(metavar="FOLDER", help="Also write the masks that were used here, for edit scripts: PNGs."),
    ] = None,
    size: Size = None,
    codec: CodecName = None,
    crf: Crf = None,
    pixel_format: PixelFormat = None,
    sound: SoundFile = None,
    overwrite: Overwrite = False,
) -> None:
    """Render a model without its moving object, with what other frames show behind it.

    With --masks it is any object.
    """
    image_size = parse_size(size)
    if out_path is None:
        out_path = name_after(model_path, f".plate{VIDEO_SUFFIXES[0]}")
    check_image_path(out_path)
    if save_masks is not None and save_masks.suffix:
        raise wrong_use("--save-masks", expected="a folder, without extension", got=save_masks)
    inputs = {"model": model_path, "masks": masks_path, "sound": sound}
    for option, path in (("--out", out_path), ("--save-masks", save_masks)):
        if path is not None:
            check_images_output(path, inputs, overwrite, option)
    if save_masks is not None and resolve(save_masks) == resolve(out_path):
        raise wrong_use("--save-masks", expected="another folder than --out", got=save_masks)
    model = load_video_model(model_path)
    if model.num_frames < LEAST_FRAMES:
        cure = "Fit more frames: a plate is what other frames show behind the object."
        raise wrong_use("MODEL", expected=f"at least {LEAST_FRAMES} frames", got=model.num_frames, cure=cure)
    image_size = image_size or model.size
    refuse_huge(image_size)
    about = read_origin(model_path)
    options = VideoOptions(codec, crf, pixel_format, choose_sound(sound, Timeline(), about, model.fps))
    check_video_options(out_path, image_size, model.fps, options)
    masks = None if masks_path is None else _read_masks(masks_path, model, image_size, about)
    frames = np.empty((model.num_frames, *image_size, 3), np.uint8)
    with progress_bar("Rendering", model.num_frames) as advance:
        for k, frame in enumerate(model.frames(size=image_size)):
            frames[k] = frame
            advance()
    out.print("Searching for what moves against the background ..." if masks is None else "Aligning frames ...")
    alignment = Alignment.from_frames(frames)
    print_shots(alignment.starts, np.asarray(model.frame_times.times()))
    with print_log():
        masks = _find_object(frames, alignment) if masks is None else masks
        plate = fill_background(frames, masks, alignment=alignment)
    stamps = read_frame_seconds(about, model.num_frames)
    write_images(out_path, lambda: plate, len(plate), model.fps, overwrite=overwrite, options=options, stamps=stamps)
    if save_masks is not None:
        images = partial(map, lambda mask: np.repeat(np.uint8(255 * mask)[..., None], 3, -1), masks)
        write_images(save_masks, images, len(masks), model.fps, overwrite=overwrite, stamps=stamps)


def _read_masks(path: Path, model: Video, size: tuple[int, int], about: dict[str, Any]) -> Masks:
    """The user's masks, one for each frame of the model, at the size of the images."""
    masks = read_masks(path, size=model.size, stretched=about.get("stretched"))
    masks = masks.reshape(-1, *masks.shape[-2:])  # one image is for all frames
    first, num = (about.get("frames") or (0,))[0] or 0, model.num_frames
    if len(masks) >= first + num:
        masks = masks[first : first + num]  # of the whole clip
    if len(masks) not in (1, num):
        raise wrong_use("--masks", expected=f"one mask, or one for each of {num} frames", got=f"{len(masks)} masks")
    resized = [cv2.resize(np.uint8(mask), size[::-1], interpolation=cv2.INTER_NEAREST) > 0 for mask in masks]
    if not np.any(resized):
        raise wrong_use("--masks", expected="masks that are not empty", got=path)
    return np.broadcast_to(resized, (num, *size))


def _find_object(frames: Frames, alignment: Alignment) -> Masks:
    """The masks of what moves; prints how much that is, which may be a part of the object."""
    try:
        masks = find_moving_object(frames, shadow=True, alignment=alignment)
    except NothingMoves as error:
        raise wrong_use(
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
