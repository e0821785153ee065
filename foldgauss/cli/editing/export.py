"""The commands `export` and `import`."""

from pathlib import Path
from typing import Annotated

import typer

from foldgauss.cli.app.application import app, out, wrong_use
from foldgauss.cli.app.completion import complete_choice, complete_files
from foldgauss.cli.shared.arguments import (
    ModelFile,
    Original,
    OriginalQuality,
    Overwrite,
    Size,
    Times,
    parse_size,
    parse_times,
)
from foldgauss.cli.shared.clips import read_fitted_clip
from foldgauss.cli.shared.log_lines import show_status
from foldgauss.cli.shared.outputs import (
    check_image_path,
    name_after,
    refuse_existing,
    refuse_huge,
    refuse_inputs,
    write_result,
)
from foldgauss.cli.shared.rendering import progress_bar, write_images
from foldgauss.io._atomic import check_writable
from foldgauss.io.exchange.export_import import FORMATS, export, import_model
from foldgauss.io.exchange.pseudomesh import read_pseudomesh
from foldgauss.io.media.writing import VIDEO_SUFFIXES
from foldgauss.io.models.segmented import is_segmented
from foldgauss.io.models.video_model import (
    MODEL_SUFFIX,
    load_video_model,
    save_video_model,
)
from foldgauss.io.page.player_page import HTML_SUFFIX, QUALITY, linked_file, write_html
from foldgauss.video.editing.edited_video import EditedVideo

_NAMES = {"ply": "VeGaS video", "ply3dgs": "3DGS scenes", "obj": "triangles", "html": "player"}


@app.command(name="export")
def export_command(
    model_path: ModelFile,
    file_format: Annotated[
        str,
        typer.Option(
            "--format",
            help="ply: VeGaS video; ply3dgs: 3DGS scenes; obj: triangles of each frame; html: a player.",
            autocompletion=complete_choice(FORMATS),
        ),
    ],
    out_path: Annotated[
        Path | None,
        typer.Option(
            "--out",
            help="FILE.ply for ply, and for ply3dgs of one time; FILE.html for html; otherwise a folder, also for ply "
            "of a model in segments [default: by the model's name].",
        ),
    ] = None,
    times: Times = None,
    original: Original = None,
    original_quality: OriginalQuality = QUALITY,
    linked: Annotated[
        bool, typer.Option("--linked", help="html: the model in a .fgz beside the page, read in parts over HTTP.")
    ] = False,
    overwrite: Overwrite = False,
) -> None:
    """Write a model for other programs, or as a web page.

    See docs/formats.md, and docs/player.md for the page, which plays the model.
    """
    if file_format not in FORMATS:
        raise wrong_use("--format", expected="one of " + ", ".join(FORMATS), got=file_format)
    chosen = parse_times(times)
    segmented = file_format == "ply" and is_segmented(model_path)
    if out_path is None:
        single = file_format == "ply3dgs" and chosen is not None and len(chosen) == 1
        endings = {
            "ply": "-ply" if segmented else ".ply",
            "ply3dgs": ".3dgs.ply" if single else "-3dgs",
            "html": ".html",
        }
        out_path = name_after(model_path, endings.get(file_format, f"-{file_format}"))
    refuse_inputs(out_path, {"model": model_path, "clip": original})
    if segmented and out_path.suffix and not out_path.is_dir():
        cure = "Each segment becomes a file in it."
        raise wrong_use("--out", expected="a folder without extension", got=out_path, cure=cure)
    if file_format == "ply" and not segmented and out_path.suffix.lower() != ".ply":
        raise wrong_use("--out", expected="a name ending in .ply", got=out_path)
    if file_format == "obj" and out_path.suffix:
        raise wrong_use("--out", expected="a folder without extension", got=out_path)
    if file_format == "html" and out_path.suffix.lower() != HTML_SUFFIX:
        raise wrong_use("--out", expected=f"a name ending in {HTML_SUFFIX}", got=out_path)
    if file_format != "html" and original is not None:
        raise wrong_use("--original", expected="--format html", got=file_format)
    if file_format != "html" and linked:
        raise wrong_use("--linked", expected="--format html", got=file_format)
    if file_format == "html" and times is not None:
        raise wrong_use("--times", expected="another format", got="html", cure="A page shows all times.")
    if not out_path.is_dir():
        refuse_existing(out_path, overwrite)
    file = linked_file(out_path, model_path) if linked else None
    if file is not None and not (file.exists() and file.samefile(model_path)):
        refuse_existing(file, overwrite)
    model = load_video_model(model_path)
    if file_format == "html":
        check_writable(out_path)
        frames = None if original is None else read_fitted_clip(model, model_path, original, None, name="--original")
        with show_status("Writing the page"):
            options = {"original": frames, "quality": original_quality, "linked": linked}
            out_path = write_result(out_path, lambda path: write_html(path, model_path, **options))
        size = out_path.stat().st_size / 1e6
        beside = f", which reads {linked_file(out_path, model_path)}" if linked else ""
        out.print(f"{out_path}: a page of {size:.1f} MB{beside}, {model.num_gaussians:,} Gaussians", soft_wrap=True)
        return
    if file_format == "ply" and isinstance(model, EditedVideo):
        cure = "Its frames can be exported as ply3dgs or obj."
        raise wrong_use("MODEL", expected="a plain model for ply", got="one with edits", cure=cure)
    num_frames = model.num_frames if chosen is None else len(chosen)

    def write(path: Path) -> Path:
        with progress_bar("Writing", num_frames, shown=file_format != "ply") as advance:
            return export(model, file_format, path, times=chosen, overwrite=overwrite, on_frame=advance)

    path = write_result(out_path, write)
    frames = f"{num_frames:,} frame{'' if num_frames == 1 else 's'}"
    most = "" if file_format == "ply" else "up to "  # a frame has only its live Gaussians
    text = f"{_NAMES[file_format]} ({file_format}), {frames}, {most}{model.num_gaussians:,} Gaussians"
    out.print(f"{path}: {text}{' each' if most and num_frames > 1 else ''}", soft_wrap=True)


