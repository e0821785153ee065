"""3DGS PLY files: static scenes of Gaussians, which ordinary viewers open."""

import dataclasses
import json
from collections.abc import Callable, Sequence
from pathlib import Path

import jax
import numpy as np
import scipy
from jaxtyping import Float
from scipy.special import expit, logit

from foldgauss._runtime.checks import check_one_of, check_within, is_within, require, short_repr
from foldgauss.io._atomic import PathLike, atomic_folder
from foldgauss.io.exchange.ply_file import NOTE, read_ply, write_ply
from foldgauss.render import Camera, Gaussians3D, pixels_per_unit
from foldgauss.render.camera import THICKNESS
from foldgauss.video.models.renderer import RenderedVideo, VideoRenderer
from foldgauss.video.models.splats import SH_C0

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


def frame_gaussians(model: RenderedVideo | VideoRenderer, t: float, *, depth_step: float = DEPTH_STEP) -> Gaussians3D:
    """The Gaussians that a model renders at time t, flat in space, front first, for programs that sort by depth.

    For many times, pass a `VideoRenderer` instead of the model, so that it is made once. Where two segments of a video
    cross-fade, the Gaussians are those of the segment with the larger weight.

    **Shapes:** leaves of `Gaussians3D` of the Gaussians alive at t, NumPy. **Units:** model space (see
    `foldgauss.render.camera`); `depth_step` in its units too.

    Gaussians of a frame occlude each other in array order. Here each is placed `depth_step` behind the one before, and
    enlarged in proportion to its distance from the front camera, so that this camera sees the image of the model and
    programs that sort by depth blend in its order. 0 puts all of them into one plane.

    **Raises:** ValueError for a step or a time outside [0, 1].

    **Example:** `project(frame_gaussians(model, 0.5), Camera.front(aspect), model.size)`

    **Source:** VeGaS eq:mirage (flat Gaussians), eq:vegas_equiv_cond (of one time).
    """
    check_within("depth_step", depth_step, "[0, 1]", "a depth in [0, 1] of the frame's longer side")
    require(
        is_within(float(t), "[0, 1]"),
        "t",
        expected="a time in [0, 1]",
        got=repr(t),
    )
    renderer = model if isinstance(model, VideoRenderer) else VideoRenderer(model)
    splats = renderer.splats(float(t))
    seen = np.asarray(splats.opacity) > 0
    leaves = (splats.mean, splats.factor, splats.opacity, splats.color)
    mean, factor, opacity, color = (np.asarray(leaf, np.float64)[seen] for leaf in leaves)
    (height, width), unit = renderer.size, pixels_per_unit(renderer.size)
    mean, factor = (mean - [width / 2, height / 2]) / unit, factor / unit
    distance = -float(Camera.front(height / width).position[2])
    depth = depth_step * np.arange(len(mean))
    grown = (1 + depth / distance)[:, None]
    flat = np.zeros((len(mean), 3, 3))
    flat[:, :2, :2], flat[:, 2, 2] = factor * grown[..., None], THICKNESS
    mean = np.concatenate([mean * grown, depth[:, None]], axis=1)
    return Gaussians3D(*(leaf.astype(np.float32) for leaf in (mean, flat, opacity, color)))


def write_gaussians_ply(path: PathLike, gaussians: Gaussians3D, *, axes: str = "y-down", sh_degree: int = 3) -> Path:
    """Write Gaussians in space as a 3DGS PLY file, which ordinary viewers open; returns the path.

    The layout is that of the published 3DGS: x y z nx ny nz f_dc_0..2 f_rest_0..44 opacity scale_0..2 rot_0..3, all
    float32, little-endian, the quaternion as w x y z. Colors do not depend on the view, so f_rest is 0. Some viewers
    (SIBR, 3DGS.cpp) read nothing without it; all others take files of `sh_degree=0` too, a quarter as large.

    **Units:** model units; `axes` is "y-down" as in trained scenes (COLMAP: x right, y down, z away), which viewers of
    such scenes show upright, or "y-up" (x right, y up, z towards the viewer) for programs that take a file as it is.

    **Raises:** ValueError for other axes or degrees, for numbers that are not finite and for colors that are not RGB;
    `OutputError` where the path cannot be written.

    **Example:** `write_gaussians_ply("scene.ply", frame_gaussians(model, 0.5), axes="y-up")`

    **Source:** Kerbl et al. 2023, 3D Gaussian Splatting, and the file layout of its published code.
    """
    return write_ply(path, {"vertex": _columns(gaussians, axes, sh_degree)})


