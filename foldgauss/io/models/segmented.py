"""Models of a clip's segments in one file, each loaded on access. The layout is in docs/formats.md."""

import dataclasses
import re
import tempfile
from collections.abc import Iterator, Sequence
from functools import lru_cache, partial
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np

from foldgauss._runtime.checks import check_one_of, check_within, is_integer, require, short_repr
from foldgauss.io._atomic import PathLike, check_path, check_writable
from foldgauss.io.models.compact import compact_metadata, is_compact, load_compact_model
from foldgauss.io.models.model_file import (
    ModelFileError,
    load_model,
    load_part,
    match_kind,
    open_tensors,
    read_header,
    save_model,
    translate_header_errors,
    write_tensors,
)
from foldgauss.render import COMPOSITINGS, RenderOptions
from foldgauss.video.editing.edited_video import EditedVideo
from foldgauss.video.models.video_model import VideoModel
from foldgauss.video.segmented.segmented_video import MAX_PREPARED, Segment, SegmentedVideo

SEGMENTED = "segmented-video"
#: A model, see `foldgauss.io.models.video_model`.
VIDEO = "video"
#: A model with edits that are applied when it is rendered.
EDITED = "edited-video"
#: A compact file, whose bytes are a tensor.
COMPACT = "compact"
#: Kinds of models that may be a segment.
PARTS = (VIDEO, EDITED, COMPACT)
#: The tensor of a compact segment, which has the bytes of its file.
_FILE = "file"
#: The properties of a compact segment's model that the header holds.
_FACTS = ("num_gaussians", "num_frames", "degree", "num_parameters", "size", "fps", "compositing")
_KEY = re.compile(r"segments\.(0|[1-9][0-9]{0,8})\.(.+)", re.DOTALL)


def join_segments(path: PathLike, sources: Sequence[tuple[int, PathLike]], *, metadata: dict | None = None) -> Path:
    """Write the models of a clip's segments into one file, whole or not at all; returns the path.

    `sources` has (number of its first frame in the whole clip, model file) of each segment, in order. Their tensors, or
    the bytes of compact files, are copied one by one, and their metadata kept; `metadata` are the whole file's. See
    `SegmentedVideo` for what goes together.

    Raises ValueError as `SegmentedVideo`; `FileNotFoundError`; `ModelFileError` for a file that is no ordinary model,
    such as one that has segments itself; `OutputError` where the path cannot be written.

    Example: `join_segments("long.safetensors", [(0, "a.safetensors"), (95, "b.safetensors")])`
    """
    path = check_path(path, "path, sources")
    files, entries, specs, segments = [], [], {}, []
    for number, source in enumerate(sources):
        first, file = _source(number, source)
        load = partial(load_compact_model if is_compact(file) else load_model, file)
        about = _describe_compact(file, load()) if is_compact(file) else read_header(file)
        require(
            about["kind"] in PARTS,
            "sources",
            expected="ordinary models",
            got=f"one of kind {about['kind']!r}, {str(file)!r}",
            cure="Join the files that it was made of.",
            kind=ModelFileError,
        )
        files.append(file)
        entries.append({"first": first} | {name: about[name] for name in ("kind", "header", "metadata")})
        specs |= {f"segments.{number}.{key}": spec for key, spec in about["tensors"].items()}
        segments.append(_segment(file, entries[-1], about["tensors"], load))
    SegmentedVideo(segments)  # raises ValueError unless they fit together
    check_writable(path)

    def tensors(keys: list[str]) -> Iterator[np.ndarray]:
        for number, some in groupby(keys, lambda key: int(_KEY.fullmatch(key)[1])):
            if entries[number]["kind"] == COMPACT:
                yield np.fromfile(files[number], np.uint8)
                continue
            with open_tensors(files[number]) as file:
                yield from (file.get_tensor(_KEY.fullmatch(key)[2]) for key in some)

    about = {"kind": SEGMENTED, "header": {"segments": entries}, "metadata": metadata or {}}
    return write_tensors(path, specs, tensors, about)


def save_segmented(path: Path, video: SegmentedVideo, metadata: dict | None) -> Path:
    """Write a video of segments, one after another: of models in memory, or edited since they were loaded.

    Beside the file a folder holds the segments until it is whole. Raises as `join_segments`.
    """
    check_writable(path)
    with tempfile.TemporaryDirectory(prefix=f".{path.stem[:40]}.tmp-", dir=path.parent) as folder:
        sources = []
        for number, segment in enumerate(video.segments):
            file = Path(folder) / f"{number}.safetensors"
            save_model(file, segment.model, metadata=dict(segment.metadata))
            sources.append((segment.first, file))
        return join_segments(path, sources, metadata=metadata)


