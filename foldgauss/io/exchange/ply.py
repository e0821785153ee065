"""PLY files of Gaussians: the published VeGaS video, and the still scenes of 3DGS that ordinary viewers open.

Both hold values before activation: logarithms of scales, logits of opacity, degree-0 colour.
"""

import dataclasses
import json
import math
import os
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import jax
import numpy as np
import scipy
from jaxtyping import Float
from scipy.special import expit, logit

from foldgauss._runtime.checks import check_one_of, invalid, is_within, short_repr
from foldgauss.envelope import TimeLikelihood
from foldgauss.io._atomic import atomic_folder, check_replaceable
from foldgauss.io.exchange.ply_format import Ply, facts_error, format_error, read_ply, write_ply
from foldgauss.io.media.video_file import DEFAULT_FPS, MAX_FPS
from foldgauss.render import Camera, Gaussians3D, RenderOptions, pixels_per_unit
from foldgauss.render.camera import FIELD_OF_VIEW, THICKNESS
from foldgauss.render.splats import check_size
from foldgauss.video.models.frame_times import FrameTimes
from foldgauss.video.models.renderer import RenderableVideo, VideoRenderer
from foldgauss.video.models.splats import SH_C0, STATIC_LOG_TIME_SCALE, FoldedSplats
from foldgauss.video.models.video_model import VideoModel
from foldgauss.video.segmented.segmented_video import SegmentedVideo

#: The envelope's power of the published code, which scales standard deviations by exp(-tau^2 / 2).
VEGAS_POWER = 2.0
#: Standard deviations, in its units, above which alone the published code draws a Gaussian.
VEGAS_SCALE_CUTOFF = 1e-4
#: What the published code keeps in `scale_1`, across the plane, does not show; an eps of this size is written there.
_VEGAS_ACROSS = math.log(1e-8)
#: Our own facts about a model in a comment of the header: other programs skip it.
_NOTE = "foldgauss "

#: Depth between a Gaussian and the one behind it, in model units: some three steps of float32 at the distance of the
#: front camera (1.4), so that viewers which sort by depth keep the order. 40,000 Gaussians are 0.016 deep.
DEPTH_STEP = 4e-7
#: Axes of a 3DGS file: as trained scenes have them (COLMAP: x right, y down, z away), or y up and z towards the viewer.
AXES = ("y-down", "y-up")
#: Degrees of spherical harmonics that viewers know as a whole, and the number of `f_rest` columns of each.
_NUM_REST = {0: 0, 1: 9, 2: 24, 3: 45}
#: Logits of opacity are held within: sigmoid(17) is the last below 1 in float32.
_LOGIT_MAX = 17.0
_SMALLEST = 1e-20  # of a standard deviation, whose logarithm must be finite


# ------------------------------------------------------------------------------------------------ VeGaS


