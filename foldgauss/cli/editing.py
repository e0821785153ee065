"""The commands that change a model, and take it to other programs and back: `edit`, `export` and `import`."""

from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from foldgauss._checks import invalid
from foldgauss.cli._shared import (
    Overwrite,
    Size,
    WrongUse,
    app,
    check_picture_path,
    counted,
    draw,
    out,
    parse_size,
    parse_times,
    progress_bar,
    refuse_existing,
    refuse_huge,
)
from foldgauss.io._atomic import check_writable
from foldgauss.io.edit_script import read_edit_script
from foldgauss.io.exchange import FORMATS, export, import_model
from foldgauss.io.mesh import read_pseudomesh
from foldgauss.io.video_file import write_video
from foldgauss.io.video_model import MODEL_SUFFIX, load_video_model, read_metadata, save_video_model
from foldgauss.video.model import VideoModel

_CALLED = {"ply": "VeGaS video", "ply3dgs": "3DGS scenes", "obj": "triangles"}


@app.command(name="edit")
def edit_command(
    model_path: Annotated[Path, typer.Argument(metavar="MODEL", help="Model file.")],
    script_path: Annotated[Path, typer.Argument(metavar="SCRIPT.toml", help="What to select, and what to do with it.")],
    out_path: Annotated[
        Path,
        typer.Option("--out", help=f"FILE{MODEL_SUFFIX}: the edited model; a video or a folder: its pictures."),
    ],
    size: Size = None,
    overwrite: Overwrite = False,
) -> None:
    """Edit objects or single frames of a model by a script.

    Scripts: docs/editing.md. An edited model is rendered, evaluated and edited again like any other.
    """
    if out_path.exists() and model_path.exists() and out_path.samefile(model_path):
        raise WrongUse(f"--out: expected another file than the model, got {out_path}.")
    script = read_edit_script(script_path)
    as_model = out_path.suffix.lower() == MODEL_SUFFIX
    picture_size = parse_size(size)
    if as_model and picture_size is not None:
        raise WrongUse(str(invalid("--size", expected="a video or a folder as --out", got=out_path)))
    if not as_model:
        check_picture_path(out_path, others=MODEL_SUFFIX)
        refuse_huge(picture_size)
    if not out_path.is_dir():
        refuse_existing(out_path, overwrite)
        check_writable(out_path)
    model = load_video_model(model_path)
    if not as_model:
        refuse_huge(picture_size or model.size)
    edited = script.apply(model)
    if as_model:
        about = read_metadata(model_path)
        about = {key: about[key] for key in ("clip", "frames") if key in about} | {"edited_by": script_path.name}
        save_video_model(out_path, edited, metadata=about)
        kind = "a plain model" if isinstance(edited, VideoModel) else "a model with edits"
        out.print(f"{out_path}: {kind}, {edited.num_gaussians:,} Gaussians", soft_wrap=True)
        return
    draw(edited, out_path, np.asarray(edited.frame_times.times()), edited.fps, size=picture_size, overwrite=overwrite)


@app.command(name="export")
def export_command(
    model_path: Annotated[Path, typer.Argument(metavar="MODEL", help="Model file.")],
    file_format: Annotated[
        str, typer.Option("--format", help="ply: VeGaS video; ply3dgs: 3DGS scenes; obj: triangles of each frame.")
    ],
    out_path: Annotated[
        Path, typer.Option("--out", help="FILE.ply for ply, and for ply3dgs of one time; else a folder.")
    ],
    times: Annotated[
        str | None, typer.Option(metavar="T,T,..|A:B:N", help="These times, in [0, 1]; or N from A to B [the frames'].")
    ] = None,
    overwrite: Overwrite = False,
) -> None:
    """Write a model for other programs: see docs/formats.md."""
    if file_format not in FORMATS:
        raise WrongUse(str(invalid("--format", expected="one of " + ", ".join(FORMATS), got=file_format)))
    if file_format == "ply" and out_path.suffix.lower() != ".ply":
        raise WrongUse(str(invalid("--out", expected="a name ending in .ply", got=out_path)))
    if file_format == "obj" and out_path.suffix:
        raise WrongUse(str(invalid("--out", expected="a folder without extension", got=out_path)))
    if not out_path.is_dir():
        refuse_existing(out_path, overwrite)
    model = load_video_model(model_path)
    if file_format == "ply" and not isinstance(model, VideoModel):
        cure = "Frames of it go out as ply3dgs or obj."
        raise WrongUse(str(invalid("MODEL", expected="a plain model for ply", got="one with edits", cure=cure)))
    chosen = parse_times(times)
    path = export(model, file_format, out_path, times=chosen, overwrite=overwrite)
    num_frames = model.num_frames if chosen is None else len(chosen)
    frames = f"{num_frames:,} frame{'' if num_frames == 1 else 's'}"
    most = "" if file_format == "ply" else "up to "  # of frames, those alive
    told = f"{_CALLED[file_format]} ({file_format}), {frames}, {most}{model.num_gaussians:,} Gaussians"
    out.print(f"{path}: {told}{' each' if most and num_frames > 1 else ''}", soft_wrap=True)


@app.command(name="import")
def import_command(
    source: Annotated[Path, typer.Argument(metavar="FILE", help="A .ply of VeGaS, or a folder of .obj and .ply.")],
    out_path: Annotated[
        Path,
        typer.Option("--out", help=f"FILE{MODEL_SUFFIX}; of a folder of triangles: a video or a folder."),
    ],
    size: Size = None,
    fps: Annotated[float | None, typer.Option(help="Frames a second [default: as noted in the file, or 25].")] = None,
    overwrite: Overwrite = False,
) -> None:
    """Read what another program made: see docs/formats.md.

    Frames edited as triangles have no fold any more: they become pictures.
    """
    picture_size = parse_size(size)
    if source.is_dir():
        check_picture_path(out_path)
        if not out_path.is_dir():
            refuse_existing(out_path, overwrite)
            check_writable(out_path)
        refuse_huge(picture_size)
        mesh = read_pseudomesh(source, size=picture_size, fps=fps)
        refuse_huge(mesh.size)
        with progress_bar("Drawing", mesh.num_frames) as advance:
            write_video(out_path, counted(mesh.frames(), advance), mesh.fps, overwrite=overwrite)
        out.print(f"{out_path}: {mesh.num_frames} frames at {mesh.fps:g} frames a second", soft_wrap=True)
        return
    if out_path.suffix.lower() != MODEL_SUFFIX:
        raise WrongUse(str(invalid("--out", expected=f"a name ending in {MODEL_SUFFIX}", got=out_path)))
    refuse_existing(out_path, overwrite)
    check_writable(out_path)
    model = import_model(source, size=picture_size, fps=fps)
    save_video_model(out_path, model, metadata={"clip": source.name})
    out.print(f"{out_path}: {model.num_frames} frames, {model.num_gaussians:,} Gaussians", soft_wrap=True)
