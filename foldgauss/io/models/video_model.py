"""How fitted and edited videos are described in a model file's header, and which arrays of them are stored."""

import dataclasses
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from foldgauss._runtime.checks import (
    ParameterError,
    check_one_of,
    check_within,
    invalid,
    is_integer,
    is_within,
    require,
    short_repr,
)
from foldgauss.envelope import TimeLikelihood
from foldgauss.io._atomic import PathLike, check_path
from foldgauss.io.media.frame_rate import are_rising_seconds
from foldgauss.io.models.compact import COMPACT_SUFFIX, compact_metadata, is_compact, load_compact_model
from foldgauss.io.models.model_file import (
    Kind,
    ModelFileError,
    load_part,
    read_header,
    register_model,
    save_model,
)
from foldgauss.io.models.segmented import EDITED, SEGMENTED, VIDEO, load_segmented, save_segmented
from foldgauss.render import COMPOSITINGS, Camera, RenderOptions
from foldgauss.video.editing.chain import Edit
from foldgauss.video.editing.edited_video import EditedVideo, Layer, as_edited
from foldgauss.video.editing.overlays import describe_overlay, restore_overlay
from foldgauss.video.models.frame_times import FrameTimes
from foldgauss.video.models.row_layout import columns, unpack
from foldgauss.video.models.shared_paths import MAX_PATHS, SharedPaths, check_paths
from foldgauss.video.models.video_model import VideoModel
from foldgauss.video.segmented.segmented_video import SegmentedVideo

MODEL_SUFFIX = ".safetensors"
#: Metadata of which frames of which clip a model shows, and when the clip shows them.
CLIP_NOTES = ("clip", "frames", "frame_seconds", "first_second")


def save_video_model(
    path: PathLike, model: VideoModel | EditedVideo | SegmentedVideo, *, metadata: dict | None = None
) -> Path:
    """Write a fitted, an edited or a segmented video; `metadata` is free: where it came from, how good it is.

    Segments are written one after another, each with its own metadata. See `save_model`.

    The name ends in .safetensors, or has no extension. Raises ValueError for another one, `ModelFileError` for edits
    that hold code: `apply`, a camera that is a function.
    """
    check_path(path, "path, model")
    require(
        isinstance(model, VideoModel | EditedVideo | SegmentedVideo),
        "model",
        expected="a VideoModel, an EditedVideo or a SegmentedVideo",
        got=type(model).__name__,
        cure="End the chain with .video()." if isinstance(model, Edit) else "",
    )
    _check_model_name(path)
    if isinstance(model, SegmentedVideo):
        return save_segmented(Path(path), model, metadata)
    return save_model(path, model, metadata=metadata)


def _check_model_name(path: PathLike) -> None:
    """Raise ValueError for a name with an extension that is another format's."""
    path = Path(path)
    if path.suffix and path.suffix.lower() != MODEL_SUFFIX:
        cure = "Images: write_video, or foldgauss render; other programs' formats: export."
        if path.suffix.lower() == COMPACT_SUFFIX:
            cure = "A compact file: foldgauss compress, or foldgauss.video.compress and foldgauss.io.save_compact."
        raise invalid(
            "path",
            expected=f"a name for the model, as {path.with_suffix(MODEL_SUFFIX).name}",
            got=repr(str(path)),
            cure=cure,
        )


def load_video_model(path: PathLike) -> VideoModel | EditedVideo | SegmentedVideo:
    """Read a fitted, an edited or a segmented video, or a compact file (detected from its first bytes).

    Of segments no more than the header is read: see `SegmentedVideo`, which loads them on access.

    Raises `FileNotFoundError`; `ModelFileError` also for a file of another kind.
    """
    path = check_path(path)
    if is_compact(path):
        return load_compact_model(path)
    about = read_header_of_kind(path, VIDEO, EDITED, SEGMENTED)
    if about["kind"] == SEGMENTED:
        return load_segmented(path, about)
    return load_part(path, about)


def read_metadata(path: PathLike) -> dict:
    """The metadata of a model file, compact or not. Raises as `load_video_model`."""
    path = check_path(path)
    return compact_metadata(path) if is_compact(path) else read_header(path)["metadata"]


def read_origin(path: PathLike) -> dict:
    """`read_metadata`, which is not trusted, without those of `fit`'s entries that have another type than it writes."""
    return {name: value for name, value in read_metadata(path).items() if name not in _NOTES or _NOTES[name](value)}


def keep_origin(about: Mapping[str, Any], *names: str) -> dict[str, Any]:
    """The entries of a model's metadata with these names."""
    return {name: about[name] for name in names if name in about}


def read_frame_seconds(about: dict, num_frames: int) -> np.ndarray | None:
    """Seconds at which the frames of a fitted clip are shown, and the end, (num_frames + 1,), from `read_origin`.

    None where they are evenly spaced.
    """
    seconds = about.get("frame_seconds")
    return None if seconds is None or len(seconds) != num_frames + 1 else np.array(seconds, np.float64)


def _is_range(value: object) -> bool:
    """Whether these are frames A up to, not including, B, as `read_video` takes them."""
    right = isinstance(value, list) and len(value) == 2 and all(end is None or is_integer(end, 0) for end in value)
    return right and (value[1] is None or value[1] > (value[0] or 0))


#: Metadata that `fit` and `compress` write and later commands read, with their checks.
_NOTES: dict[str, Callable[[object], bool]] = {
    **dict.fromkeys(("clip", "frames_digest", "clip_digest"), lambda value: isinstance(value, str)),
    "frames": _is_range,
    "frame_seconds": lambda value: isinstance(value, list) and are_rising_seconds(value),
    "first_second": lambda value: is_within(value, "[0, inf)"),
    "seed": lambda value: is_integer(value, 0),
    "mean_psnr": lambda value: is_within(value, "(0, 100]"),
}


