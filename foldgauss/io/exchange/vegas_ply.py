"""The PLY file of the published VeGaS code: a video of folded Gaussians."""

import dataclasses
import json
import math
import warnings
from pathlib import Path

import jax
import numpy as np
from jaxtyping import Float

from foldgauss._runtime.checks import check_within, invalid, require
from foldgauss.envelope import TimeLikelihood
from foldgauss.io._atomic import PathLike, atomic_folder
from foldgauss.io.exchange.ply_file import NOTE, Ply, facts_error, parse_notes, read_ply, write_ply
from foldgauss.io.media.clip import Size, check_fps
from foldgauss.io.media.frame_rate import DEFAULT_FPS
from foldgauss.render import RenderOptions
from foldgauss.render.camera import FIELD_OF_VIEW
from foldgauss.render.splats import check_size
from foldgauss.video.fitting.config import PUBLISHED_SCALE_CUTOFF
from foldgauss.video.models.frame_times import FrameTimes
from foldgauss.video.models.polynomial_folds import without_paths
from foldgauss.video.models.splats import FoldedSplats
from foldgauss.video.models.video_model import VideoModel
from foldgauss.video.segmented.segmented_video import SegmentedVideo

#: The envelope's power of the published code, which scales standard deviations by exp(-tau^2 / 2).
VEGAS_POWER = 2.0
#: `scale_1`, across the plane, has no effect on the image; this eps is written.
_VEGAS_ACROSS = math.log(1e-8)


