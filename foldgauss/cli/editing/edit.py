"""The commands `edit` and `segment`."""

import dataclasses
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from foldgauss.cli.app.application import WrongUse, app, out, wrong_use
from foldgauss.cli.app.completion import complete_files
from foldgauss.cli.shared.arguments import ModelFile, Overwrite, Size, parse_size
from foldgauss.cli.shared.log_lines import print_log
from foldgauss.cli.shared.outputs import (
    check_image_path,
    name_after,
    refuse_existing,
    refuse_huge,
    refuse_inputs,
    write_result,
)
from foldgauss.cli.shared.rendering import (
    SoundFile,
    VideoOptions,
    check_video_options,
    choose_sound,
    render_to_file,
)
from foldgauss.cli.shared.timeline import Timeline
from foldgauss.io._atomic import check_writable
from foldgauss.io.edit_script import read_edit_script
from foldgauss.io.models.video_model import (
    CLIP_NOTES,
    MODEL_SUFFIX,
    check_model_name,
    keep_origin,
    load_video_model,
    read_frame_seconds,
    read_origin,
    save_video_model,
)
from foldgauss.video.models.video_model import VideoModel
from foldgauss.video.segmented.segmented_video import SegmentedVideo


@app.command(name="edit")
def edit_command(
    model_path: ModelFile,
    script_path: Annotated[
        Path,
        typer.Argument(
            metavar="SCRIPT.toml",
            help="The selections and their edits.",
            autocompletion=complete_files(".toml"),
        ),
    ],
    out_path: Annotated[
        Path | None,
        typer.Option(
            "--out",
            help=f"FILE{MODEL_SUFFIX}: the edited model; a video or a folder: its images "
            f"[default: MODEL.SCRIPT{MODEL_SUFFIX} in this folder].",
        ),
    ] = None,
    size: Size = None,
    sound: SoundFile = None,
    overwrite: Overwrite = False,
) -> None:
    """Edit objects or single frames of a model by a script.

    Scripts: docs/editing.md. An edited model can be rendered, evaluated and edited like any model.
    """
    if out_path is None:
        out_path = name_after(model_path, f".{script_path.stem}{MODEL_SUFFIX}")
    script = read_edit_script(script_path)
    inputs = {"model": model_path, "script": script_path, "sound": sound}
    refuse_inputs(out_path, inputs | {f"script's {path}": path for path in script.inputs})
    as_model = out_path.suffix.lower() == MODEL_SUFFIX
    image_size = parse_size(size)
    for option, given, fits in (("--size", image_size, "a video or a folder"), ("--sound", sound, "a video")):
        if as_model and given is not None:
            raise wrong_use(option, expected=f"{fits} as --out", got=out_path)
    if not as_model:
        check_image_path(out_path, others=MODEL_SUFFIX)
        refuse_huge(image_size)
    if not out_path.is_dir():
        refuse_existing(out_path, overwrite)
        check_writable(out_path)
    model, about = load_video_model(model_path), read_origin(model_path)
    if not as_model:
        refuse_huge(image_size or model.size)
        options = VideoOptions(sound=choose_sound(sound, Timeline(), about, model.fps))
        check_video_options(out_path, image_size or model.size, model.fps, options)
    with print_log():
        edited = script.apply(model, about)
    if as_model:
        about = keep_origin(about, *CLIP_NOTES) | {"edited_by": script_path.name}
        if isinstance(edited, SegmentedVideo):
            edited = _drop_scores(model, edited)
        out_path = write_result(out_path, lambda path: save_video_model(path, edited, metadata=about))
        kind = "a plain model" if isinstance(edited, VideoModel) else "a model with edits"
        if isinstance(edited, SegmentedVideo):
            kind = f"a model in {len(edited.segments)} segments"
        out.print(f"{out_path}: {kind}, {edited.num_gaussians:,} Gaussians", soft_wrap=True)
        return
    how = {"size": image_size, "overwrite": overwrite, "options": options}
    seconds = read_frame_seconds(about, edited.num_frames)
    render_to_file(edited, out_path, np.asarray(edited.frame_times.times()), edited.fps, stamps=seconds, **how)


def _drop_scores(model: SegmentedVideo, edited: SegmentedVideo) -> SegmentedVideo:
    """Remove the recorded scores of edited segments, which were measured before the edit."""
    before = set(map(id, model.segments))
    segments = []
    for segment in edited.segments:
        if id(segment) not in before:
            segment = dataclasses.replace(segment, metadata=keep_origin(segment.metadata, *CLIP_NOTES))
        segments.append(segment)
    return SegmentedVideo(segments)


@app.command(name="segment")
def segment_command(
    model_path: ModelFile,
    number: Annotated[int, typer.Argument(metavar="NUMBER", help="Number of the segment, from 0; see foldgauss info.")],
    out_path: Annotated[
        Path | None,
        typer.Option("--out", help=f"FILE{MODEL_SUFFIX} [default: MODEL.NUMBER{MODEL_SUFFIX} in this folder]."),
    ] = None,
    overwrite: Overwrite = False,
) -> None:
    """Extract one segment of a model in segments as a model of its own.

    It can be compressed, edited and viewed like any model. Its frames are those of its span, see foldgauss info.
    """
    if out_path is None:
        out_path = name_after(model_path, f".{number}{MODEL_SUFFIX}")
    try:
        check_model_name(out_path, "--out")
    except ValueError as error:
        raise WrongUse(str(error)) from error
    refuse_inputs(out_path, {"model": model_path})
    refuse_existing(out_path, overwrite)
    check_writable(out_path)
    video, about = load_video_model(model_path), read_origin(model_path)
    if not isinstance(video, SegmentedVideo):
        raise wrong_use("MODEL", expected="a model in segments", got="one without segments")
    if not 0 <= number < len(video.segments):
        expected = f"a whole number from 0 to {len(video.segments) - 1}"
        raise wrong_use("NUMBER", expected=expected, got=number)
    segment = video.segments[number]
    begins = (about.get("frames") or [0])[0] or 0
    whole = keep_origin(about, "clip", "reading", "stretched")
    whole |= {"frames": [begins + segment.first, begins + segment.stop]}
    known = whole | dict(segment.metadata)
    seconds = read_frame_seconds(about, video.num_frames)
    if seconds is not None:  # the segment's own frames may be evenly spaced, at another rate than the whole clip's
        own = seconds[segment.first : segment.stop + 1]
        first = about.get("first_second", 0.0) + float(own[0])
        known |= {"frame_seconds": (own - own[0]).tolist(), "first_second": first}
    save_video_model(out_path, segment.model, metadata=known)
    text = f"segment {number}, frames {segment.first:,}:{segment.stop:,}, {segment.num_gaussians:,} Gaussians"
    out.print(f"{out_path}: {text}", soft_wrap=True)
