"""The masks of the objects of a job: read, followed from a few, or found by motion."""

import re
import warnings
from pathlib import Path

import numpy as np

from foldgauss._runtime.checks import invalid, require
from foldgauss.io import Clip
from foldgauss.io.media.images import choose_images
from foldgauss.io.media.masks import read_object_masks
from foldgauss.jobs.job import MOVING, FitJob
from foldgauss.video.motion.background_plate import Alignment, Masks, cover
from foldgauss.video.motion.followed_object import follow_object
from foldgauss.video.motion.moving_object import NothingMoves, find_moving_object

#: The masks of what moves are widened by this fraction of the longer side: they are found on images of 480 pixels, and
#: without it shreds of the object's outline stay in the background. (Chosen by eye: car-shadow, lady-running, bikes.)
WIDENING = 0.004


def parse_click(masks: str | None) -> tuple[int, float, float] | None:
    """(frame, x, y) of a click that is given in place of masks, "X,Y" or "X,Y@FRAME"; None for anything else."""
    found = re.fullmatch(r"([0-9.]+),([0-9.]+)(?:@([0-9]+))?", masks or "")
    return None if found is None else (int(found[3] or 0), float(found[1]), float(found[2]))


def find_masks(job: FitJob, clip: Clip, first: int, alignment: Alignment) -> dict[str, Masks]:
    """The masks of each object of a job in all frames of its clip, by name; none where a part has no object.

    `first` is the number of the clip's first frame, `alignment` aligns the frames. Warnings tell what was found.
    """
    click, is_part = parse_click(job.masks), job.index is not None
    require(click is None or not is_part, "masks", expected="a folder or 'moving', in segments", got=job.masks)
    if job.masks == MOVING or click is not None:
        return _find_moving(clip, click and (click[0] - first, *click[1:]), alignment, is_part)
    names = [file.stem for file in choose_images(Path(job.clip), 0, None)] if Path(job.clip).is_dir() else []
    given = read_object_masks(job.masks, first, clip.num_frames, clip.size, names=names, crop=job.size is not None)
    require(given or is_part, "masks", expected="an object in these frames", got=f"none in {job.masks!r}")
    found = {}
    for name, own in given.items():
        if len(own) < clip.num_frames:
            require(
                not is_part,
                "masks",
                expected=f"one for each of {clip.num_frames} frames, in segments",
                got=len(own),
                cure="Leave the segments out, or give masks of all frames.",
            )
            followed = follow_object(clip.frames, own, alignment=alignment)
            found[name] = cover(followed, WIDENING)
            for k, mask in own.items():
                found[name][k] = mask
            text = f"The {name} is followed from {len(own)} masks. It covers {_describe(followed)}."
            warnings.warn(f"{text} Where it is lost, give more masks.", stacklevel=2)
        else:
            found[name] = np.stack([own[k] for k in range(clip.num_frames)])
    return found


def _find_moving(
    clip: Clip, click: tuple[int, float, float] | None, alignment: Alignment, is_part: bool
) -> dict[str, Masks]:
    """The largest object that moves, or that at `click`."""
    last, height, width = clip.num_frames - 1, *clip.size
    require(
        click is None or (0 <= click[0] <= last and click[1] < width and click[2] < height),
        "masks",
        expected=f"a click in frames of {width}x{height} pixels, of which there are {last + 1}",
        got=click and "{1:g},{2:g} in frame {0} of them".format(*click),
    )
    try:
        masks = find_moving_object(clip.frames, at=click, alignment=alignment)
    except NothingMoves as error:
        if is_part:
            return {}
        where = "" if click is None else " there"
        expected, cure = "an object in these frames", "Give masks of the object: one of a frame is enough."
        raise invalid("masks", expected=expected, got=f"none that moves{where}", cure=cure) from error
    text = f"What moves covers {_describe(masks)}. Parts that stand still are not found: masks may have them."
    warnings.warn(text, stacklevel=2)
    return {"object": cover(masks, WIDENING)}


def _describe(masks: Masks) -> str:
    covered = masks.mean((1, 2))[masks.any((1, 2))]
    return f"{covered.min():.1%} to {covered.max():.1%} of the image, in {len(covered)} of {len(masks)} frames"
