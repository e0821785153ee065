"""Selections outside of programs: files with a digest of the model that they belong to, and indices as text."""

import dataclasses
import hashlib
import re
from collections.abc import Iterator
from pathlib import Path

import jax
import numpy as np

from foldgauss._runtime.checks import require
from foldgauss.io._atomic import PathLike, check_path
from foldgauss.io.models.model_file import Kind, ModelFileError, load_model, read_header, register_model, save_model
from foldgauss.video.models.video_model import ONE_SEGMENT, VideoModel
from foldgauss.video.segmented.segmented_video import SegmentedVideo
from foldgauss.video.selection.selectors import Selection

SELECTION = "selection"


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class _SelectionRecord:
    """The content of a selection file."""

    mask: np.ndarray
    digest: str = dataclasses.field(metadata={"static": True})


def save_selection(path: PathLike, selection: Selection, model: VideoModel) -> Path:
    """Write a selection of `model`'s Gaussians, whole or not at all: a safetensors file, a byte per Gaussian.

    **Raises:** ValueError for a selection of another number of Gaussians, `OutputError` as `save_video_model`.

    **Example:** `save_selection("bear.selection", by_mask(model, masks), model)`.
    """
    check_path(path, "path, selection, model")
    require(
        isinstance(selection, Selection),
        "selection",
        expected="a Selection",
        got=type(selection).__name__,
        cure="The order is (path, selection, model); Selection(mask) makes one of a mask.",
    )
    _check_model(model, "Save the selection with the model that it was made in.")
    num = model.splats.num_gaussians
    require(
        selection.num_gaussians == num,
        "selection",
        expected=f"one of the model's {num:,} Gaussians",
        got=f"{selection.num_gaussians:,}",
    )
    return save_model(path, _SelectionRecord(selection.mask, compute_digest(model)))


def load_selection(path: PathLike, model: VideoModel) -> Selection:
    """Read a selection of `model`'s Gaussians.

    **Raises:** ValueError for a selection of another model, or of this one before it was changed; `FileNotFoundError`;
    `ModelFileError` for a file of another kind, a damaged or a newer one.
    """
    check_path(path, "path, model")
    _check_model(model, "The order is (path, model).")
    kind = read_header(path)["kind"]
    require(
        kind == SELECTION,
        "path",
        expected="a selection",
        got=f"{kind!r} in {str(path)!r}",
        cure="Give the file that save_selection wrote.",
        kind=ModelFileError,
    )
    record = load_model(path)
    num, cure = model.splats.num_gaussians, "Load it with the model that it was made for, unchanged."
    require(
        len(record.mask) == num,
        "path",
        expected=f"a selection of the model's {num:,} Gaussians",
        got=f"one of {len(record.mask):,} in {str(path)!r}",
        cure=cure,
    )
    require(
        record.digest == compute_digest(model),
        "path",
        expected="a selection of this model",
        got=f"another's in {str(path)!r}",
        cure=cure,
    )
    return Selection(np.asarray(record.mask))


def _check_model(model: object, cure: str) -> None:
    require(
        isinstance(model, VideoModel),
        "model",
        expected="a VideoModel",
        got=type(model).__name__,
        cure=ONE_SEGMENT if isinstance(model, SegmentedVideo) else cure,
    )


_INDEX_RANGE = re.compile(r"\s*([0-9]{1,9})(?:-([0-9]{1,9}))?\s*")


def format_indices(selection: Selection) -> str:
    """The indices as a text of numbers and ranges whose ends are included: "3,17,40-52". See `parse_indices`."""
    edges = np.flatnonzero(np.diff(np.r_[False, selection.mask, False].astype(np.int8)))
    ends = zip(edges[::2], edges[1::2] - 1, strict=True)
    return ",".join(f"{first}" if first == last else f"{first}-{last}" for first, last in ends)


def parse_indices(text: str, num_gaussians: int) -> Selection:
    """The selection, of `num_gaussians`, that a text of numbers and ranges describes, as "3,17,40-52".

    **Raises:** ValueError for another text, and for indices that the model does not have.

    **Example:** `parse_indices("0-2,7", model.num_gaussians)`.
    """
    mask = np.zeros(num_gaussians, bool)
    for first, last in parse_ranges(text):
        require(
            last < num_gaussians,
            "indices",
            expected=f"Gaussians from 0 to {num_gaussians - 1:,}",
            got=f"{last:,}",
            cure="Is it another model's script?",
        )
        mask[first : last + 1] = True
    return Selection(mask)


def parse_ranges(text: str) -> Iterator[tuple[int, int]]:
    """The first and the last index of each range in a text of `parse_indices`; ValueError for another text."""
    for part in text.split(","):
        found = _INDEX_RANGE.fullmatch(part)
        first, last = (int(found[1]), int(found[2] or found[1])) if found else (0, -1)
        require(last >= first, "indices", expected='numbers and ranges, as "3,17,40-52"', got=repr(part[:40]))
        yield first, last


def compute_digest(model: VideoModel) -> str:
    """SHA-256 of the Gaussians: every leaf of the splats, by name, type, shape and value."""
    summed = hashlib.sha256()
    for keys, leaf in jax.tree_util.tree_flatten_with_path(model.splats)[0]:
        array = np.asarray(leaf)
        summed.update(f"{jax.tree_util.keystr(keys)} {array.dtype.name} {array.shape} ".encode())
        summed.update(array.astype(array.dtype.newbyteorder("<")).tobytes())
    return summed.hexdigest()


def _make_skeleton(header: dict) -> _SelectionRecord:
    if not isinstance(header["digest"], str):
        raise ValueError("the digest is not a string")
    return _SelectionRecord(jax.ShapeDtypeStruct((header["num_gaussians"],), np.bool_), header["digest"])


def _describe(record: _SelectionRecord) -> dict:
    return {"num_gaussians": len(record.mask), "digest": record.digest}


register_model(Kind(SELECTION, _SelectionRecord, to_header=_describe, from_header=_make_skeleton))
