"""Models and the clips that they were fitted to."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from foldgauss._runtime.checks import ParameterError, invalid, require
from foldgauss.cli.app.application import warn
from foldgauss.cli.shared.arguments import parse_frames
from foldgauss.cli.shared.progress import show_status
from foldgauss.io.media.clip import Clip
from foldgauss.io.media.indexing import LazyFrames, index_video
from foldgauss.io.media.reading import read_video
from foldgauss.io.models.segmented import is_segmented
from foldgauss.io.models.video_model import read_origin
from foldgauss.io.provenance import has_other_frames
from foldgauss.video.editing.edited_video import EditedVideo
from foldgauss.video.models.video_model import VideoModel
from foldgauss.video.segmented.segmented_video import SegmentedVideo

#: What a model file may contain.
Video = VideoModel | EditedVideo | SegmentedVideo

#: dB by which another clip scores worse than the one that was fitted; decoders differ by less.
OTHER_CLIP_DB = 3.0


def refuse_segments(model_path: Path) -> None:
    """For commands whose model must not be in segments."""
    require(
        not is_segmented(model_path),
        "MODEL",
        expected="a model of one piece",
        got="one in segments",
        cure=f"Extract one: foldgauss export {model_path} --format model --segment 0.",
    )


def read_fitted_clip(
    model: Video,
    model_path: Path,
    video: Path,
    frames: str | None,
    *,
    same_number: bool = True,
    name: str = "VIDEO",
) -> Clip:
    """The frames that a model was fitted to, at its size, or those given; warns if they differ from the fitted ones.

    For a model in segments the frames are `LazyFrames`, since the clip may be larger than memory. `name` is the
    argument or the option that gives the clip. Commands with such an option have no --frames.

    Raises ParameterError, with `same_number`, for another number of frames than the model's, and for a clip to which
    the recorded range or options of reading do not apply.
    """
    about = read_origin(model_path)
    kept, reading = about.get("frames"), about.get("reading", {})
    wanted = parse_frames(frames) if frames is not None else (tuple(kept) if kept else None)
    try:
        read = _read_lazily if isinstance(model, SegmentedVideo) else read_video
        clip = read(video, frames=wanted, size=model.size, **reading)
    except ParameterError as error:
        if error.parameter == "frames" and frames is None:
            as_fitted, got = f"frames {wanted[0]}:{wanted[1]} of {about.get('clip')}", "which has fewer"
        elif error.parameter in reading:
            as_fitted = f"{about.get('clip')} read with {error.parameter}={reading[error.parameter]!r}"
            got = "to which that does not apply"
        else:
            raise
        raise invalid(
            name,
            expected=f"the clip that the model was fitted to, {as_fitted}",
            got=f"{str(video)!r}, {got}",
            cure="Give that clip.",
        ) from error
    for note in clip.notes:
        warn(f"{clip.source}: {note}")
    if same_number and clip.num_frames != model.num_frames:
        by_clip = name.startswith("--") or (frames is None and clip.num_frames < model.num_frames)
        raise invalid(
            name if by_clip else "--frames",
            expected=f"{model.num_frames} frames as in the model",
            got=f"{clip.num_frames} of {clip.source!r}",
            cure="Give the clip that it was fitted to."
            if by_clip
            else f"Give those that it was fitted to, as 0:{model.num_frames}.",
        )
    if has_other_frames(about, clip):
        warn(
            f"the frames of {clip.source} are not those that the model was fitted to ({about.get('clip')}): "
            "another clip or range, or another decoder read them."
        )
    return clip


def _read_lazily(
    video: Path, *, frames: tuple[int | None, int | None] | None, size: tuple[int, int], **reading: Any
) -> Clip:
    """As `read_video`, with only some frames in memory."""
    with show_status(f"Indexing {video.name}"):
        index = index_video(video, frames=frames, find_cuts=False, **reading)
    lazy = LazyFrames(index, size)
    about = index.source, index.num_declared, index.times, index.notes, index.first_second, index.duration
    return Clip(lazy, index.fps, *about, index.reading)


def is_other_clip(model_path: Path, clip: Clip, measure_psnr: Callable[[], float]) -> bool:
    """Whether the model was fitted to another clip: the frames differ, and score `OTHER_CLIP_DB` less.

    `measure_psnr` returns the mean PSNR, and is called only if the frames differ.
    """
    about = read_origin(model_path)
    fitted = about.get("mean_psnr")
    return fitted is not None and has_other_frames(about, clip) and measure_psnr() < fitted - OTHER_CLIP_DB
