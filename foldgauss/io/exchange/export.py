"""Export of models, with the format chosen by name."""

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from foldgauss._runtime.checks import check_one_of, invalid, require
from foldgauss.io._atomic import OutputRefused, PathLike, atomic_folder, check_path, check_writable
from foldgauss.io.exchange.gaussians_ply import write_3dgs_frames, write_3dgs_ply
from foldgauss.io.exchange.pseudomesh import write_pseudomesh
from foldgauss.io.exchange.vegas_ply import write_vegas_ply
from foldgauss.video.editing.chain import Edit
from foldgauss.video.editing.edited_video import EditedVideo
from foldgauss.video.models.video_model import VideoModel
from foldgauss.video.segmented.segmented_video import SegmentedVideo

#: The published VeGaS video in one file; 3DGS scenes, one for each frame; pseudomeshes, two files for each frame.
FORMATS = ("ply", "ply3dgs", "obj")


def export(
    model: VideoModel | EditedVideo | SegmentedVideo,
    format: str,
    out: PathLike,
    *,
    times: Sequence[float] | None = None,
    depth_step: float | None = None,
    axes: str | None = None,
    sh_degree: int | None = None,
    overwrite: bool = False,
    on_frame: Callable[[], object] = lambda: None,
) -> Path:
    """Write a model for other programs; returns the path of the file or the folder.

    - `ply`: one file, the published VeGaS video (`write_vegas_ply`); of a video in segments a folder with one of each,
      segment-000.ply and so on
    - `ply3dgs`: a folder with a 3DGS scene of each frame (`write_3dgs_frames`); or one file, where `out` ends in .ply
      and `times` is one (`write_3dgs_ply`)
    - `obj`: a folder with a pseudomesh of each frame (`write_pseudomesh`)

    `times` in [0, 1], one or several (default: the model's frame times), for the formats of frames; `depth_step`,
    `axes` and `sh_degree` for `ply3dgs`. An existing output is refused unless `overwrite`. `on_frame` is called after
    each frame of a folder. Pages for browsers: `write_html`.

    **Raises:** ValueError for an unknown format, an option of another format, and as the function;
    `OutputError` where the output cannot be written or exists.

    **Example:** `export(load_video_model("holiday.safetensors"), "ply3dgs", "frames")`
    """
    require(
        isinstance(model, VideoModel | EditedVideo | SegmentedVideo),
        "model",
        expected="a VideoModel, an EditedVideo or a SegmentedVideo",
        got=type(model).__name__,
        cure="End the chain with .video()." if isinstance(model, Edit) else "The order is (model, format, out).",
    )
    check_one_of("format", format, FORMATS)
    out = check_path(out, "model, format, out")
    options = {"depth_step": depth_step, "axes": axes, "sh_degree": sh_degree}
    of_scenes = {name: value for name, value in options.items() if value is not None}
    unknown = [*(of_scenes if format != "ply3dgs" else ())]
    unknown += ["times"] if format == "ply" and times is not None else []
    if unknown:
        raise invalid(unknown[0], expected="an option of this format", got=f"it for {format!r}", cure="Leave it out.")
    if format == "ply" and isinstance(model, SegmentedVideo):
        return _write_vegas_segments(out, model, overwrite)
    if format == "ply":
        _check_new(out, overwrite)
        return write_vegas_ply(out, model)
    if format == "obj":
        require(
            out.suffix.lower() != ".obj" or out.is_dir(),
            "out",
            expected="a folder",
            got=repr(str(out)),
            cure="Each frame becomes a file in it: leave the extension out.",
        )
        return write_pseudomesh(out, model, times, overwrite=overwrite, on_frame=on_frame)
    if out.suffix.lower() != ".ply" or out.is_dir():
        return write_3dgs_frames(out, model, times, overwrite=overwrite, on_frame=on_frame, **of_scenes)
    require(
        times is not None and np.size(times) == 1,
        "times",
        expected="one for a single file",
        got="all frames" if times is None else str(np.size(times)),
        cure="Give one time, or a folder (a name without .ply).",
    )
    _check_new(out, overwrite)
    return write_3dgs_ply(out, model, float(np.ravel(times)[0]), **of_scenes)


def _write_vegas_segments(folder: Path, video: SegmentedVideo, overwrite: bool) -> Path:
    require(
        folder.suffix.lower() != ".ply" or folder.is_dir(),
        "out",
        expected="a folder",
        got=repr(str(folder)),
        cure="Each segment becomes a file in it: leave the extension out.",
    )
    with atomic_folder(folder, overwrite, pattern=r"segment-[0-9]{3,}\.ply", what="segments") as temporary:
        for number, segment in enumerate(video.segments):
            write_vegas_ply(temporary / f"segment-{number:03d}.ply", segment.model)
    return folder


def _check_new(path: Path, overwrite: bool) -> None:
    check_writable(path)
    if path.exists() and not overwrite:
        text = f"path: expected a new file, got {str(path)!r}, which exists."
        raise OutputRefused(f"{text} Choose another path, or overwrite it.")