def read_vegas_ply(
    path: str | os.PathLike, *, size: tuple[int, int] | None = None, fps: float | None = None
) -> VideoModel:
    r"""A video from the PLY file of the published VeGaS code, with the picture that its formulas give.

    **Shapes:** element `vertex` with x, z, f_dc_0..2, opacity, scale_0, scale_2, rot_0, m_0, sigma_0 and
    w1_0..(2 degree - 1) (pairs (x, z) per power of u = m_t - t), element `time` with time_func_0..(num_frames - 2).

    **Units:** the file's space has its camera at (0, -1, 0) looking along y, the picture's right along x and its down
    along -z, with a horizontal field of view of 0.6911112, so its frame is 2 tan(0.6911112 / 2) = 0.72 wide. With
    w = min(1, width / height) the frame's width in model space,

    $$
    (x, y) = k\,(x, -z), \quad c_j = k\,(w_{j,x}, -w_{j,z}), \quad s = k\,(s_0, s_2),
    \quad k = \frac{w}{2 \tan(0.6911112 / 2)}
    $$

    The angle is the file's own: it turns about y there, and its axes (cos, -sin) and (sin, cos) in (x, z) are
    (cos, sin) and (sin, -cos) in the picture, where (-sin, cos) is the same axis. y, scale_1 and the normals are not
    read: the published renderer puts every Gaussian on the plane y = 0 and takes an eps for the scale across it.

    `size` = (height, width) and `fps` are not in such a file and must be given, the first always, the second where 25
    is wrong; files that `write_vegas_ply` made carry both. What is drawn follows the published constants: power 2, low
    pass 0.3 px^2, alpha up to 0.99 and from 1/255 on, exp(-tau^2 / 2) > 0.01, and standard deviations above 1e-4 of its
    units (`VideoModel.scale_cutoff`). Files of our own carry what the model had instead.

    **Raises:** `FileNotFoundError`, and `FormatError` for a file that is damaged, of another kind, with colours that
    depend on the view, or without a size.

    **Example:** `model = read_vegas_ply("point_cloud.ply", size=(480, 854), fps=24)`

    **Source:** VeGaS "Implementation Details", eq:vegas_equiv_cond and eq:frame_fitting; the layout is that of its
    published code.
    """
    ply = read_ply(path, ("vertex", "time"))
    _check_vegas(ply)
    size, fps, options, scale_cutoff, power = _filled_in(ply, size, fps)
    degree = _degree(ply)
    names = ["x", "z", "scale_0", "scale_2", "rot_0", "m_0", "sigma_0", "opacity", "f_dc_0", "f_dc_1", "f_dc_2"]
    columns = ply.columns("vertex", [*names, *(f"w1_{k}" for k in range(2 * degree))])
    unit = _vegas_unit(size)
    plane = unit * np.array([1.0, -1.0])
    angle, time_loc, log_time_scale, opacity = columns[:, 4:8].T
    leaves = {
        "loc": plane * columns[:, 0:2],
        "log_scale": columns[:, 2:4] + math.log(unit),
        "angle_logit": angle,
        "time_loc_logit": time_loc,
        "log_time_scale": _with_power(log_time_scale, VEGAS_POWER, power),
        "coefficients": plane * columns[:, 11:].reshape(len(columns), degree, 2),
        "opacity_logit": opacity,
        "color_dc": columns[:, 8:11],
    }
    splats = FoldedSplats(
        **{name: _float32(ply, name, leaf) for name, leaf in leaves.items()},
        envelope=TimeLikelihood(np.float32(power), np.float32(0)),
    )
    return VideoModel(splats, FrameTimes(_time_logits(ply)), size, fps, options, scale_cutoff=scale_cutoff)


def write_vegas_ply(path: str | os.PathLike, model: VideoModel) -> Path:
    r"""Write a video as the published VeGaS code keeps it; returns the path. See `read_vegas_ply` for the layout.

    The envelope has power 2 there. That of another power p > 0 is the same function of time with

    $$ \sigma_t' = \sigma_t \sqrt{2 / p}, \quad \exp(-p\,u^2 / (2 \sigma_t^2)) = \exp(-2 u^2 / (2 \sigma_t'^2)) $$

    Leaves, sigma_t and the power among them, come back here to float32 rounding. The published code draws it with its
    own constants: a Gaussian up to 3.03 sigma_t' from m_t, where it is a hundredth as wide as at its widest (at p = 1
    the model itself ends at a tenth); a model that was fitted with another low pass than 0.3 px^2 (the presets' is 0.1)
    a little softer; and Gaussians whose scale, after the envelope, is below 1e-4 of its units (a fifth of a pixel at
    1280 wide) not at all.

    **Raises:** ValueError for a model that the published code cannot draw: an envelope of power 0, a floor, compositing
    "sum", one frame alone; `OutputError` where the path cannot be written.

    **Example:** `write_vegas_ply("point_cloud.ply", load_video_model("holiday.safetensors"))`

    **Source:** the layout of the published VeGaS code.
    """
    _check_writable_as_vegas(model)
    splats, unit = model.splats, _vegas_unit(model.size)
    plane = np.array([1.0, -1.0]) / unit
    loc = plane * _float64(splats.loc)
    scale = _float64(splats.log_scale) - math.log(unit)
    zeros = np.zeros(len(loc))
    columns = {"x": loc[:, 0], "y": zeros, "z": loc[:, 1], "nx": zeros, "ny": zeros, "nz": zeros}
    columns |= {f"f_dc_{c}": _float64(splats.color_dc)[:, c] for c in range(3)}
    columns |= {"opacity": splats.opacity_logit, "scale_0": scale[:, 0]}
    columns |= {"scale_1": np.full(len(loc), _VEGAS_ACROSS), "scale_2": scale[:, 1]}
    powers = _float64(splats.envelope.power)
    spread = _with_power(_float64(splats.log_time_scale), powers, VEGAS_POWER)
    columns |= {"rot_0": splats.angle_logit, "m_0": splats.time_loc_logit, "sigma_0": spread}
    weights = (plane * _float64(splats.coefficients)).reshape(len(loc), -1)
    columns |= {f"w1_{k}": weights[:, k] for k in range(weights.shape[1])}
    time_weights = {f"time_func_{k}": [weight] for k, weight in enumerate(_float64(model.frame_times.logits))}
    note = {"size": list(model.size), "fps": model.fps, "options": dataclasses.asdict(model.options)}
    note["scale_cutoff"] = model.scale_cutoff
    if np.unique(powers).size == 1:
        note["power"] = float(np.unique(powers)[0])
    return write_ply(path, {"vertex": columns, "time": time_weights}, comments=[_NOTE + json.dumps(note)])


