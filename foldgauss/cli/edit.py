"""The commands that change a model, and take it to other programs and back: `edit`, `segment`, `export`, `import`."""

import dataclasses
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from foldgauss._runtime.checks import invalid
from foldgauss.cli.app.completion import among, clip_files, files
from foldgauss.cli.app.shared import (
    ModelFile,
    Overwrite,
    Size,
    WrongUse,
    app,
    check_picture_path,
    clip_of_model,
    counted,
    draw,
    err,
    named_after,
    out,
    parse_size,
    parse_times,
    progress_bar,
    refuse_existing,
    refuse_huge,
    refuse_input,
)
from foldgauss.io._atomic import check_writable
from foldgauss.io.edit_script import read_edit_script
from foldgauss.io.exchange.export_import import FORMATS, export, import_model
from foldgauss.io.exchange.pseudomesh import read_pseudomesh
from foldgauss.io.media.video_writing import VIDEO_SUFFIXES, write_video
from foldgauss.io.models.segmented import is_segmented
from foldgauss.io.models.video_model import (
    MODEL_SUFFIX,
    check_model_name,
    load_video_model,
    read_origin,
    save_video_model,
)
from foldgauss.io.page.player_page import HTML_SUFFIX, QUALITY, write_html
from foldgauss.video.editing.edited_video import EditedVideo
from foldgauss.video.models.video_model import VideoModel
from foldgauss.video.segmented.segmented_video import SegmentedVideo

_CALLED = {"ply": "VeGaS video", "ply3dgs": "3DGS scenes", "obj": "triangles", "html": "player"}
#: Options of a page, also of `view`.
Original = Annotated[
    Path | None,
    typer.Option(
        metavar="CLIP",
        help="The clip it was fitted to, to be shown beside it in the player.",
        autocompletion=clip_files,
    ),
]
OriginalQuality = Annotated[
    int, typer.Option(help="Of the clip's pictures in the page, as WebP counts it.", min=1, max=100)
]


@app.command(name="edit")
def edit_command(
    model_path: ModelFile,
    script_path: Annotated[
        Path,
        typer.Argument(
            metavar="SCRIPT.toml",
            help="What to select, and what to do with it.",
            autocompletion=files(".toml"),
        ),
    ],
    out_path: Annotated[
        Path | None,
        typer.Option(
            "--out",
            help=f"FILE{MODEL_SUFFIX}: the edited model; a video or a folder: its pictures "
            f"[default: MODEL.SCRIPT{MODEL_SUFFIX} in this folder].",
        ),
    ] = None,
    size: Size = None,
    overwrite: Overwrite = False,
) -> None:
    """Edit objects or single frames of a model by a script.

    Scripts: docs/editing.md. An edited model is rendered, evaluated and edited again like any other.
    """
    if out_path is None:
        out_path = named_after(model_path, f".{script_path.stem}{MODEL_SUFFIX}")
    refuse_input(out_path, "model", model_path)
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
        about = read_origin(model_path)
        about = {key: about[key] for key in ("clip", "frames") if key in about} | {"edited_by": script_path.name}
        if isinstance(edited, SegmentedVideo):
            edited = _without_scores(model, edited)
        save_video_model(out_path, edited, metadata=about)
        kind = "a plain model" if isinstance(edited, VideoModel) else "a model with edits"
        if isinstance(edited, SegmentedVideo):
            kind = f"a model in {len(edited.segments)} segments"
        out.print(f"{out_path}: {kind}, {edited.num_gaussians:,} Gaussians", soft_wrap=True)
        return
    draw(edited, out_path, np.asarray(edited.frame_times.times()), edited.fps, size=picture_size, overwrite=overwrite)


def _without_scores(model: SegmentedVideo, edited: SegmentedVideo) -> SegmentedVideo:
    """The edited video; what was noted of its segments' quality is of them unedited."""
    before = set(map(id, model.segments))
    segments = []
    for segment in edited.segments:
        if id(segment) not in before:
            kept = {name: value for name, value in segment.metadata.items() if name in ("clip", "frames")}
            segment = dataclasses.replace(segment, metadata=kept)
        segments.append(segment)
    return SegmentedVideo(segments)


