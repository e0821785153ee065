"""Checkpoints: a running fit in a file, with the settings and the frames that it must be continued with."""

import dataclasses
import os
from pathlib import Path

import jax
import numpy as np

from foldgauss._runtime.checks import invalid
from foldgauss.io.models.model_file import load_part, read_header, register_model, save_model
from foldgauss.io.models.video_model import read_header_of_kind
from foldgauss.video.fitting.codebook import Codebook
from foldgauss.video.fitting.config import FitConfig
from foldgauss.video.fitting.growth import GradientStatistics
from foldgauss.video.fitting.state import TIME_ADAM, FitState

CHECKPOINT = "fit-checkpoint"
#: The one setting with which a fit may go on otherwise: no step depends on it while all is well.
FREE = "on_divergence"


def save_checkpoint(path: str | os.PathLike, state: FitState, *, config: FitConfig, source: dict) -> Path:
    """Write a running fit with what it must be continued with: its settings and its frames."""
    return save_model(path, state, metadata={"config": dataclasses.asdict(config), "source": source})


def load_checkpoint(path: str | os.PathLike, *, config: FitConfig, source: dict) -> FitState:
    """Read a running fit. Raises ValueError if it was started with other settings or other frames."""
    kept = read_header(path)["metadata"]
    for part, now in (("config", dataclasses.asdict(config)), ("source", source)):
        before = kept.get(part)
        before = before if isinstance(before, dict) else {}
        now, before = ({name: value for name, value in held.items() if name != FREE} for held in (now, before))
        changed = sorted(name for name in now.keys() | before.keys() if now.get(name) != before.get(name))
        cure = f"Continue {str(path)!r} with the options it was started with, or start anew with --overwrite."
        if part == "config" and now.keys() != before.keys():
            cure = "Another version of foldgauss kept it: continue with that, or start anew with --overwrite."
        if changed:
            raise invalid(
                "resume",
                expected=", ".join(f"{name}={before.get(name)!r}" for name in changed),
                got=", ".join(f"{name}={now.get(name)!r}" for name in changed),
                cure=cure,
            )
    about = read_header_of_kind(path, CHECKPOINT)
    state = load_part(Path(path), about["kind"], about["header"], about["tensors"])
    return jax.tree.map(np.array, state)  # the fit updates its arrays in place: they must be its own


def _describe_checkpoint(state: FitState) -> dict:
    num, width = state.rows.shape
    return {
        "num_gaussians": num,
        "width": width,
        "num_intervals": len(state.time_logits),
        "growing": state.statistics is not None,
        "colors": _counts(state.colors),
        "shapes": _counts(state.shapes),
        "step": state.step,
        "plan": state.plan,
        "seconds": state.seconds,
        "error": state.error,
        "best_error": state.best_error,
        "backoffs": state.backoffs,
        "settled": state.settled,
        "should_be_better": state.should_be_better,
        "start_errors": [list(pair) for pair in state.start_errors],
        "sound": None if state.sound is None else _describe_checkpoint(state.sound),
    }


def _counts(palette: Codebook) -> list[int]:
    return [len(palette.index), len(palette.counts)]


def _palette_skeleton(counts: list[int], width: int) -> Codebook:
    num, entries = counts
    integers = [jax.ShapeDtypeStruct((count,), np.int32) for count in (num, entries)]
    moments = jax.ShapeDtypeStruct((entries, width), np.float32)
    return Codebook(integers[0], moments, moments, integers[1])


def _checkpoint_skeleton(header: dict) -> FitState:
    num, width, intervals = header["num_gaussians"], header["width"], header["num_intervals"]

    def floats(*shape: int) -> jax.ShapeDtypeStruct:
        return jax.ShapeDtypeStruct(shape, np.float32)

    counts = jax.ShapeDtypeStruct((num,), np.int32)
    return FitState(
        rows=floats(num, width),
        first=floats(num, width),
        second=floats(num, width),
        counts=counts,
        kinds=jax.ShapeDtypeStruct((num,), np.uint8),
        young=jax.ShapeDtypeStruct((num,), np.bool_),
        colors=_palette_skeleton(header["colors"], 3),
        shapes=_palette_skeleton(header["shapes"], 2),
        frame_errors=floats(intervals + 1),
        time_logits=floats(intervals),
        time_moments=jax.eval_shape(TIME_ADAM.init, floats(intervals)),
        statistics=GradientStatistics(floats(num), floats(num), counts) if header["growing"] else None,
        step=int(header["step"]),
        plan=int(header["plan"]),
        seconds=float(header["seconds"]),
        error=float(header["error"]),
        best_error=float(header.get("best_error", 0.0)),
        backoffs=int(header.get("backoffs", 0)),
        sound=_checkpoint_skeleton(_sound_of(header)) if header.get("sound") else None,
        settled=int(header.get("settled", 0)),
        should_be_better=int(header.get("should_be_better", 0)),
        start_errors=tuple((int(frame), float(error)) for frame, error in header.get("start_errors", ())),
    )


def _sound_of(header: dict) -> dict:
    """The header of the last sound state, which has none of its own."""
    return header["sound"] | {name: header[name] for name in ("width", "num_intervals")} | {"sound": None}


register_model(CHECKPOINT, FitState, to_header=_describe_checkpoint, from_header=_checkpoint_skeleton)