def _columns(gaussians: Gaussians3D, axes: str, sh_degree: int) -> dict[str, np.ndarray]:
    check_one_of("axes", axes, AXES)
    require(
        sh_degree in _NUM_REST,
        "sh_degree",
        expected="0, 1, 2 or 3",
        got=repr(sh_degree),
    )
    mean, factor, opacity, color = (np.asarray(leaf, np.float64) for leaf in jax.tree.leaves(_turn(gaussians, axes)))
    require(
        color.shape[-1:] == (3,),
        "gaussians.color",
        expected="red, green and blue",
        got=f"{color.shape[-1:]} channels",
    )
    require(
        all(np.isfinite(leaf).all() for leaf in (mean, factor, opacity, color)),
        "gaussians",
        expected="finite numbers",
        got="NaN or infinities",
        cure="Drop those Gaussians.",
    )
    scale, quaternion = _scales_and_quaternion(factor)
    zeros = np.zeros(len(mean))
    columns = {name: mean[:, c] for c, name in enumerate("xyz")} | dict.fromkeys(("nx", "ny", "nz"), zeros)
    columns |= {f"f_dc_{c}": (color[:, c] - 0.5) / SH_C0 for c in range(3)}
    columns |= {f"f_rest_{k}": zeros for k in range(_NUM_REST[sh_degree])}
    with np.errstate(divide="ignore"):
        columns["opacity"] = np.clip(logit(opacity), -_LOGIT_MAX, _LOGIT_MAX)
    columns |= {f"scale_{k}": np.log(np.maximum(scale[:, k], _SMALLEST)) for k in range(3)}
    return columns | {f"rot_{k}": quaternion[:, k] for k in range(4)}


def write_3dgs_ply(
    path: PathLike,
    model: RenderedVideo | VideoRenderer,
    t: float,
    *,
    depth_step: float = DEPTH_STEP,
    axes: str = "y-down",
    sh_degree: int = 3,
) -> Path:
    """Write the frame at time t as a 3DGS PLY file; returns the path.

    See `frame_gaussians` for the geometry and `write_gaussians_ply` for the layout. A comment, the header's last line,
    has what the player needs to show the frame as it was.

    **Raises:** as these two, and ValueError for a model with compositing "sum", whose Gaussians do not occlude: viewers
    cannot render it.

    **Example:** `write_3dgs_ply("frame.ply", model, 0.5)`
    """
    video = model.model if isinstance(model, VideoRenderer) else model
    require(
        video.compositing == "over",
        "model's compositing",
        expected="over, as viewers blend",
        got=video.compositing,
        cure="Fit it with --compositing over.",
    )
    columns = _columns(frame_gaussians(model, t, depth_step=depth_step), axes, sh_degree)
    note = {"size": list(video.size), "axes": axes, "options": dataclasses.asdict(video.options)}
    return write_ply(path, {"vertex": columns}, comments=[NOTE + json.dumps(note)])


