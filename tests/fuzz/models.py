"""Targets: our own files of models, safetensors and compact."""

import dataclasses
import functools
import json
import tempfile
import warnings
import zlib
from pathlib import Path
from random import Random

import numpy as np

from foldgauss.envelope import TimeLikelihood
from foldgauss.io import (
    ModelFileError,
    load_compact,
    load_video_model,
    save_compact,
    save_video_model,
)
from foldgauss.io.models import compact
from foldgauss.io.models.checkpoint import load_checkpoint, save_checkpoint
from foldgauss.io.models.model_file import load_model
from foldgauss.io.models.video_model import read_origin
from foldgauss.render import Camera, RenderOptions
from foldgauss.video import FoldedSplats, FrameTimes, SegmentedVideo, VideoModel, layers
from foldgauss.video.compression.quantize import Rule, column_names, compute_columns, is_integral, quantize
from foldgauss.video.editing.chain import edit
from foldgauss.video.fitting.config import FitConfig
from foldgauss.video.fitting.state import STATISTICS, FitState
from foldgauss.video.models.shared_paths import SharedPaths
from foldgauss.video.selection.selectors import Selection

from .mutate import by_chance, json_changed, json_text_changed
from .target import CONSTANT, Target, chance


def tiny_model(num: int = 3, degree: int = 1, *, frames: int = 3, seed: int = 0) -> VideoModel:
    """Some Gaussians, of which every other one is at rest where there are many."""
    rng = np.random.default_rng(seed)

    def normal(*shape: int) -> np.ndarray:
        return (0.3 * rng.normal(size=(num, *shape))).astype(np.float32)

    leaves = {
        "loc": normal(2), "log_scale": normal(2) - 2, "angle_logit": normal(), "time_loc_logit": normal(),
        "log_time_scale": normal(), "coefficients": normal(degree, 2), "opacity_logit": normal(), "color_dc": normal(3),
    }  # fmt: skip
    if num > 8:
        leaves["coefficients"][::2] = 0
    splats = FoldedSplats(**leaves, envelope=TimeLikelihood(np.float32(2), np.float32(0)))
    return VideoModel(splats, FrameTimes.uniform(frames), (4, 6), 25.0, RenderOptions(), "over")


def written(write, suffix: str = "") -> bytes:
    """The bytes that a function of a path writes."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"one{suffix}"
        write(path)
        return path.read_bytes()


# ---------------------------------------------------------------------------------------------- safetensors


def unsealed(data: bytes) -> tuple[dict, bytes]:
    """(header, tensors) of a safetensors file."""
    start = tensors_from(data)
    return json.loads(data[8:start]), data[start:]


def sealed(header: dict, tensors: bytes) -> bytes:
    text = json.dumps(header).encode("utf-8", "surrogatepass")
    text += b" " * (-len(text) % 8)
    return len(text).to_bytes(8, "little") + text + tensors


def tensors_from(data: bytes) -> int:
    return min(8 + int.from_bytes(data[:8], "little"), len(data))


#: What a header may say of itself that is none of ours, or of another kind.
_KINDS = (
    ("kind", "segmented-video"),
    ("kind", "video"), ("kind", "edited-video"), ("kind", "selection"), ("kind", "fit-checkpoint"), ("kind", "x"),
    ("version", "2"),
    ("format", "pt"), ("header", "[]"), ("header", "{"), ("header", "[" * 5000),
    ("metadata", "1"), ("metadata", "[" * 9999),
)  # fmt: skip


def facts_changed(data: bytes, random: Random) -> bytes:
    """One of the model's own facts, in the JSON within the JSON."""
    header, tensors = unsealed(data)
    about, name = header["__metadata__"], random.choice(("header", "header", "header", "metadata"))
    changed = name, json.dumps(json_changed(json.loads(about[name]), random))
    about.update([random.choice(_KINDS) if random.randrange(8) == 0 else changed])
    return sealed(header, tensors)