def read_header_of_kind(path: PathLike, *kinds: str) -> dict:
    """The header of a file of one of these kinds; raises `ModelFileError` for another kind."""
    about = read_header(path)
    require(
        about["kind"] in kinds,
        "path",
        expected=f"a model of kind {' or '.join(map(repr, kinds))}",
        got=f"{about['kind']!r} in {str(path)!r}",
        cure="Give the file that `foldgauss fit` wrote to --out.",
        kind=ModelFileError,
    )
    return about


def _check_video(video: VideoModel | EditedVideo) -> None:
    for layer in as_edited(video).layers:
        check_paths(layer.model.splats)


def _describe_video(model: VideoModel) -> dict:
    about = {
        "num_gaussians": model.splats.num_gaussians,
        "degree": model.splats.degree,
        "envelope": type(model.splats.envelope).__name__,
        "num_frames": model.num_frames,
        "size": list(model.size),
        "fps": model.fps,
        "options": dataclasses.asdict(model.options),
        "compositing": model.compositing,
        "scale_cutoff": model.scale_cutoff,
    }
    if model.splats.paths is not None:
        about["paths"] = list(model.splats.paths.times.shape)
    return about


def _video_skeleton(header: dict) -> VideoModel:
    check_one_of("envelope", header["envelope"], ("TimeLikelihood",))
    num, degree, num_frames = header["num_gaussians"], header["degree"], header["num_frames"]
    height, width = header["size"]
    counts_fit = all(is_integer(count, 1) for count in (num, num_frames, height, width)) and is_integer(degree, 0)
    require(counts_fit, "size", expected="sizes and counts above 0", got=short_repr(header))
    check_within("fps", header["fps"], "(0, inf)", "a rate above 0")
    check_one_of("compositing", header["compositing"], COMPOSITINGS)
    check_within("scale_cutoff", header["scale_cutoff"], "[0, 1]", "a number in [0, 1]")
    row_width = columns(degree)["coefficients"].stop
    num_paths, num_knots = header.get("paths", (0, 0))
    paths_fit = not num_paths or (is_integer(num_paths, 1) and num_paths <= MAX_PATHS and is_integer(num_knots, 1))
    require(
        paths_fit,
        "paths",
        expected="numbers of paths and of their maps",
        got=f"{num_paths}, {num_knots}",
    )

    def build() -> VideoModel:
        times, maps = (jnp.zeros((num_paths, num_knots, *shape), jnp.float32) for shape in ((), (2, 3)))
        rows, paths = jnp.zeros((num, row_width), jnp.float32), SharedPaths(times, maps) if num_paths else None
        return VideoModel(
            splats=unpack(rows, degree, TimeLikelihood(np.float32(1)), paths),
            frame_times=FrameTimes(jnp.zeros(num_frames - 1, jnp.float32)),
            size=(height, width),
            fps=float(header["fps"]),
            options=RenderOptions(**header["options"]),
            compositing=header["compositing"],
            scale_cutoff=float(header["scale_cutoff"]),
        )

    return jax.eval_shape(build)  # traced, not computed: nothing is allocated


def _describe_edited(video: EditedVideo) -> dict:
    try:
        layers = [_describe_layer(layer) for layer in video.layers]
    except ParameterError as error:  # a function
        raise ModelFileError(error.parameter, error.problem) from error
    return {"layers": layers, "camera": _describe_camera(video.camera), "timeline": video.timeline}


def _describe_layer(layer: Layer) -> dict:
    return {
        "model": _describe_video(layer.model),
        "overlays": list(map(describe_overlay, layer.overlays)),
        "clocks": list(map(describe_overlay, layer.clocks)),
        "name": layer.name,
    }


def _describe_camera(camera: Camera | Callable | None) -> dict | None:
    if camera is None:
        return None
    require(
        isinstance(camera, Camera),
        "camera",
        expected="a Camera, which can be saved",
        got="a function",
        cure="Write the images, or save with seen_from(None) and set the camera again.",
        kind=ModelFileError,
    )
    about = {"aspect": camera.aspect, "dtype": camera.position.dtype.name}
    return about if camera.lens is None else about | {"lens": True}


def _edited_skeleton(header: dict) -> EditedVideo:
    layers = tuple(_layer_skeleton(layer) for layer in header["layers"])
    return EditedVideo(layers, _camera_skeleton(header["camera"]), timeline=header["timeline"])


def _layer_skeleton(header: dict) -> Layer:
    model = _video_skeleton(header["model"])
    mask = jax.ShapeDtypeStruct((model.splats.num_gaussians,), np.bool_)
    overlays, clocks = (tuple(restore_overlay(one, mask) for one in header[name]) for name in ("overlays", "clocks"))
    name = header.get("name", "")
    require(isinstance(name, str), "name", expected="a text", got=short_repr(name))
    return Layer(model, overlays, clocks, name)


def _camera_skeleton(header: dict | None) -> Camera | None:
    if header is None:
        return None
    check_one_of("camera's dtype", header["dtype"], ("float32", "float64"))
    shapes = {"rotation": (3, 3), "position": (3,), "fov": ()} | ({"lens": (3,)} if header.get("lens") else {})
    leaves = {name: jax.ShapeDtypeStruct(shape, np.dtype(header["dtype"])) for name, shape in shapes.items()}
    return jax.eval_shape(partial(Camera, aspect=header["aspect"]), **leaves)


register_model(Kind(VIDEO, VideoModel, to_header=_describe_video, from_header=_video_skeleton, check=_check_video))
register_model(Kind(EDITED, EditedVideo, to_header=_describe_edited, from_header=_edited_skeleton, check=_check_video))
