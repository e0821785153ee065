"""How the fitted video and the running fit are described in a model file's header."""

import dataclasses
import os
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from foldgauss._checks import invalid, one_of
from foldgauss.envelope import TimeLikelihood
from foldgauss.io.model_file import ModelFileError, load_model, read_header, register_model, save_model
from foldgauss.render import COMPOSITINGS, RenderOptions
from foldgauss.video.config import FitConfig
from foldgauss.video.fit import TIME_ADAM, FitState
from foldgauss.video.frame_times import FrameTimes
from foldgauss.video.growth import Statistics
from foldgauss.video.model import VideoModel
from foldgauss.video.packing import columns, unpack

VIDEO, CHECKPOINT = "video", "fit-checkpoint"


def save_video_model(path: str | os.PathLike, model: VideoModel, *, metadata: dict | None = None) -> Path:
    """Write a fitted video; `metadata` is free: where it came from, how good it is. See `save_model`."""
    return save_model(path, model, metadata=metadata)


def load_video_model(path: str | os.PathLike) -> VideoModel:
    """Read a fitted video. Raises `ModelFileError` also where the file holds something else of ours."""
    return _load(path, VIDEO)


def save_checkpoint(path: str | os.PathLike, state: FitState, *, config: FitConfig, source: dict) -> Path:
    """Write a running fit with what it must be continued with: its settings and its frames."""
    return save_model(path, state, metadata={"config": dataclasses.asdict(config), "source": source})


def load_checkpoint(path: str | os.PathLike, *, config: FitConfig, source: dict) -> FitState:
    """Read a running fit. Raises ValueError if it was started with other settings or other frames."""
    kept = read_header(path)["metadata"]
    for part, now in (("config", dataclasses.asdict(config)), ("source", source)):
        before = kept.get(part) or {}
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
    state = _load(path, CHECKPOINT)
    return jax.tree.map(np.array, state)  # the fit updates its arrays in place: they must be its own


def _load(path: str | os.PathLike, kind: str) -> Any:
    found = read_header(path)["kind"]
    if found != kind:
        raise ModelFileError(
            f"path: expected a model of kind {kind!r}, got {found!r} in {str(path)!r}. "
            "Give the file that `foldgauss fit` wrote to --out."
        )
    return load_model(path)


def _describe_video(model: VideoModel) -> dict:
    return {
        "num_gaussians": model.splats.num_gaussians,
        "degree": model.splats.degree,
        "envelope": type(model.splats.envelope).__name__,
        "num_frames": model.num_frames,
        "size": list(model.size),
        "fps": model.fps,
        "options": dataclasses.asdict(model.options),
        "compositing": model.compositing,
    }


def _video_skeleton(header: dict) -> VideoModel:
    if header["envelope"] != "TimeLikelihood":
        raise ValueError(f"envelope {header['envelope']!r} is unknown here")
    num, degree, num_frames = header["num_gaussians"], header["degree"], header["num_frames"]
    height, width = header["size"]
    if min(num, num_frames - 1, height, width) < 1 or degree < 0 or not float(header["fps"]) > 0:
        raise ValueError("a size, count or rate is out of range")
    compositing = header.get("compositing", "over")  # files from before there was another
    one_of("compositing", compositing, COMPOSITINGS)
    row_width = columns(degree)["coefficients"].stop

    def build() -> VideoModel:
        return VideoModel(
            splats=unpack(jnp.zeros((num, row_width), jnp.float32), degree, TimeLikelihood(np.float32(1))),
            frame_times=FrameTimes(jnp.zeros(num_frames - 1, jnp.float32)),
            size=(height, width),
            fps=float(header["fps"]),
            options=RenderOptions(**header["options"]),
            compositing=compositing,
        )

    return jax.eval_shape(build)  # traced, not computed: nothing is allocated


def _describe_checkpoint(state: FitState) -> dict:
    num, width = state.rows.shape
    return {
        "num_gaussians": num,
        "width": width,
        "num_intervals": len(state.time_logits),
        "growing": state.statistics is not None,
        "step": state.step,
        "plan": state.plan,
        "seconds": state.seconds,
        "error": state.error,
    }


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
        time_logits=floats(intervals),
        time_moments=jax.eval_shape(TIME_ADAM.init, floats(intervals)),
        statistics=Statistics(floats(num), floats(num), counts) if header["growing"] else None,
        step=int(header["step"]),
        plan=int(header["plan"]),
        seconds=float(header["seconds"]),
        error=float(header["error"]),
    )


register_model(VIDEO, VideoModel, to_header=_describe_video, from_header=_video_skeleton)
register_model(CHECKPOINT, FitState, to_header=_describe_checkpoint, from_header=_checkpoint_skeleton)