def table_changed(data: bytes, random: Random) -> bytes:
    """One thing in the table of tensors."""
    header, tensors = unsealed(data)
    return sealed(json_changed(header, random), tensors)


_MODEL_MUTATIONS = (facts_changed, table_changed)


@functools.cache
def _edited():
    model = tiny_model()
    found = edit(model).select(Selection(np.array([True, False, True])))
    moved = found.move((0.1, 0.0)).opacity(0.5, times=(0.2, 0.8)).recolor(hue=0.2).retime(shift=0.1).place(depth=0.1)
    video = layers(moved.video(), tiny_model(seed=1))
    return edit(video).seen_from(Camera.front(4 / 6).orbit(0.1, 0.0)).video()


def _video_seeds() -> list[bytes]:
    models = [tiny_model(), tiny_model(degree=0, frames=1), tiny_model(16, 3), _edited()]
    models.append(dataclasses.replace(_edited(), camera=None))
    joined = [
        (0, tiny_model(seed=2)),
        (2, dataclasses.replace(_edited(), camera=None)),
        (5, tiny_model(8, 3)),
    ]
    models += [SegmentedVideo.from_models(joined), SegmentedVideo.from_models([(0, tiny_model(degree=0, frames=1))])]
    return [
        written(lambda path, one=one: save_video_model(path, one, metadata={"clip": "a", "frames": [0, 3]}))
        for one in models
    ]


def _read_video(path: Path) -> None:
    read_origin(path)
    if chance(path) % 8 == 0:
        load_model(path)  # the door below, which takes all kinds
    model = load_video_model(path)
    for segment in getattr(model, "segments", ()):
        assert segment.model.num_frames == segment.num_frames
        assert segment.model.num_gaussians == segment.num_gaussians
    assert model.num_frames >= 1
    assert len(model.size) == 2
    str(model)


VIDEO = Target(
    "model",
    ".safetensors",
    _video_seeds,
    _read_video,
    (ModelFileError,),
    _MODEL_MUTATIONS,
    tensors_from,
)


_CONFIG, _SOURCE = FitConfig(), {"clip": "a", "num_frames": 3}


def _checkpoint_seeds() -> list[bytes]:
    rng = np.random.default_rng(0)

    def floats(*shape: int) -> np.ndarray:
        return rng.normal(size=shape).astype(np.float32)

    counts, width, num = np.arange(3, dtype=np.int32), 14, 3
    kept, state = [], None
    for sums in ({}, dict(zip(STATISTICS, (floats(num), floats(num), counts), strict=True))):
        state = FitState.create(
            floats(num, width), floats(2), counts=counts, first=floats(num, width),
            second=floats(num, width), frame_errors=floats(3), growing=bool(sums), **sums,
            step=5, plan=100, seconds=1.5, last_finite=state, start_errors=((0, 0.1),),
        )  # fmt: skip
        kept.append(written(lambda path, one=state: save_checkpoint(path, one, config=_CONFIG, source=_SOURCE)))
    return kept


CHECKPOINT = Target(
    "checkpoint",
    ".safetensors",
    _checkpoint_seeds,
    lambda path: load_checkpoint(path, config=_CONFIG, source=_SOURCE),
    (ModelFileError, ValueError),
    _MODEL_MUTATIONS,
    tensors_from,
)


# ---------------------------------------------------------------------------------------------- compact


def _on_paths(model: VideoModel, times: tuple[float, ...]) -> VideoModel:
    matrices = np.eye(2, 3) + np.linspace(0, 0.1, 12 * len(times)).reshape(2, -1, 2, 3)
    paths = SharedPaths(np.tile(np.float32(times), (2, 1)), matrices.astype(np.float32))
    index = (np.arange(model.num_gaussians) % 3).astype(np.uint8)
    return dataclasses.replace(model, splats=dataclasses.replace(model.splats, path_index=index, paths=paths))


