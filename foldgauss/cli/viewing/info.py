"""The command `info`."""

import json
from pathlib import Path

import numpy as np
from rich.table import Table

from foldgauss._runtime.checks import is_within
from foldgauss.cli.app.application import command, out
from foldgauss.cli.shared.arguments import ModelFile
from foldgauss.cli.shared.console import Video
from foldgauss.io.models.compact import is_compact, measure_chunks
from foldgauss.io.models.video_model import load_video_model, read_frame_seconds, read_origin
from foldgauss.video.editing.edited_video import EditedVideo, as_edited
from foldgauss.video.models.video_model import VideoModel
from foldgauss.video.segmented.segmented_video import SegmentedVideo


@command("info")
def info(model_path: ModelFile) -> None:
    """Show what a model file contains."""
    model = load_video_model(model_path)
    about = read_origin(model_path)
    if isinstance(model, SegmentedVideo):
        _print_segments(model_path, model, about)
        return
    powers = sorted({f"{float(one.model.splats.envelope.power):g}" for one in as_edited(model).layers})
    figures = {
        "frames": _describe_frames(model, about),
        "Gaussians": f"{model.num_gaussians:,}",
        "fold": f"polynomial of degree {model.degree}",
        **_describe_paths(model),
        **_describe_degrees(model),
        "envelope": f"time likelihood, power {' and '.join(powers)} (paper's text 1, its code 2)",
        "frame times": _describe_times(np.asarray(model.frame_times.times())),
        "parameters": f"{model.num_parameters:,}",
        "file": _describe_size(model_path, model),
        **_describe_chunks(model_path),
    }
    if isinstance(model, EditedVideo):
        figures["edits"] = _describe_edits(model)
    _print_facts(model_path, figures, about)


def _print_facts(model_path: Path, figures: dict[str, str], about: dict) -> None:
    table = Table(title=str(model_path), show_header=False)
    # Metadata of the fitted clip may have the name of a figure of the model.
    metadata = {
        f"{k} of the clip" if k in figures else k: _shorten(v)
        for k, v in about.items()
        if v is not None and k != "frame_seconds"
    }
    for name, value in (figures | metadata).items():
        table.add_row(name, value)
    out.print(table)


def _print_segments(model_path: Path, model: SegmentedVideo, about: dict) -> None:
    """Print what the header contains; the models are not loaded."""
    cuts, fades = len(model.cuts), len(model.segments) - 1 - len(model.cuts)
    joints = f"; begin at a cut: {cuts:,}; fade in: {fades:,}" if len(model.segments) > 1 else ""
    figures = {
        "frames": _describe_frames(model, about),
        "segments": f"{len(model.segments):,}{joints}",
        "Gaussians": f"{model.num_gaussians:,} in all",
        "fold": f"polynomial of degree {model.degree}",
        "parameters": f"{model.num_parameters:,}",
        "file": _describe_size(model_path, model),
    }
    _print_facts(model_path, figures, about)
    table = Table("segment", "frames", "begins", "Gaussians", "PSNR (dB)")
    before = None
    for number, segment in enumerate(model.segments):
        shared = 0 if before is None else before.stop - segment.first
        begins = "" if before is None else f"fading in over {shared:,}" if shared else "at a cut"
        quality = segment.metadata.get("mean_psnr")
        row = (f"{segment.first:,}:{segment.stop:,}", begins, f"{segment.num_gaussians:,}")
        table.add_row(str(number), *row, f"{quality:.2f}" if is_within(quality, "(0, 100]") else "")
        before = segment
    out.print(table)


def _describe_frames(model: Video, about: dict) -> str:
    seconds = read_frame_seconds(about, model.num_frames)
    rate = f"{model.fps:g} per second"
    if seconds is not None:
        rate = f"{model.num_frames / seconds[-1]:.4g} per second on average"
    return f"{model.num_frames:,} of {model.size[0]}x{model.size[1]} (height x width), {rate}"


def _describe_paths(model: VideoModel | EditedVideo) -> dict[str, str]:
    """How many Gaussians follow shared paths."""
    parts = [layer.model.splats for layer in as_edited(model).layers if layer.model.splats.paths is not None]
    if not parts:
        return {}
    followers = np.concatenate(
        [np.bincount(np.asarray(splats.path_index), minlength=splats.paths.num_paths + 1)[1:] for splats in parts]
    )
    num, knots = len(followers), {splats.paths.num_knots for splats in parts}
    paths = "a shared path" if num == 1 else f"{num:,} shared paths"
    each = f"{'' if len(knots) == 1 else 'up to '}{max(knots):,} knots"
    text = f"{followers.sum():,} of {model.num_gaussians:,} Gaussians follow {paths} of {each}"
    return {"paths": text}


def _describe_edits(model: EditedVideo) -> str:
    """The edits of each layer that are not baked into its parameters, and how many Gaussians they are of."""
    layers = []
    for layer in model.layers:
        edits = (*layer.overlays, *layer.clocks)
        count = np.logical_or.reduce([np.asarray(one.mask) for one in edits]).sum() if edits else 0
        on = f" on {count:,} of {layer.num_gaussians:,} Gaussians" if edits else ""
        layers.append(f"{len(edits) or 'none'}{on}")
    if len(layers) > 1:
        names = [f"{number} ({layer.name})" if layer.name else number for number, layer in enumerate(model.layers)]
        layers = [f"layer {name}: {text}" for name, text in zip(names, layers, strict=True)]
    return ", ".join(layers) + "; those baked into the parameters are not counted"


def _describe_degrees(model: VideoModel | EditedVideo) -> dict[str, str]:
    """How many Gaussians have folds of each degree, where some have a lower one than the model."""
    parts = [layer.model.splats for layer in as_edited(model).layers]
    if all((splats.degrees == splats.degree).all() for splats in parts):
        return {}
    degrees = np.concatenate([splats.degrees for splats in parts])
    counts = zip(*np.unique(degrees, return_counts=True), strict=True)
    return {"degrees": ", ".join(f"{count:,} Gaussians of degree {degree}" for degree, count in counts)}


def _describe_times(times: np.ndarray) -> str:
    if len(times) == 1:
        return "a single frame, shown at all times"
    return f"learned, steps {np.diff(times).min():.2e} to {np.diff(times).max():.2e}"


def _describe_size(path: Path, model: Video) -> str:
    num_bytes, num_pixels = path.stat().st_size, model.num_frames * model.size[0] * model.size[1]
    kind = "compact, " if is_compact(path) else ""
    return f"{kind}{num_bytes:,} bytes, {8 * num_bytes / num_pixels:.3f} bits per pixel of the frames"


def _describe_chunks(path: Path) -> dict[str, str]:
    """The chunks of a compact file that has several."""
    sizes, whole = measure_chunks(path) if is_compact(path) else ([], 0)
    return {"chunks": f"{len(sizes):,}; the first is {sizes[0] / whole:.0%} of the file"} if len(sizes) > 1 else {}


def _shorten(value: object) -> str:
    text = json.dumps(value) if isinstance(value, list | dict) else str(value)
    return text if len(text) <= 60 else text[:57] + "..."