@app.command(name="export")
def export_command(
    model_path: ModelFile,
    file_format: Annotated[
        str,
        typer.Option(
            "--format",
            help="ply: VeGaS video; ply3dgs: 3DGS scenes; obj: triangles of each frame; html: a player.",
            autocompletion=among(FORMATS),
        ),
    ],
    out_path: Annotated[
        Path | None,
        typer.Option(
            "--out",
            help="FILE.ply for ply, and for ply3dgs of one time; FILE.html for html; else a folder, also for ply of a "
            "model in segments [default: by the model's name].",
        ),
    ] = None,
    times: Annotated[
        str | None,
        typer.Option(
            metavar="T,T,..|A:B:N", help="These times, in [0, 1]; or N from A to B [default: those of the frames]."
        ),
    ] = None,
    original: Original = None,
    original_quality: OriginalQuality = QUALITY,
    overwrite: Overwrite = False,
) -> None:
    """Write a model for other programs, or a page.

    See docs/formats.md; of the page, which plays the model, docs/player.md.
    """
    if file_format not in FORMATS:
        raise WrongUse(str(invalid("--format", expected="one of " + ", ".join(FORMATS), got=file_format)))
    chosen = parse_times(times)
    segmented = file_format == "ply" and is_segmented(model_path)
    if out_path is None:
        single = file_format == "ply3dgs" and chosen is not None and len(chosen) == 1
        endings = {
            "ply": "-ply" if segmented else ".ply",
            "ply3dgs": ".3dgs.ply" if single else "-3dgs",
            "html": ".html",
        }
        out_path = named_after(model_path, endings.get(file_format, f"-{file_format}"))
    refuse_input(out_path, "model", model_path)
    if segmented and out_path.suffix and not out_path.is_dir():
        cure = "Each segment becomes a file in it."
        raise WrongUse(str(invalid("--out", expected="a folder without extension", got=out_path, cure=cure)))
    if file_format == "ply" and not segmented and out_path.suffix.lower() != ".ply":
        raise WrongUse(str(invalid("--out", expected="a name ending in .ply", got=out_path)))
    if file_format == "obj" and out_path.suffix:
        raise WrongUse(str(invalid("--out", expected="a folder without extension", got=out_path)))
    if file_format == "html" and out_path.suffix.lower() != HTML_SUFFIX:
        raise WrongUse(str(invalid("--out", expected=f"a name ending in {HTML_SUFFIX}", got=out_path)))
    if file_format != "html" and original is not None:
        raise WrongUse(str(invalid("--original", expected="--format html", got=file_format)))
    if file_format == "html" and times is not None:
        raise WrongUse(str(invalid("--times", expected="another format", got="html", cure="A page shows all times.")))
    if not out_path.is_dir():
        refuse_existing(out_path, overwrite)
    model = load_video_model(model_path)
    if file_format == "html":
        check_writable(out_path)
        frames = None if original is None else clip_of_model(model, model_path, original, None)
        with err.status("Making the page"):
            write_html(out_path, model_path, original=frames, quality=original_quality)
        size = out_path.stat().st_size / 1e6
        out.print(f"{out_path}: a page of {size:.1f} MB, {model.num_gaussians:,} Gaussians", soft_wrap=True)
        return
    if file_format == "ply" and isinstance(model, EditedVideo):
        cure = "Frames of it go out as ply3dgs or obj."
        raise WrongUse(str(invalid("MODEL", expected="a plain model for ply", got="one with edits", cure=cure)))
    num_frames = model.num_frames if chosen is None else len(chosen)
    with progress_bar("Writing", num_frames, shown=file_format != "ply") as advance:
        path = export(model, file_format, out_path, times=chosen, overwrite=overwrite, on_frame=advance)
    frames = f"{num_frames:,} frame{'' if num_frames == 1 else 's'}"
    most = "" if file_format == "ply" else "up to "  # of frames, those alive
    told = f"{_CALLED[file_format]} ({file_format}), {frames}, {most}{model.num_gaussians:,} Gaussians"
    out.print(f"{path}: {told}{' each' if most and num_frames > 1 else ''}", soft_wrap=True)


@app.command(name="segment")
def segment_command(
    model_path: ModelFile,
    number: Annotated[int, typer.Argument(metavar="NUMBER", help="Which, from 0; see foldgauss info.")],
    out_path: Annotated[
        Path | None,
        typer.Option("--out", help=f"FILE{MODEL_SUFFIX} [default: MODEL.NUMBER{MODEL_SUFFIX} in this folder]."),
    ] = None,
    overwrite: Overwrite = False,
) -> None:
    """Take one segment out of a model in segments, as a model of its own.

    It is compressed, edited, viewed as any other; its frames are those of its span, told by foldgauss info.
    """
    if out_path is None:
        out_path = named_after(model_path, f".{number}{MODEL_SUFFIX}")
    try:
        check_model_name(out_path, "--out")
    except ValueError as error:
        raise WrongUse(str(error)) from error
    refuse_input(out_path, "model", model_path)
    refuse_existing(out_path, overwrite)
    check_writable(out_path)
    video, about = load_video_model(model_path), read_origin(model_path)
    if not isinstance(video, SegmentedVideo):
        raise WrongUse(str(invalid("MODEL", expected="a model in segments", got="one of one piece")))
    if not 0 <= number < len(video.segments):
        expected = f"a whole number from 0 to {len(video.segments) - 1}"
        raise WrongUse(str(invalid("NUMBER", expected=expected, got=number)))
    segment = video.segments[number]
    begins = (about.get("frames") or [0])[0] or 0
    whole = {"clip": about["clip"]} if "clip" in about else {}
    known = whole | {"frames": [begins + segment.first, begins + segment.stop]} | dict(segment.metadata)
    save_video_model(out_path, segment.model, metadata=known)
    told = f"segment {number}, frames {segment.first:,}:{segment.stop:,}, {segment.num_gaussians:,} Gaussians"
    out.print(f"{out_path}: {told}", soft_wrap=True)


@app.command(name="import")
def import_command(
    source: Annotated[
        Path,
        typer.Argument(
            metavar="FILE",
            help="A .ply of VeGaS, or a folder of .obj and .ply.",
            autocompletion=files(".ply"),
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
    fps: Annotated[float | None, typer.Option(help="Frames a second [default: as noted in the file, or 25].")] = None,
    overwrite: Overwrite = False,
) -> None:
    """Read what another program made: see docs/formats.md.

    Frames edited as triangles have no fold any more: they become pictures.
    """
    picture_size = parse_size(size)
    if out_path is None:
        out_path = named_after(source, VIDEO_SUFFIXES[0] if source.is_dir() else MODEL_SUFFIX)
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
