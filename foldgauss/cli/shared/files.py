"""Inputs and outputs of commands: checks before any work is done, and models with the clips they were fitted to."""

import dataclasses
import os
from collections.abc import Callable, Collection, Mapping
from pathlib import Path

from foldgauss._runtime.checks import ParameterError, invalid, require
from foldgauss.cli.app.application import warn
from foldgauss.cli.shared.arguments import parse_frames
from foldgauss.cli.shared.console import Video, show_status
from foldgauss.io._atomic import check_replaceable, check_writable, resolve
from foldgauss.io.media.clip import Clip
from foldgauss.io.media.images import IMAGE_SUFFIXES
from foldgauss.io.media.indexing import index_video, read_indexed
from foldgauss.io.media.reading import memory_limit, read_video
from foldgauss.io.media.writing import ANIMATION_SUFFIXES, FRAME_NAMES, VIDEO_SUFFIXES
from foldgauss.io.models.segmented import is_segmented
from foldgauss.io.models.video_model import read_origin
from foldgauss.io.provenance import has_other_frames
from foldgauss.video.segmented.segmented_video import SegmentedVideo

IMAGE_SUFFIX = ".png"


def name_after(source: Path, ending: str) -> Path:
    """The default name of an output: in the current folder, after its source."""
    whole = source if source.name not in ("", "..") else resolve(source)
    return Path(f"{whole.name if whole.is_dir() else whole.stem}{ending}")


def refuse_huge(size: tuple[int, int] | None) -> None:
    """Refuse images that do not fit in memory: several copies are held in floating point."""
    if size is None:
        return
    got = f"{size[0]}x{size[1]}"
    fits = 64 * size[0] * size[1] <= memory_limit()
    require(fits, "--size", expected="an image that fits in memory", got=got, cure="Choose a smaller one.")


def refuse_existing(path: Path, overwrite: bool, option: str = "--out") -> None:
    require(
        overwrite or not os.path.exists(path),
        option,
        expected="a new output",
        got=f"{path}, which exists",
        cure="Choose another path, or add --overwrite.",
    )


def refuse_inputs(path: Path, inputs: Mapping[str, Path | None], option: str = "--out") -> None:
    """Refuse an output in place of one of the command's `inputs` by name, of an image in a folder that is one, or of a
    folder that holds one."""
    for what, source in inputs.items():
        if source is None or not os.path.exists(source):
            continue
        # os.path: a name that is too long does not exist here; creating the file reports it.
        is_source = os.path.exists(path) and path.samefile(source)
        require(
            path.suffix.lower() not in IMAGE_SUFFIXES or resolve(path.parent) != resolve(source),
            option,
            expected=f"a place outside the {what}'s folder",
            got=path,
            cure="It would be one of its images.",
        )
        require(
            not is_source and resolve(path) not in resolve(source).parents,
            option,
            expected=f"another path than the {what}",
            got=path,
            cure="Inputs are never replaced.",
        )


def check_output(path: Path, overwrite: bool, inputs: Mapping[str, Path | None], option: str = "--out") -> None:
    """Refuse an output file that could not be written, or that is one of the `inputs`."""
    refuse_inputs(path, inputs, option)
    refuse_existing(path, overwrite, option)
    check_writable(path)


def check_images_output(
    path: Path,
    overwrite: bool,
    inputs: Mapping[str, Path | None],
    option: str = "--out",
    *,
    others: Collection[str] = (),
) -> None:
    """Refuse a name that images cannot be written to, unless its suffix is one of `others`, and as `check_output`."""
    wanted = (*others, *VIDEO_SUFFIXES, *ANIMATION_SUFFIXES)
    if path.suffix and not path.is_dir() and path.suffix.lower() not in wanted:
        is_image = path.suffix.lower() == IMAGE_SUFFIX
        cure = "One image of a model: foldgauss render MODEL --times T --out FILE.png." if is_image else ""
        raise invalid(option, expected=", ".join(wanted) + ", or a folder without extension", got=path, cure=cure)
    refuse_inputs(path, inputs, option)
    if not path.is_dir() or any(path.iterdir()):
        refuse_existing(path, overwrite, option)
    if path.is_dir() or not path.suffix:
        check_replaceable(path, overwrite, pattern=FRAME_NAMES)
    if not path.is_dir():
        check_writable(path)


def refuse_foreign(
    folder: Path, own: Collection[str], command: str, *, record: str, known: bool, cure: str = ""
) -> None:
    """Refuse a folder with files other than the command's `own`, which it replaces.

    Files with the names of its own are the command's if its `record` is valid, which `known` states.
    """
    try:
        names = {entry.name for entry in folder.iterdir() if not entry.name.startswith(".")}
    except OSError:  # missing or not a folder, which creating it reports
        return
    foreign, expected = sorted(names - set(own)), f"a new folder or one that a {command} wrote"
    if foreign:
        raise invalid(
            "--out", expected=expected, got=f"{folder} with {foreign[0]!r} in it", cure="Choose another folder."
        )
    if names and not known:
        raise invalid(
            "--out",
            expected=expected,
            got=f"{folder} with {min(names)!r} in it, but no {record} of a {command}",
            cure=f"Choose another folder{cure}.",
        )


def make_folder(path: Path) -> None:
    """Create the folder of outputs if needed. Raises ParameterError or OutputError if it cannot be written to."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise invalid(
            "--out", expected="a folder that can be created", got=f"{path} ({error.strerror})", cure="Choose another."
        ) from error
    check_writable(path / "model.safetensors")


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

    Raises ParameterError, with `same_number`, for another number of frames than the model's, and for a clip that
    has fewer frames than the recorded range.
    """
    about = read_origin(model_path)
    kept = about.get("frames")
    wanted = parse_frames(frames) if frames is not None else (tuple(kept) if kept else None)
    try:
        if isinstance(model, SegmentedVideo):
            with show_status(f"Indexing {video.name}"):
                index = index_video(video, frames=wanted, find_cuts=False)
            clip = dataclasses.replace(read_indexed(index, 0, size=model.size, lazy=True), notes=index.notes)
        else:
            clip = read_video(video, frames=wanted, size=model.size)
    except ParameterError as error:
        if error.parameter != "frames" or frames is not None:
            raise
        as_fitted = f"frames {wanted[0]}:{wanted[1]} of {about.get('clip')}"
        raise invalid(
            name,
            expected=f"the clip that the model was fitted to, {as_fitted}",
            got=f"{str(video)!r}, which has fewer",
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


def is_other_clip(model_path: Path, clip: Clip, measure_psnr: Callable[[], float]) -> bool:
    """Whether the model was fitted to another clip: the frames differ, and score `OTHER_CLIP_DB` less.

    `measure_psnr` returns the mean PSNR, and is called only if the frames differ.
    """
    about = read_origin(model_path)
    fitted = about.get("mean_psnr")
    return fitted is not None and has_other_frames(about, clip) and measure_psnr() < fitted - OTHER_CLIP_DB
