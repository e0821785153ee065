"""The command `edit`."""

import dataclasses
from functools import partial
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from foldgauss._runtime.checks import require
from foldgauss.cli.app.application import command, out
from foldgauss.cli.shared.arguments import ModelFile, Overwrite, Size, Timeline, parse_size
from foldgauss.cli.shared.console import show_status
from foldgauss.cli.shared.files import check_images_output, check_output, name_after, refuse_huge
from foldgauss.cli.shared.rendering import Output, SoundFile, choose_sound
from foldgauss.io._atomic import write_or_keep
from foldgauss.io.edit_script import read_edit_script
from foldgauss.io.models.video_model import (
    CLIP_NOTES,
    MODEL_SUFFIX,
    keep_origin,
    load_video_model,
    read_frame_seconds,
    read_origin,
    save_video_model,
)
from foldgauss.video.models.video_model import VideoModel
from foldgauss.video.motion.slow_motion import interpolate_frames
from foldgauss.video.segmented.segmented_video import SegmentedVideo


@command("edit")
def edit_command(
    model_path: ModelFile,
    script_path: Annotated[
        Path,
        typer.Argument(
            metavar="SCRIPT.toml",
            help="The selections and their edits.",
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
    inputs |= {f"script's {path}": path for path in script.inputs}
    as_model = out_path.suffix.lower() == MODEL_SUFFIX
    image_size = parse_size(size)
    for option, given, fits in (("--size", image_size, "a video or a folder"), ("--sound", sound, "a video")):
        require(not as_model or given is None, option, expected=f"{fits} as --out", got=out_path)
    check = check_output if as_model else partial(check_images_output, others=(MODEL_SUFFIX,))
    check(out_path, overwrite, inputs)
    model, about = load_video_model(model_path), read_origin(model_path)
    refuse_huge(image_size or model.size)
    sounding = choose_sound(sound, Timeline(), about, model.fps)
    output = Output(out_path, model.fps, overwrite, encoding={"sound": sounding})
    if not as_model:
        output.check(image_size or model.size, model.num_frames)
    with show_status(f"Applying {script_path.name}"):
        edited = script.apply(model, about)
    if as_model:
        about = keep_origin(about, *CLIP_NOTES) | {"edited_by": script_path.name}
        if isinstance(edited, SegmentedVideo):  # without their scores, which were measured before the edit
            kept = [(segment, keep_origin(segment.metadata, *CLIP_NOTES)) for segment in edited.segments]
            edited = SegmentedVideo([dataclasses.replace(segment, metadata=about) for segment, about in kept])
        out_path = write_or_keep(out_path, lambda path: save_video_model(path, edited, metadata=about))
        kinds = {VideoModel: "a plain model", SegmentedVideo: "a model in segments"}
        kind = kinds.get(type(edited), "a model with edits")
        out.print(f"{out_path}: {kind}, {edited.num_gaussians:,} Gaussians", soft_wrap=True)
        return
    draw = partial(interpolate_frames, edited, np.asarray(edited.frame_times.times()), image_size)
    seconds = read_frame_seconds(about, edited.num_frames)
    dataclasses.replace(output, fps=edited.fps, times=seconds).write(draw, edited.num_frames)