def is_vegas(ply: Ply) -> bool:
    """Whether a PLY file is a published VeGaS video, by the columns that only those have."""
    return {"m_0", "sigma_0", "rot_0"} <= set(ply.names("vertex"))


def _with_power(
    log_time_scale: Float[np.ndarray, " num"], power: float | Float[np.ndarray, "*#num"], other: float
) -> Float[np.ndarray, " num"]:
    """log sigma_t that gives an envelope of the `other` power the same values; what lasts is 1 with either."""
    return np.where(
        log_time_scale == STATIC_LOG_TIME_SCALE, log_time_scale, log_time_scale + 0.5 * np.log(other / power)
    )


def _vegas_unit(size: tuple[int, int]) -> float:
    """One unit of the published space in model units: both know the frame's width."""
    height, width = size
    return min(1.0, width / height) / (2 * math.tan(FIELD_OF_VIEW / 2))


def _check_vegas(ply: Ply) -> None:
    if not is_vegas(ply):
        cure = "For a still scene use read_3dgs_ply." if is_3dgs(ply) else "Check that it is the right file."
        got = "properties " + ", ".join(ply.names("vertex")[:20]) if ply.names("vertex") else "no element 'vertex'"
        raise format_error(ply.path, expected="a VeGaS video, with m_0, sigma_0 and rot_0", got=got, cure=cure)
    if "time" not in ply.elements:
        cure = "It may be of another version of the published code."
        raise format_error(ply.path, expected="an element 'time' with the frames' weights", got="none", cure=cure)
    if len(ply.elements["vertex"]) == 0:
        raise format_error(ply.path, expected="Gaussians", got="none")
    rest = [name for name in ply.names("vertex") if name.startswith("f_rest_")]
    if rest and np.any(ply.columns("vertex", rest)):
        expected = "colours of degree 0, as VeGaS has them"
        raise format_error(ply.path, expected=expected, got="f_rest columns that are not 0")


def _degree(ply: Ply) -> int:
    num = sum(name.startswith("w1_") for name in ply.names("vertex"))
    if num % 2:
        expected = "an even number of w1 columns, pairs (x, z)"
        raise format_error(ply.path, expected=expected, got=str(num), cure="The file is damaged.")
    return num // 2


def _time_logits(ply: Ply) -> Float[np.ndarray, " intervals"]:
    """The frames' weights: columns of one row, or rows of one column."""
    names = sorted(ply.names("time"), key=lambda name: (len(name), name))
    weights = ply.columns("time", names)
    if 1 not in weights.shape or weights.size == 0:
        got = f"{weights.shape[0]} rows of {weights.shape[1]}"
        raise format_error(ply.path, expected="one row of weights in element 'time'", got=got)
    if weights.shape[0] == 1 and names != [f"time_func_{k}" for k in range(len(names))]:
        got = ", ".join(names[:9])
        raise format_error(ply.path, expected="time_func_0, time_func_1, ... in element 'time'", got=got)
    return weights.astype(np.float32).ravel()