def write_3dgs_frames(
    folder: PathLike,
    model: RenderedVideo,
    times: Sequence[float] | None = None,
    *,
    depth_step: float = DEPTH_STEP,
    axes: str = "y-down",
    sh_degree: int = 3,
    overwrite: bool = False,
    on_frame: Callable[[], object] = lambda: None,
) -> Path:
    """Write frames of a video as 3DGS PLY files frame_0000.ply, frame_0001.ply, ...; returns the folder.

    `times` (default: the model's frame times), in [0, 1]. The folder appears whole or not at all; one that holds files
    is refused unless `overwrite`, and even then if it holds anything else. `on_frame` is called after each.

    **Raises:** as `write_3dgs_ply`; `OutputError` where the folder is refused.

    **Example:** `write_3dgs_frames("frames", model)`
    """
    folder, times = Path(folder), check_times(model, times)
    options = {"depth_step": depth_step, "axes": axes, "sh_degree": sh_degree}
    with atomic_folder(folder, overwrite, pattern=r"frame_[0-9]{4,}\.ply") as temporary:
        renderer = VideoRenderer(model)
        for number, t in enumerate(times):
            write_3dgs_ply(temporary / f"frame_{number:04d}.ply", renderer, t, **options)
            on_frame()
    return folder


def check_times(model: RenderedVideo, times: Sequence[float] | None) -> Float[np.ndarray, " frames"]:
    """The given times, or the model's frame times. Raises ValueError unless there is at least one, all in [0, 1]."""
    found = np.atleast_1d(np.asarray(model.frame_times.times() if times is None else times))
    found = found.astype(np.float64) if found.dtype.kind in "fiu" else np.zeros(0)
    require(
        found.ndim == 1 and found.size != 0 and ((found >= 0) & (found <= 1)).all(),
        "times",
        expected="one or more numbers in [0, 1]",
        got=short_repr(times),
    )
    return found


def read_3dgs_ply(path: PathLike, *, axes: str = "y-down") -> Gaussians3D:
    """The Gaussians of a 3DGS PLY file, in model space if the file has the `axes` given; NumPy leaves.

    **Shapes:** see `Gaussians3D`; factor = R diag(scales), columns in the file's order. The color is that of degree 0,
    the mean over all directions: `f_rest` and any other columns are ignored.

    **Raises:** `FileNotFoundError`; `FormatError` for a file that is damaged, of another kind, or has a quaternion of
    length 0; ValueError for unknown axes.

    **Example:** `project(read_3dgs_ply("frame.ply"), Camera.front(0.5), (160, 320))`

    **Source:** as `write_gaussians_ply`.
    """
    check_one_of("axes", axes, AXES)
    ply = read_ply(path, ("vertex",))
    ply.require(
        ply.is_3dgs(),
        expected="a 3DGS scene, with f_dc_0, opacity, scale_2 and rot_3",
        got=ply.describe_vertices(),
        cure="For a video use read_vegas_ply." if ply.is_vegas() else "It may be a mesh or a point cloud.",
    )
    spatial = ply.columns("vertex", ["x", "y", "z", "scale_0", "scale_1", "scale_2"])
    turn = ply.columns("vertex", [f"rot_{k}" for k in range(4)])
    opacity, *color = ply.columns("vertex", ["opacity", "f_dc_0", "f_dc_1", "f_dc_2"]).T
    short = np.flatnonzero(np.linalg.norm(turn, axis=1) < _SMALLEST)
    ply.require(
        not len(short),
        expected="quaternions of nonzero length",
        got="0 in vertex " + ", ".join(map(str, short[:9])),
        cure="Drop that row.",
    )
    rotation = np.empty((0, 3, 3))
    if len(turn):
        rotation = scipy.spatial.transform.Rotation.from_quat(turn[:, [1, 2, 3, 0]]).as_matrix()
    with np.errstate(over="ignore", invalid="ignore"):
        factor = ply.to_float32("scale", rotation * np.exp(spatial[:, None, 3:]))
    rgb = np.maximum(0.5 + SH_C0 * np.stack(color, axis=1), 0)
    leaves = (spatial[:, :3], factor, expit(opacity), rgb)
    return _turn(Gaussians3D(*(np.asarray(leaf, np.float32) for leaf in leaves)), axes)


def _turn(gaussians: Gaussians3D, axes: str) -> Gaussians3D:
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