def read_vegas_ply(path: PathLike, *, size: Size | None = None, fps: float | None = None) -> VideoModel:
    r"""A video from the PLY file of the published VeGaS code, rendered as its formulas define.

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
    is wrong; files that `write_vegas_ply` made carry both. Rendering follows the published constants: power 2, low
    pass 0.3 px^2, alpha up to 0.99 and from 1/255 on, exp(-tau^2 / 2) > 0.01, and standard deviations above 1e-4 of its
    units (`VideoModel.scale_cutoff`). Files written by foldgauss record the model's own values instead.

    **Raises:** `FileNotFoundError`, and `FormatError` for a file that is damaged, of another kind, with colors that
    depend on the view, or without a size.

    **Example:** `model = read_vegas_ply("point_cloud.ply", size=(480, 854), fps=24)`

    **Source:** VeGaS "Implementation Details", eq:vegas_equiv_cond and eq:frame_fitting; the layout is that of its
    published code.
    """
    ply = read_ply(path, ("vertex", "time"))
    _check_is_vegas(ply)
    size, fps, options, scale_cutoff, power = _fill_in(ply, size, fps)
    num_weights = sum(name.startswith("w1_") for name in ply.names("vertex"))
    ply.require(
        not num_weights % 2,
        "an even number of w1 columns, pairs (x, z)",
        str(num_weights),
        "The file is damaged.",
    )
    names = ["x", "z", "scale_0", "scale_2", "rot_0", "m_0", "sigma_0", "opacity", "f_dc_0", "f_dc_1", "f_dc_2"]
    columns = ply.columns("vertex", [*names, *(f"w1_{k}" for k in range(num_weights))])
    unit = _vegas_unit(size)
    plane = unit * np.array([1.0, -1.0])
    angle, time_loc, log_time_scale, opacity = columns[:, 4:8].T
    leaves = {
        "loc": plane * columns[:, 0:2],
        "log_scale": columns[:, 2:4] + math.log(unit),
        "angle_logit": angle,
        "time_loc_logit": time_loc,
        "log_time_scale": _convert_time_scale(log_time_scale, VEGAS_POWER, power),
        "coefficients": plane * columns[:, 11:].reshape(len(columns), num_weights // 2, 2),
        "opacity_logit": opacity,
        "color_dc": columns[:, 8:11],
    }
    leaves = {name: ply.to_float32(name, leaf) for name, leaf in leaves.items()}
    splats = FoldedSplats(**leaves, envelope=TimeLikelihood(np.float32(power), np.float32(0)))
    return VideoModel(splats, FrameTimes(_time_logits(ply)), size, fps, options, scale_cutoff=scale_cutoff)


def write_vegas_ply(path: PathLike, model: VideoModel) -> Path:
    r"""Write a video in the format of the published VeGaS code; returns the path. See `read_vegas_ply` for the layout.

    The envelope has power 2 there. That of another power p > 0 is the same function of time with

    $$ \sigma_t' = \sigma_t \sqrt{2 / p}, \quad \exp(-p\,u^2 / (2 \sigma_t^2)) = \exp(-2 u^2 / (2 \sigma_t'^2)) $$

    Leaves are read back to float32 rounding. The Gaussians of a model with shared paths get polynomial folds, see
    `foldgauss.video.without_paths`, and a warning states the error. The published code renders with its own constants:
    a low pass of 0.3 px^2 (the presets' is 0.1), Gaussians up to 3.03 sigma_t' from m_t, and none whose scale, after
    the envelope, is below 1e-4 of its units (a fifth of a pixel at 1280 wide).

    **Raises:** ValueError for a model that the published code cannot render: an envelope of power 0, a floor,
    compositing "sum", one frame alone; `OutputError` where the path cannot be written.

    **Example:** `write_vegas_ply("point_cloud.ply", load_video_model("holiday.safetensors"))`

    **Source:** the layout of the published VeGaS code.
    """
    _check_writable_as_vegas(model)
    if model.splats.paths is not None:
        on_path = np.asarray(model.splats.path_index) > 0
        model, error = without_paths(model)
        error = error[on_path]
        if len(error):
            followers = f"{len(error):,} Gaussians follow theirs by folds of degree {model.degree}"
            rms = f"a root mean square error of {np.sqrt(np.mean(error**2)):.2g} pixels, {error.max():.2g} at most"
            warnings.warn(f"model: the file has no shared paths: {followers}, with {rms}.", stacklevel=2)
    splats, unit = model.splats, _vegas_unit(model.size)
    plane = np.array([1.0, -1.0]) / unit
    loc = plane * np.asarray(splats.loc, np.float64)
    scale = np.asarray(splats.log_scale, np.float64) - math.log(unit)
    zeros = np.zeros(len(loc))
    columns = {"x": loc[:, 0], "y": zeros, "z": loc[:, 1], "nx": zeros, "ny": zeros, "nz": zeros}
    columns |= {f"f_dc_{c}": np.asarray(splats.color_dc, np.float64)[:, c] for c in range(3)}
    columns |= {"opacity": splats.opacity_logit, "scale_0": scale[:, 0]}
    columns |= {"scale_1": np.full(len(loc), _VEGAS_ACROSS), "scale_2": scale[:, 1]}
    power = float(splats.envelope.power)
    spread = _convert_time_scale(np.asarray(splats.log_time_scale, np.float64), power, VEGAS_POWER)
    columns |= {"rot_0": splats.angle_logit, "m_0": splats.time_loc_logit, "sigma_0": spread}
    weights = (plane * np.asarray(splats.coefficients, np.float64)).reshape(len(loc), -1)
    columns |= {f"w1_{k}": weights[:, k] for k in range(weights.shape[1])}
    times = {f"time_func_{k}": [weight] for k, weight in enumerate(np.asarray(model.frame_times.logits))}
    note = {"size": list(model.size), "fps": model.fps, "options": dataclasses.asdict(model.options)}
    note |= {"scale_cutoff": model.scale_cutoff, "power": power}
    return write_ply(path, {"vertex": columns, "time": times}, comments=[NOTE + json.dumps(note)])


def write_vegas_segments(folder: PathLike, video: SegmentedVideo, *, overwrite: bool = False) -> Path:
    """Write each segment of a video as segment-000.ply and so on, see `write_vegas_ply`; returns the folder.

    The folder appears whole or not at all. One that holds files is refused unless `overwrite`, and even then if it
    holds anything but segments. Raises as `write_vegas_ply`; `OutputError` where the folder is refused.
    """
    folder = Path(folder)
    require(isinstance(video, SegmentedVideo), "video", expected="a SegmentedVideo", got=type(video).__name__)
    with atomic_folder(folder, overwrite, pattern=r"segment-[0-9]{3,}\.ply", what="segments") as temporary:
        for number, segment in enumerate(video.segments):
            write_vegas_ply(temporary / f"segment-{number:03d}.ply", segment.model)
    return folder


def _convert_time_scale(
    log_time_scale: Float[np.ndarray, " num"], power: float, other: float
) -> Float[np.ndarray, " num"]:
    """log sigma_t that gives an envelope of power `other` the same values."""
    return log_time_scale + 0.5 * np.log(other / power)


def _vegas_unit(size: Size) -> float:
    """One unit of the published space in model units."""
    height, width = size
    return min(1.0, width / height) / (2 * math.tan(FIELD_OF_VIEW / 2))


def _check_is_vegas(ply: Ply) -> None:
    ply.require(
        ply.is_vegas(),
        expected="a VeGaS video, with m_0, sigma_0 and rot_0",
        got=ply.describe_vertices(),
        cure="For a still scene use read_3dgs_ply." if ply.is_3dgs() else "Check that it is the right file.",
    )
    ply.require(
        "time" in ply.elements,
        expected="an element 'time' with the frames' weights",
        got="none",
        cure="It may be of another version of the published code.",
    )
    ply.require(
        len(ply.elements["vertex"]) != 0,
        expected="Gaussians",
        got="none",
    )
    rest = [name for name in ply.names("vertex") if name.startswith("f_rest_")]
    ply.require(
        not rest or not np.any(ply.columns("vertex", rest)),
        expected="colors of degree 0, as VeGaS has them",
        got="f_rest columns that are not 0",
    )


def _time_logits(ply: Ply) -> Float[np.ndarray, " intervals"]:
    """The weights of the frame times: columns of one row, or rows of one column."""
    names = sorted(ply.names("time"), key=lambda name: (len(name), name))
    weights = ply.columns("time", names)
    ply.require(
        1 in weights.shape and weights.size != 0,
        "one row of weights in element 'time'",
        f"{weights.shape[0]} rows of {weights.shape[1]}",
    )
    ply.require(
        weights.shape[0] != 1 or names == [f"time_func_{k}" for k in range(len(names))],
        "time_func_0, time_func_1, ... in element 'time'",
        ", ".join(names[:9]),
    )
    return weights.astype(np.float32).ravel()


def _fill_in(ply: Ply, size: Size | None, fps: float | None) -> tuple[Size, float, RenderOptions, float, float]:
    """Size, rate, options, cutoff and power: as given, else as recorded in the file, else the published defaults."""
    texts = [comment[len(NOTE) :] for comment in ply.comments if comment.startswith(NOTE)]
    note = parse_notes(ply.path, texts[0]) if texts else {}
    ply.require(
        size is not None or "size" in note,
        expected="a size, which a VeGaS file does not hold",
        got="none",
        cure="Give the size of the video that it was made from, such as size=(480, 854).",
    )
    try:
        options = RenderOptions(**note.get("options", {}))
        size = note["size"] if size is None else size
        fps = note.get("fps", DEFAULT_FPS) if fps is None else fps
        check_size(size)
        cutoff = note.get("scale_cutoff", PUBLISHED_SCALE_CUTOFF * _vegas_unit(size))
        check_within("scale_cutoff", cutoff, "[0, 1]", "a number in [0, 1]")
        power = note.get("power", VEGAS_POWER)
        check_within("power", power, "(0, 1e30]", "a number in (0, 1e30]")
        check_fps(fps)
    except (TypeError, ValueError) as error:
        raise facts_error(ply.path, error) from error
    return (int(size[0]), int(size[1])), float(fps), options, float(cutoff), float(power)


def _check_writable_as_vegas(model: VideoModel) -> None:
    if not isinstance(model, VideoModel):
        cure = "Export the frames of an edited video as ply3dgs or obj."
        if isinstance(model, SegmentedVideo):
            cure = "write_vegas_segments(FOLDER, model) writes one for each segment."
        raise invalid("model", expected="a VideoModel", got=type(model).__name__, cure=cure)
    require(
        model.num_frames >= 2,
        "model",
        expected="at least 2 frames, as a VeGaS file stores the intervals between frames",
        got="1",
        cure="Write the picture as a still scene, ply3dgs.",
    )
    require(
        model.splats.envelope.floor == 0,
        "model's floor",
        expected="0.0, the only one in a VeGaS file",
        got=float(model.splats.envelope.floor),
        cure="Fit it without a floor.",
    )
    require(
        model.compositing == "over",
        "model's compositing",
        expected="over, the only one in a VeGaS file",
        got=model.compositing,
        cure="Fit it with --compositing over.",
    )
    require(
        all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(model)),
        "model",
        expected="finite numbers",
        got="NaN or infinities",
        cure="The fit diverged: fit again.",
    )
    require(
        model.splats.envelope.power > 0,
        "model's power",
        expected="above 0, as VeGaS files require",
        got="0",
        cure="Fit it with another --power.",
    )