def _filled_in(
    ply: Ply, size: tuple[int, int] | None, fps: float | None
) -> tuple[tuple[int, int], float, RenderOptions, float, float]:
    """What the file's columns do not say: as given, or as our own writer noted it, or the published."""
    note = _note(ply)
    if size is None and "size" not in note:
        cure = "Give the size of the video that it was made from, such as size=(480, 854)."
        raise format_error(ply.path, expected="a size, which a VeGaS file does not hold", got="none", cure=cure)
    try:
        options = RenderOptions(**note.get("options", {}))
        size = note["size"] if size is None else size
        fps = note.get("fps", DEFAULT_FPS) if fps is None else fps
        check_size(size)
        cutoff = note.get("scale_cutoff", VEGAS_SCALE_CUTOFF * _vegas_unit(size))
        if not is_within(cutoff, "[0, 1]"):
            raise invalid("scale_cutoff", expected="a number in [0, 1]", got=repr(cutoff))
        power = note.get("power", VEGAS_POWER)
        if not is_within(power, "(0, 1e30]"):
            raise invalid("power", expected="a number in (0, 1e30]", got=repr(power))
        if not is_within(fps, f"(0, {MAX_FPS}]"):
            raise invalid("fps", expected=f"a rate in (0, {MAX_FPS:g}]", got=repr(fps), cure="Try 25.")
    except (TypeError, ValueError) as error:
        raise facts_error(ply.path, error) from error
    return (int(size[0]), int(size[1])), float(fps), options, float(cutoff), float(power)


def _note(ply: Ply) -> dict:
    """What `write_vegas_ply` noted in a comment; nothing in files of others."""
    texts = [comment[len(_NOTE) :] for comment in ply.comments if comment.startswith(_NOTE)]
    try:
        note = json.loads(texts[0]) if texts else {}
    except (ValueError, RecursionError):
        note = None
    if not isinstance(note, dict) or not isinstance(note.get("options", {}), dict):
        raise format_error(ply.path, expected="facts in the comment 'foldgauss'", got=texts[0][:60], cure="Remove it.")
    return note


def _check_writable_as_vegas(model: VideoModel) -> None:
    if not isinstance(model, VideoModel):
        cure = "An edited video goes out frame by frame, as ply3dgs or obj."
        if isinstance(model, SegmentedVideo):
            cure = "export(model, 'ply', FOLDER) writes one for each segment."
        raise invalid("model", expected="a VideoModel", got=type(model).__name__, cure=cure)
    envelope = model.splats.envelope
    facts = {
        "floor": (np.unique(envelope.floor), 0.0, "Fit it without a floor."),
        "compositing": (np.array([model.compositing]), "over", "Fit it with --compositing over."),
    }
    if model.num_frames < 2:
        cure = "Write the picture as a still scene, ply3dgs."
        raise invalid("model", expected="at least 2 frames, whose distances a VeGaS file holds", got="1", cure=cure)
    for name, (found, known, cure) in facts.items():
        if not (found == known).all():
            got, expected = ", ".join(map(str, found[:3])), f"{known}, the only one in a VeGaS file"
            raise invalid(f"model's {name}", expected=expected, got=got, cure=cure)
    if not all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(model)):
        raise invalid("model", expected="finite numbers", got="NaN or infinities", cure="The fit diverged: fit again.")
    if not (np.asarray(envelope.power) > 0).all():
        cure = "Fit it with another --power."
        raise invalid("model's power", expected="above 0, as envelopes of a VeGaS file wane", got="0", cure=cure)


def _float32(ply: Ply, name: str, leaf: np.ndarray) -> np.ndarray:
    """The leaf in float32, contiguous; a change of units may pass its end."""
    with np.errstate(over="ignore"):
        leaf = np.ascontiguousarray(leaf, np.float32)
    if not np.isfinite(leaf).all():
        raise format_error(ply.path, expected=f"a {name} that float32 holds in model space", got="a larger one")
    return leaf


def _float64(leaf: object) -> np.ndarray:
    return np.asarray(leaf, np.float64)


# ------------------------------------------------------------------------------------------------- 3DGS


