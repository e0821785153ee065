"""Checkpoints: a running fit in a file, with the settings and the frames that it must be resumed with."""

import dataclasses
from pathlib import Path

import jax
import numpy as np

from foldgauss._runtime.settings import check_unchanged, flatten
from foldgauss.io._atomic import PathLike
from foldgauss.io.models.model_file import Kind, load_part, register_model, save_model
from foldgauss.io.models.video_model import read_header_of_kind
from foldgauss.video.fitting.config import FitConfig
from foldgauss.video.fitting.state import FitState, Sizes

CHECKPOINT = "fit-checkpoint"


def save_checkpoint(path: PathLike, state: FitState, *, config: FitConfig, source: dict) -> Path:
    """Write a running fit with what it must be resumed with: its settings and its frames.

    The last finite state is omitted if it was taken at the same step, which halves the size of the file. Arrays are
    fetched (`FitState.fetch_all`).
    """
    state.fetch_all()
    if is_known_good(state):
        state = dataclasses.replace(state, last_finite=None)
    return save_model(path, state, metadata={"config": dataclasses.asdict(config), "source": source})


def load_checkpoint(path: PathLike, *, config: FitConfig, source: dict) -> FitState:
    """Read a running fit. Raises ValueError if it was started with other settings or other frames."""
    about = read_header_of_kind(path, CHECKPOINT)
    kept = about["metadata"]
    for part, now in (("config", dataclasses.asdict(config)), ("source", source)):
        before = kept.get(part)
        cure = f"Resume {str(path)!r} with the options it was started with, or start a new fit with --overwrite."
        check_unchanged("overwrite", flatten(before if isinstance(before, dict) else {}), flatten(now), cure)
    state = jax.tree.map(np.array, load_part(Path(path), about))  # updated in place, so they must be its own
    if state.last_finite is None:
        state.last_finite = state.copy()
    return state


def is_known_good(state: FitState) -> bool:
    """Whether the last finite state was taken at the present step."""
    return state.last_finite is not None and state.last_finite.step == state.step


def _describe(state: FitState) -> dict:
    """The header: the sizes of the arrays, and all other fields."""
    last = state.last_finite
    return {
        "sizes": state.sizes._asdict(),
        "counters": {name: getattr(state, name) for name in FitState.counter_fields()},
        "last_finite": None if last is None else _describe(last),
    }


def _make_skeleton(header: dict) -> FitState:
    sizes, last = Sizes(**header["sizes"]), header["last_finite"]
    counters = {name: decode(header["counters"][name]) for name, decode in FitState.counter_fields().items()}
    arrays = {name: kind.spec(sizes) for name, kind in FitState.array_fields().items()}
    last_finite = None if last is None else _make_skeleton(last | {"last_finite": None})
    if last and any(last["sizes"][name] != header["sizes"][name] for name in ("width", "num_frames")):
        raise ValueError("the last finite state is of another fit")
    return FitState(**arrays, **counters, last_finite=last_finite)


register_model(Kind(CHECKPOINT, FitState, to_header=_describe, from_header=_make_skeleton))
