"""The command `plate`."""

from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from foldgauss.cli.app.application import app, out, wrong_use
from foldgauss.cli.shared.arguments import ModelFile, Overwrite, Size, parse_size
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
from foldgauss.io.media.video_writing import VIDEO_SUFFIXES
from foldgauss.io.models.video_model import load_video_model, read_frame_seconds, read_origin
from foldgauss.video.motion.background_plate import Alignment, fill_background
from foldgauss.video.motion.moving_object import LEAST_FRAMES, NothingMoves, find_moving_object, nothing_moves

#: What can be done where the search finds nothing, or the wrong thing.
_CURE = "Remove an object by foldgauss edit, selected by a mask, a box or a click; see docs/editing.md."


@app.command("plate")
def plate_command(
    model_path: ModelFile,
    out_path: Annotated[Path | None, video_option(".plate.mp4")] = None,
    masks_path: Annotated[
        Path | None,
        typer.Option(
            "--masks", metavar="FOLDER", help="Also write the masks of the object here, for edit scripts: PNGs."
        ),
    ] = None,
    size: Size = None,
    codec: CodecName = None,
    crf: Crf = None,
    pixel_format: PixelFormat = None,
    sound: SoundFile = None,
    overwrite: Overwrite = False,
) -> None:
    """Render a model without its moving object, with what other frames show behind it."""
    image_size = parse_size(size)
    if out_path is None:
        out_path = name_after(model_path, f".plate{VIDEO_SUFFIXES[0]}")
    check_image_path(out_path)
    if masks_path is not None and masks_path.suffix:
        raise wrong_use("--masks", expected="a folder, without extension", got=masks_path)
    for option, path in (("--out", out_path), ("--masks", masks_path)):
        if path is not None:
            check_images_output(path, model_path, overwrite, option)
    if masks_path is not None and masks_path.resolve() == out_path.resolve():
        raise wrong_use("--masks", expected="another folder than --out", got=masks_path)
    model = load_video_model(model_path)
    if model.num_frames < LEAST_FRAMES:
        cure = "Fit more frames: a plate is what other frames show behind the object."
        raise nothing_moves(f"a video of {LEAST_FRAMES} frames at least", model.num_frames, cure)
    image_size = image_size or model.size
    refuse_huge(image_size)
    about = read_origin(model_path)
    options = VideoOptions(codec, crf, pixel_format, choose_sound(sound, Timeline(), about, model.fps))
    check_video_options(out_path, image_size, model.fps, options)
    frames = np.empty((model.num_frames, *image_size, 3), np.uint8)
    with progress_bar("Rendering", model.num_frames) as advance:
        for k, frame in enumerate(model.frames(size=image_size)):
            frames[k] = frame
            advance()
    out.print("Searching for what moves against the background ...")
    alignment = Alignment.from_frames(frames)
    print_shots(alignment.starts)
    with print_log():
        try:
            masks = find_moving_object(frames, shadow=True, alignment=alignment)
        except NothingMoves as error:
            raise nothing_moves("an object that moves against the background", "none", _CURE) from error
        covered = masks.mean((1, 2))[masks.any((1, 2))]
        if len(covered):
            found, size = f"in {len(covered)} of {len(masks)} frames", f"{covered.min():.1%} to {covered.max():.1%}"
            out.print(f"An object was found {found}, where it covers {size} of the image.")
        plate = fill_background(frames, masks, alignment=alignment)
    stamps = read_frame_seconds(about, model.num_frames)
    write_images(out_path, plate, len(plate), model.fps, overwrite=overwrite, options=options, stamps=stamps)
    if masks_path is not None:
        images = (np.repeat(np.uint8(255 * mask)[..., None], 3, -1) for mask in masks)
        write_images(masks_path, images, len(masks), model.fps, overwrite=overwrite, stamps=stamps)