def frame_gaussians(model: RenderableVideo | VideoRenderer, t: float, *, depth_step: float = DEPTH_STEP) -> Gaussians3D:
    """The Gaussians that a model draws at time t, flat in space, front first, for programs that sort by depth.

    A `VideoRenderer` in place of the model saves the making of one for each of many times. Where segments of a video
    fade one into the other, they are those of the one that is seen more of.

    **Shapes:** leaves of `Gaussians3D` of the Gaussians alive at t, NumPy. **Units:** model space (see
    `foldgauss.render.camera`); `depth_step` in its units too.

    All Gaussians of a frame lie in one plane and cover each other by their order. Here each stands `depth_step` behind
    the one before, and is larger by as much as it is farther from the front camera, so that this camera sees the very
    picture of the model, and everything that sorts by depth blends it in the model's order. From elsewhere the
    layers shift against each other by `depth_step` times their number; 0 puts all into the plane.

    **Raises:** ValueError for a step or a time outside [0, 1].

    **Example:** `project(frame_gaussians(model, 0.5), Camera.front(aspect), model.size)`

    **Source:** VeGaS eq:mirage (flat Gaussians), eq:vegas_equiv_cond (of one time).
    """
    if not is_within(depth_step, "[0, 1]"):
        raise invalid("depth_step", expected="a depth in [0, 1] of the frame's longer side", got=repr(depth_step))
    if not is_within(float(t), "[0, 1]"):
        raise invalid("t", expected="a time in [0, 1]", got=repr(t))
    playback = model if isinstance(model, VideoRenderer) else VideoRenderer(model)
    mean, factor, opacity, color = _alive(playback, float(t))
    height, width = playback.model.size
    distance = -float(Camera.front(height / width).position[2])
    depth = depth_step * np.arange(len(mean))
    grown = (1 + depth / distance)[:, None]
    flat = np.zeros((len(mean), 3, 3))
    flat[:, :2, :2], flat[:, 2, 2] = factor * grown[..., None], THICKNESS
    mean = np.concatenate([mean * grown, depth[:, None]], axis=1)
    return Gaussians3D(*(leaf.astype(np.float32) for leaf in (mean, flat, opacity, color)))


def _alive(playback: VideoRenderer, t: float) -> tuple[np.ndarray, ...]:
    """(mean, factor, opacity, color) of what is drawn at time t (or near it, in a cut), in model space, float64."""
    splats = playback.dominant_splats(t)
    seen = np.asarray(splats.opacity) > 0
    leaves = (splats.mean, splats.factor, splats.opacity, splats.color)
    mean, factor, opacity, color = (_float64(leaf)[seen] for leaf in leaves)
    (height, width), unit = playback.size, pixels_per_unit(playback.size)
    return (mean - [width / 2, height / 2]) / unit, factor / unit, opacity, color


def write_gaussians_ply(
    path: str | os.PathLike, gaussians: Gaussians3D, *, axes: str = "y-down", sh_degree: int = 3
) -> Path:
    """Write Gaussians in space as a 3DGS PLY file, which ordinary viewers open; returns the path.

    The layout is that of the published 3DGS: x y z nx ny nz f_dc_0..2 f_rest_0..44 opacity scale_0..2 rot_0..3, all
    float32, little-endian, the quaternion as w x y z. Colours do not depend on the view, so f_rest is 0. Some viewers
    (SIBR, 3DGS.cpp) read nothing without it; all others take files of `sh_degree=0` too, a quarter as large.

    **Units:** model units; `axes` is "y-down" as in trained scenes (COLMAP: x right, y down, z away), which viewers of
    such scenes show upright, or "y-up" (x right, y up, z towards the viewer) for programs that take a file as it is.

    **Raises:** ValueError for other axes or degrees, for numbers that are not finite and for colours that are not RGB;
    `OutputError` where the path cannot be written.

    **Example:** `write_gaussians_ply("scene.ply", frame_gaussians(model, 0.5), axes="y-up")`

    **Source:** Kerbl et al. 2023, 3D Gaussian Splatting, and the file layout of its published code.
    """
    check_one_of("axes", axes, AXES)
    if sh_degree not in _NUM_REST:
        raise invalid("sh_degree", expected="0, 1, 2 or 3", got=repr(sh_degree))
    mean, factor, opacity, color = (_float64(leaf) for leaf in jax.tree.leaves(_turned(gaussians, axes)))
    if color.shape[-1:] != (3,):
        raise invalid("gaussians.color", expected="red, green and blue", got=f"{color.shape[-1:]} channels")
    if not all(np.isfinite(leaf).all() for leaf in (mean, factor, opacity, color)):
        raise invalid("gaussians", expected="finite numbers", got="NaN or infinities", cure="Drop those Gaussians.")
    scale, quaternion = _scales_and_quaternion(factor)
    zeros = np.zeros(len(mean))
    columns = {name: mean[:, c] for c, name in enumerate("xyz")} | dict.fromkeys(("nx", "ny", "nz"), zeros)
    columns |= {f"f_dc_{c}": (color[:, c] - 0.5) / SH_C0 for c in range(3)}
    columns |= {f"f_rest_{k}": zeros for k in range(_NUM_REST[sh_degree])}
    with np.errstate(divide="ignore"):
        columns["opacity"] = np.clip(logit(opacity), -_LOGIT_MAX, _LOGIT_MAX)
    columns |= {f"scale_{k}": np.log(np.maximum(scale[:, k], _SMALLEST)) for k in range(3)}
    columns |= {f"rot_{k}": quaternion[:, k] for k in range(4)}
    return write_ply(path, {"vertex": columns})