@functools.cache
def _quantised() -> tuple:
    found = []
    for model, cells, num_chunks in (
        (tiny_model(), (0, 0, 0), 1),
        (tiny_model(16, 3), (1, 1, 1), 1),
        (tiny_model(4, 0, frames=1), (1, 0, 1), 1),
        (_on_paths(tiny_model(8, 1), (0.0, 0.5, 1.0)), (1, 0, 1), 1),
        (_on_paths(tiny_model(8, 1), (-0.5, 2.0)), (1, 0, 1), 2),
        (tiny_model(9, 2), (0, 0, 1), 3),
    ):
        described = compute_columns(model)
        names = (name for name in column_names(model.degree) if not is_integral(name))
        rules = {name: Rule(0.5 if name == "time" else 0.0, -6.0, (0.1,)) for name in names}
        place = np.arange(model.num_gaussians, dtype=np.int32)
        made = quantize(described, place % 4, rules, num_chunks - 1 - num_chunks * place // model.num_gaussians)
        parts = []
        for chunk in made.chunks:
            where = np.arange(chunk.num, dtype=np.int32) % 2 ** sum(cells)
            parts.append(dataclasses.replace(chunk, cells=cells, columns=chunk.columns | {"cell": where}))
        found.append(dataclasses.replace(made, chunks=tuple(parts)))
    return tuple(found)


def compact_resealed(data: bytes) -> bytes:
    """With the checksum that belongs to its header."""
    text = data[20 : 20 + int.from_bytes(data[12:16], "little")]
    return data[:16] + zlib.crc32(text).to_bytes(4, "little") + data[20:] if len(data) >= 20 else data


def blocks_resealed(data: bytes) -> bytes:
    """With the checksums that belong to its blocks as well, where the header is still one."""
    length = int.from_bytes(data[12:16], "little")
    header, body, end = json.loads(data[20 : 20 + length]), data[20 + length :], 0
    for own in (header["motion"], *header["chunks"]):
        start, end = end, end + sum(own["streams"])
        own["crc"] = zlib.crc32(body[start:end])
    text = json.dumps(header).encode().ljust(length)
    return compact_resealed(data[:12] + len(text).to_bytes(4, "little") + bytes(4) + text + body)


def _compact_body(data: bytes) -> int:
    return min(20 + int.from_bytes(data[12:16], "little"), len(data))


def stream_changed(data: bytes, random: Random) -> bytes:
    """Coded numbers changed, under right checksums; or under those of before, as by damage."""
    changed = by_chance(data, random, _compact_body(data))
    return blocks_resealed(changed) if random.randrange(4) else changed


def compact_header_changed(data: bytes, random: Random) -> bytes:
    """One of the header's facts, with its length and the checksum to match."""
    if random.randrange(10) == 0:
        return compact_resealed(data[:8] + random.choice((0, 1, 3, 2**32 - 1)).to_bytes(4, "little") + data[12:])
    length = int.from_bytes(data[12:16], "little")
    header = json_text_changed(data[20 : 20 + length], random)
    return compact_resealed(data[:12] + len(header).to_bytes(4, "little") + bytes(4) + header + data[20 + length :])


def _read_compact(path: Path) -> None:
    read_origin(path) if compact.is_compact(path) else load_compact(path)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", ".*(chunks (is|are)|that can be read, but) cut off or damaged")
        load_video_model(path) if compact.is_compact(path) else None
        if chance(path) % 4 == 0:
            load_compact(path, visible=(0.2, 0.3))
            compact.measure_chunks(path)


COMPACT = Target(
    "compact",
    ".fgz",
    lambda: [
        written(lambda path, one=one: save_compact(path, one, metadata={"clip": "a"}), ".fgz") for one in _quantised()
    ],
    _read_compact,
    (ModelFileError,),
    (stream_changed, compact_header_changed),
    _compact_body,
    lambda size: 4 * CONSTANT + 2_000 * size,  # a byte may hold 32 numbers: the format's own limit
)

TARGETS = (VIDEO, CHECKPOINT, COMPACT)
