"""`render --plate`: the masks of the object, and the frames without it."""

from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from foldgauss._runtime.checks import invalid, require
from foldgauss.cli.app.application import out
from foldgauss.cli.shared.clips import Video
from foldgauss.cli.shared.log_lines import print_log, print_shots
from foldgauss.cli.shared.outputs import check_images_output
from foldgauss.cli.shared.rendering import Output, progress_bar
from foldgauss.io._atomic import resolve
from foldgauss.io.media.masks import read_masks
from foldgauss.video.models.background import Background
from foldgauss.video.motion.background_plate import Alignment, Frames, Masks, fill_background
from foldgauss.video.motion.moving_object import LEAST_FRAMES, NothingMoves, find_moving_object

#: What can be done where the search finds nothing, or the wrong thing.
_CURE = "Give masks of the object by --masks, or remove it by foldgauss edit; see docs/editing.md."


def make_plate(
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
    frames = np.empty((model.num_frames, *size, 3), np.uint8)
    with progress_bar("Rendering", model.num_frames) as advance:
        for k, frame in enumerate(model.frames(size=size, background=background)):
            frames[k] = frame
            advance()
    out.print("Searching for what moves against the background ..." if masks is None else "Aligning frames ...")
    alignment = Alignment.from_frames(frames)
    print_shots(alignment.starts, np.asarray(model.frame_times.times()))
    with print_log():
        masks = _find_object(frames, alignment) if masks is None else masks
        plate = fill_background(frames, masks, alignment=alignment)
    output.write(lambda: plate, len(plate))
    if save_masks is not None:
        images = partial(map, lambda mask: np.repeat(np.uint8(255 * mask)[..., None], 3, -1), masks)
        Output(save_masks, output.fps, output.overwrite).write(images, len(masks))


def _read_masks(path: Path, model: Video, size: tuple[int, int], about: dict[str, Any]) -> Masks:
    """The user's masks, one for each frame of the model, at the size of the images."""
    masks = read_masks(path, size=model.size, stretched=about.get("stretched"))
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
        expected = "an object that moves against the background"
        raise invalid("MODEL", expected=expected, got="none", cure=_CURE) from error
    covered = masks.mean((1, 2))[masks.any((1, 2))]
    if len(covered):
        size = f"{covered.min():.1%} to {covered.max():.1%}"
        out.print(
            f"Motion against the background covers {size} of the image, in {len(covered)} of {len(masks)} frames. "
            "Parts that stand still are not found and stay; --masks takes masks of the whole object.",
            soft_wrap=True,
        )
    return masks