def write_3dgs_ply(
    path: str | os.PathLike,
    model: RenderableVideo,
    t: float,
    *,
    depth_step: float = DEPTH_STEP,
    axes: str = "y-down",
    sh_degree: int = 3,
) -> Path:
    """Write the picture of time t as a 3DGS PLY file; returns the path.

    `frame_gaussians` says what stands where, `write_gaussians_ply` how it is written.

    **Raises:** as these two, and ValueError for a model with compositing "sum", whose Gaussians cover nothing: viewers
    draw no such picture.

    **Example:** `write_3dgs_ply("frame.ply", model, 0.5)`
    """
    _check_covers(model)
    gaussians = frame_gaussians(model, t, depth_step=depth_step)
    return write_gaussians_ply(path, gaussians, axes=axes, sh_degree=sh_degree)


def write_3dgs_frames(
    folder: str | os.PathLike,
    model: RenderableVideo,
    times: Sequence[float] | None = None,
    *,
    depth_step: float = DEPTH_STEP,
    axes: str = "y-down",
    sh_degree: int = 3,
    overwrite: bool = False,
    on_frame: Callable[[], object] = lambda: None,
) -> Path:
    """Write pictures of a video as 3DGS PLY files frame_0000.ply, frame_0001.ply, ...; returns the folder.

    `times` (default: the model's frame times), in [0, 1]. The folder appears whole or not at all; one that holds files
    is refused unless `overwrite`, and even then if it holds anything else. `on_frame` is called after each.

    **Raises:** as `write_3dgs_ply`; `OutputError` where the folder is refused.

    **Example:** `write_3dgs_frames("frames", model)`
    """
    folder, times = Path(folder), checked_times(model, times)
    _check_covers(model)
    check = partial(check_replaceable, folder, overwrite, pattern=r"frame_[0-9]{4,}\.ply")
    check()
    playback = VideoRenderer(model)
    with atomic_folder(folder, check=check) as temporary:
        for number, t in enumerate(times):
            gaussians = frame_gaussians(playback, t, depth_step=depth_step)
            write_gaussians_ply(temporary / f"frame_{number:04d}.ply", gaussians, axes=axes, sh_degree=sh_degree)
            on_frame()
    return folder


def _check_covers(model: RenderableVideo) -> None:
    if model.compositing != "over":
        cure = "Fit it with --compositing over."
        raise invalid("model's compositing", expected="over, as viewers blend", got=model.compositing, cure=cure)


def checked_times(model: RenderableVideo, times: Sequence[float] | None) -> Float[np.ndarray, " frames"]:
    """The times asked for, or those of the model's frames. Raises ValueError unless they are one or more in [0, 1]."""
    found = np.atleast_1d(np.asarray(model.frame_times.times() if times is None else times))
    found = found.astype(np.float64) if found.dtype.kind in "fiu" else np.zeros(0)
    if found.ndim != 1 or found.size == 0 or not ((found >= 0) & (found <= 1)).all():
        raise invalid("times", expected="one or more numbers in [0, 1]", got=short_repr(times))
    return found


