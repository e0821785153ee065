"""The commands `export` and `import`."""

from pathlib import Path
from typing import Annotated, Any

import typer

from foldgauss._runtime.checks import ParameterError, check_one_of, require
from foldgauss.cli.app.application import command, out
from foldgauss.cli.app.help import complete_choice
from foldgauss.cli.shared.arguments import ModelFile, Overwrite, Size, parse_size, parse_times
from foldgauss.cli.shared.console import format_count, progress_bar
from foldgauss.cli.shared.files import (
    Video,
    check_output,
    name_after,
    refuse_existing,
    refuse_inputs,
)
from foldgauss.io._atomic import write_or_keep
from foldgauss.io.exchange.gaussians_ply import write_3dgs_frames, write_3dgs_ply
from foldgauss.io.exchange.pseudomesh import write_pseudomesh
from foldgauss.io.exchange.vegas_ply import read_vegas_ply, write_vegas_ply, write_vegas_segments
from foldgauss.io.models.video_model import (
    MODEL_SUFFIX,
    keep_origin,
    load_video_model,
    read_frame_seconds,
    read_origin,
    save_video_model,
)
from foldgauss.video.editing.edited_video import EditedVideo
from foldgauss.video.models.video_model import VideoModel
from foldgauss.video.segmented.layering import flatten_video
from foldgauss.video.segmented.segmented_video import SegmentedVideo

_NAMES = {"model": "foldgauss", "ply": "VeGaS video", "ply3dgs": "3DGS scenes", "obj": "triangles"}


@command("export")
def export_command(
    model_path: ModelFile,
    file_format: Annotated[
        str,
        typer.Option(
            "--format",
            help=f"ply: VeGaS video; ply3dgs: 3DGS scenes; obj: triangles of each frame; model: {MODEL_SUFFIX}.",
            autocompletion=complete_choice(_NAMES),
        ),
    ],
    segment: Annotated[
        int | None,
        typer.Option(metavar="K", help="This segment alone, from 0, of a model in segments; see foldgauss info."),
    ] = None,
    out_path: Annotated[
        Path | None,
        typer.Option(
            "--out",
            help=f"FILE{MODEL_SUFFIX} for model; FILE.ply for ply, and for ply3dgs of one time; otherwise a folder, "
            "also for ply of a model in segments [default: by the model's name].",
        ),
    ] = None,
    times: Annotated[
        str | None,
        typer.Option(
            metavar="T,T,..|A:B:N", help="Times in [0, 1], or N times from A to B [default: those of the frames]."
        ),
    ] = None,
    overwrite: Overwrite = False,
) -> None:
    """Write a model for other programs, or a part of it as a model.

    See docs/formats.md.
    """
    check_one_of("--format", file_format, tuple(_NAMES))
    chosen = parse_times(times)
    require(
        chosen is None or file_format not in ("model", "ply"),
        "--times",
        expected="ply3dgs or obj, which are of single times",
        got=file_format,
    )
    model, about = load_video_model(model_path), read_origin(model_path)
    if segment is not None:
        model, about = _take_segment(model, about, segment)
    suffix = {"model": MODEL_SUFFIX, "ply": ".ply"}.get(file_format, "")
    if file_format == "ply" and isinstance(model, SegmentedVideo):
        suffix = ""  # each segment becomes a file
    if file_format == "ply" and isinstance(model, EditedVideo):
        try:
            model = flatten_video(model)
        except ParameterError as error:
            raise ParameterError("MODEL", error.problem) from error
    single = file_format == "ply3dgs" and chosen is not None and len(chosen) == 1
    if out_path is None:
        ending = ".3dgs.ply" if single else suffix or f"-{file_format.replace('ply3', '3')}"
        out_path = name_after(model_path, ending if segment is None else f".{segment}{ending}")
    require(
        file_format == "ply3dgs" or out_path.suffix.lower() == suffix or (out_path.is_dir() and not suffix),
        "--out",
        expected=f"a name ending in {suffix}" if suffix else "a folder without extension",
        got=out_path,
    )
    require(
        file_format != "ply3dgs" or single or out_path.suffix.lower() != ".ply" or out_path.is_dir(),
        "--times",
        expected="one for a single file",
        got="all frames" if chosen is None else len(chosen),
        cure="Give one time, or a folder (a name without .ply).",
    )
    refuse_inputs(out_path, {"model": model_path})
    if not out_path.is_dir():
        refuse_existing(out_path, overwrite)
    num_frames = model.num_frames if chosen is None else len(chosen)

    def write(path: Path) -> Path:
        if file_format == "model":
            return save_video_model(path, model, metadata=about)
        if file_format == "ply" and not suffix:
            return write_vegas_segments(path, model, overwrite=overwrite)
        if file_format == "ply":
            return write_vegas_ply(path, model)
        if path.suffix.lower() == ".ply" and not path.is_dir():
            return write_3dgs_ply(path, model, float(chosen[0]))
        write_frames = {"ply3dgs": write_3dgs_frames, "obj": write_pseudomesh}[file_format]
        with progress_bar("Writing", num_frames) as advance:
            return write_frames(path, model, chosen, overwrite=overwrite, on_frame=advance)

    path = write_or_keep(out_path, write)
    most = "" if file_format in ("model", "ply") else "up to "  # a frame has only its live Gaussians
    count = f"{most}{model.num_gaussians:,} Gaussians{' each' if most and num_frames > 1 else ''}"
    text = f"{_NAMES[file_format]} ({file_format}), {format_count(num_frames, 'frame')}, {count}"
    out.print(f"{path}: {text}", soft_wrap=True)