def _source(number: int, source: object) -> tuple[int, Path]:
    require(
        isinstance(source, tuple | list) and len(source) == 2 and is_integer(source[0], 0),
        f"sources[{number}]",
        expected="(number of its first frame, model file)",
        got=short_repr(source),
    )
    return int(source[0]), check_path(source[1], "path, sources")


def _describe_compact(file: Path, model: VideoModel) -> dict[str, Any]:
    """A compact file as `read_header` describes others."""
    header = {name: getattr(model, name) for name in _FACTS} | {"options": dataclasses.asdict(model.options)}
    tensors = {_FILE: {"dtype": "U8", "shape": [file.stat().st_size]}}
    return {"kind": COMPACT, "header": header, "metadata": compact_metadata(file), "tensors": tensors}


# ---------------------------------------------------------------------------------------------- loading


def is_segmented(path: PathLike) -> bool:
    """Whether a file holds a video in segments; no tensor is read. Raises as `load_video_model`."""
    path = check_path(path)
    return not is_compact(path) and read_header(path)["kind"] == SEGMENTED


def load_segmented(path: Path, about: dict) -> SegmentedVideo:
    """The video in a file whose `read_header` is `about`: no tensor is read until a segment's model is asked for.

    A segment's model is checked when it is loaded. Raises `ModelFileError`, then as now.
    """
    with translate_header_errors(path, SEGMENTED):
        return SegmentedVideo(_segments(path, about))


def _segments(path: Path, about: dict) -> list[Segment]:
    entries = about["header"]["segments"]
    require(isinstance(entries, list), "segments", expected="a list", got=short_repr(entries))
    own: list[dict[str, dict]] = [{} for _ in entries]
    for key, spec in about["tensors"].items():
        found = _KEY.fullmatch(key)
        if found is None or int(found[1]) >= len(own):
            raise ValueError(f"tensor {key[:80]!r} is of no segment")
        own[int(found[1])][found[2]] = spec
    stamp = _stamp(path)

    @lru_cache(maxsize=MAX_PREPARED)
    def load(number: int) -> VideoModel | EditedVideo:
        require(
            _stamp(path) == stamp,
            "path",
            expected="the file as it was opened",
            got=f"a changed {str(path)!r}",
            cure="Load it again.",
            kind=ModelFileError,
        )
        if entries[number]["kind"] == COMPACT:
            named = path.with_name(f"{path.name}, segment {number + 1}")  # for messages
            with open_tensors(path) as file:
                return load_compact_model(named, file.get_tensor(f"segments.{number}.{_FILE}").tobytes())
        return load_part(path, entries[number] | {"tensors": own[number]}, f"segments.{number}.")

    return [_segment(path, entry, own[number], partial(load, number)) for number, entry in enumerate(entries)]


def _stamp(path: Path) -> tuple[int, ...]:
    """Properties that change when another file takes this name."""
    found = path.stat()
    return found.st_ino, found.st_size, found.st_mtime_ns


def _segment(path: Path, entry: dict, tensors: dict[str, dict], load: Any) -> Segment:
    """The segment that a header describes, checked against the tensors; its model is loaded on access.

    Raises as `match_kind`, and ValueError, KeyError or TypeError for an invalid header.
    """
    check_one_of("kind", entry["kind"], PARTS)
    require(isinstance(entry["metadata"], dict), "metadata", expected="a dict", got=short_repr(entry["metadata"]))
    if entry["kind"] != COMPACT:
        _, skeleton = match_kind(path, entry | {"tensors": tensors})
        segment = Segment.from_model(entry["first"], skeleton)
        return dataclasses.replace(segment, load=load, metadata=entry["metadata"])
    is_file = tensors.keys() == {_FILE} and tensors[_FILE]["dtype"] == "U8"
    require(is_file, "tensors", expected="a compact file", got=short_repr(tensors))
    facts = {name: entry["header"][name] for name in _FACTS}
    counts = [*facts["size"], *(facts[name] for name in ("num_gaussians", "num_frames", "num_parameters"))]
    right = len(counts) == 5 and all(is_integer(count, 1) for count in counts) and is_integer(facts["degree"], 0)
    require(right, "size", expected="a size and counts above 0", got=short_repr(facts))
    check_within("fps", facts["fps"], "(0, inf)", "a rate above 0")
    check_one_of("compositing", facts["compositing"], COMPOSITINGS)
    facts |= {"size": tuple(facts["size"]), "options": RenderOptions(**entry["header"]["options"])}
    return Segment(entry["first"], **facts, load=load, metadata=entry["metadata"])