def read_3dgs_ply(path: str | os.PathLike, *, axes: str = "y-down") -> Gaussians3D:
    """The Gaussians of a 3DGS PLY file, in model space if the file has the `axes` given; NumPy leaves.

    **Shapes:** see `Gaussians3D`; factor = R diag(scales), columns in the file's order. Colour is that of degree 0,
    what is seen from all sides on average: `f_rest` is left out, and so is any other column.

    **Raises:** `FileNotFoundError`; `FormatError` for a file that is damaged, of another kind, or has a quaternion of
    length 0; ValueError for unknown axes.

    **Example:** `project(read_3dgs_ply("frame.ply"), Camera.front(0.5), (160, 320))`

    **Source:** as `write_gaussians_ply`.
    """
    check_one_of("axes", axes, AXES)
    ply = read_ply(path, ("vertex",))
    if not is_3dgs(ply):
        got = "properties " + ", ".join(ply.names("vertex")[:20]) if ply.names("vertex") else "no element 'vertex'"
        cure = "For a video use read_vegas_ply." if is_vegas(ply) else "It may be a mesh or a point cloud."
        expected = "a 3DGS scene, with f_dc_0, opacity, scale_2 and rot_3"
        raise format_error(ply.path, expected=expected, got=got, cure=cure)
    spatial = ply.columns("vertex", ["x", "y", "z", "scale_0", "scale_1", "scale_2"])
    turn = ply.columns("vertex", [f"rot_{k}" for k in range(4)])
    opacity, *color = ply.columns("vertex", ["opacity", "f_dc_0", "f_dc_1", "f_dc_2"]).T
    lengths = np.linalg.norm(turn, axis=1)
    if (lengths < _SMALLEST).any():
        got = f"0 in vertex {np.argmax(lengths < _SMALLEST)}"
        raise format_error(ply.path, expected="quaternions of some length", got=got, cure="Drop that row.")
    rotation = (
        scipy.spatial.transform.Rotation.from_quat(turn[:, [1, 2, 3, 0]]).as_matrix()
        if len(turn)
        else np.empty((0, 3, 3))
    )
    with np.errstate(over="ignore", invalid="ignore"):
        factor = _float32(ply, "scale", rotation * np.exp(spatial[:, None, 3:]))
    rgb = np.maximum(0.5 + SH_C0 * np.stack(color, axis=1), 0)
    leaves = (spatial[:, :3], factor, expit(opacity), rgb)
    return _turned(Gaussians3D(*(np.asarray(leaf, np.float32) for leaf in leaves)), axes)


def is_3dgs(ply: Ply) -> bool:
    """Whether a PLY file is a scene of 3DGS, by the columns that tell it from meshes and from VeGaS."""
    return {"f_dc_0", "opacity", "scale_2", "rot_3"} <= set(ply.names("vertex"))


def _turned(gaussians: Gaussians3D, axes: str) -> Gaussians3D:
    """From model space to `axes` or back: half a turn about x, or none."""
    if axes == "y-down":
        return gaussians
    turn = np.array([1.0, -1.0, -1.0], np.float32)
    mean, factor = np.asarray(gaussians.mean) * turn, np.asarray(gaussians.factor) * turn[:, None]
    return Gaussians3D(mean, factor, gaussians.opacity, gaussians.color)


def _scales_and_quaternion(
    factor: Float[np.ndarray, "num 3 3"],
) -> tuple[Float[np.ndarray, "num 3"], Float[np.ndarray, "num 4"]]:
    """Standard deviations along a Gaussian's axes, and the rotation to these axes as (w, x, y, z)."""
    axes, scale, _ = np.linalg.svd(factor)
    axes[..., 2] *= np.sign(np.linalg.det(axes))[:, None]  # a rotation, no reflection: an axis has no direction
    if len(axes) == 0:
        return scale, np.empty((0, 4))
    return scale, np.roll(scipy.spatial.transform.Rotation.from_matrix(axes).as_quat(), 1, axis=1)