def _take_segment(video: Video, about: dict[str, Any], number: int) -> tuple[VideoModel, dict[str, Any]]:
    """The model of a segment, and its metadata: the frames of its span, and the times at which they are shown."""
    require(isinstance(video, SegmentedVideo), "MODEL", expected="a model in segments", got="one without segments")
    require(
        0 <= number < len(video.segments),
        "--segment",
        expected=f"a whole number from 0 to {len(video.segments) - 1}",
        got=number,
    )
    segment = video.segments[number]
    begins = (about.get("frames") or [0])[0] or 0
    known = keep_origin(about, "clip")
    known |= {"frames": [begins + segment.first, begins + segment.stop]} | dict(segment.metadata)
    seconds = read_frame_seconds(about, video.num_frames)
    if seconds is not None:  # the segment's own frames may be evenly spaced, at another rate than the whole clip's
        own = seconds[segment.first : segment.stop + 1]
        first = about.get("first_second", 0.0) + float(own[0])
        known |= {"frame_seconds": (own - own[0]).tolist(), "first_second": first}
    return segment.model, known


@command("import")
def import_command(
    source: Annotated[
        Path,
        typer.Argument(
            metavar="FILE",
            help="A .ply of VeGaS.",
        ),
    ],
    out_path: Annotated[
        Path | None,
        typer.Option(
            "--out",
            help=f"FILE{MODEL_SUFFIX} [default: FILE's name in this folder].",
        ),
    ] = None,
    size: Size = None,
    fps: Annotated[float | None, typer.Option(help="Frames per second [default: the file's, or 25].")] = None,
    overwrite: Overwrite = False,
) -> None:
    """Read a model of another program, see docs/formats.md."""
    out_path = name_after(source, MODEL_SUFFIX) if out_path is None else out_path
    require(out_path.suffix.lower() == MODEL_SUFFIX, "--out", expected=f"a name ending in {MODEL_SUFFIX}", got=out_path)
    check_output(out_path, overwrite, {"file": source})
    model = read_vegas_ply(source, size=parse_size(size), fps=fps)
    save_video_model(out_path, model, metadata={"clip": source.name})
    out.print(f"{out_path}: {model.num_frames} frames, {model.num_gaussians:,} Gaussians", soft_wrap=True)