@app.command(name="import")
def import_command(
    source: Annotated[
        Path,
        typer.Argument(
            metavar="FILE",
            help="A .ply of VeGaS, or a folder of .obj and .ply.",
            autocompletion=complete_files(".ply"),
        ),
    ],
    out_path: Annotated[
        Path | None,
        typer.Option(
            "--out",
            help=f"FILE{MODEL_SUFFIX}; of a folder of triangles: a video or a folder "
            f"[default: by FILE's name, {MODEL_SUFFIX} or .mp4].",
        ),
    ] = None,
    size: Size = None,
    fps: Annotated[float | None, typer.Option(help="Frames per second [default: the file's, or 25].")] = None,
    overwrite: Overwrite = False,
) -> None:
    """Read a model of another program, see docs/formats.md.

    Triangles cannot be converted back into Gaussians: they are rendered as images.
    """
    image_size = parse_size(size)
    if out_path is None:
        out_path = name_after(source, VIDEO_SUFFIXES[0] if source.is_dir() else MODEL_SUFFIX)
    if source.is_dir():
        check_image_path(out_path)
        if not out_path.is_dir():
            refuse_existing(out_path, overwrite)
            check_writable(out_path)
        refuse_huge(image_size)
        mesh = read_pseudomesh(source, size=image_size, fps=fps)
        refuse_huge(mesh.size)
        write_images(out_path, mesh.frames, mesh.num_frames, mesh.fps, overwrite=overwrite)
        return
    if out_path.suffix.lower() != MODEL_SUFFIX:
        raise wrong_use("--out", expected=f"a name ending in {MODEL_SUFFIX}", got=out_path)
    refuse_existing(out_path, overwrite)
    check_writable(out_path)
    model = import_model(source, size=image_size, fps=fps)
    save_video_model(out_path, model, metadata={"clip": source.name})
    out.print(f"{out_path}: {model.num_frames} frames, {model.num_gaussians:,} Gaussians", soft_wrap=True)
