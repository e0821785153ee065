"""GaMeS pseudomeshes: frames as triangles for mesh tools, in one `.obj` and one `.ply` file per frame.

The `.obj` contains the shape, one triangle per Gaussian; the `.ply`, an ordinary 3DGS file, opacity and color.
"""

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from foldgauss.io._atomic import PathLike, atomic_folder
from foldgauss.io.exchange.gaussians_ply import check_times, frame_gaussians, write_gaussians_ply
from foldgauss.render import Gaussians3D
from foldgauss.video.models.renderer import RenderedVideo, VideoRenderer

_FILES = r"frame_[0-9]{4,}\.(obj|ply)"
#: Model space (x right, y down, z away) to the axes of mesh tools (x right, y up, z towards the viewer).
_AXES_TURN = np.array([1.0, -1.0, -1.0])
_AXES_SLANT = 1e-6  # cosine up to which two columns of a factor are its axes: rounding of float32


def write_pseudomesh(
    folder: PathLike,
    model: RenderedVideo,
    times: Sequence[float] | None = None,
    *,
    overwrite: bool = False,
    on_frame: Callable[[], object] = lambda: None,
) -> Path:
    """Write frames as triangles: frame_0000.obj, frame_0000.ply and so on; returns the folder.

    Face k of an `.obj` is Gaussian k of the frame, front first, with three vertices of its own: m, m + s1 r1 and
    m + s2 r2, the covariance's axes to one standard deviation; x is right, y up, z towards the viewer, the frame's
    center the origin and its longer side 1. The `.ply` beside it is the frame as a 3DGS file, y down.

    `times` (default: the model's frame times), in [0, 1]. The folder appears whole or not at all; one that holds files
    is refused unless `overwrite`, and even then if it holds anything else. `on_frame` is called after each frame.

    **Raises:** ValueError for times outside [0, 1]; `OutputError` where the folder is refused.

    **Example:** `write_pseudomesh("mesh", model, times=[0.5])`

    **Source:** VeGaS eq:traingle_face; Waczyńska et al. 2024, GaMeS (pseudomesh).
    """
    folder, times = Path(folder), check_times(model, times)
    with atomic_folder(folder, overwrite, pattern=_FILES, what="frames of a pseudomesh") as temporary:
        renderer = VideoRenderer(model)
        for number, t in enumerate(times):
            gaussians = frame_gaussians(renderer, t, depth_step=0.0)
            write_gaussians_ply(temporary / f"frame_{number:04d}.ply", gaussians, sh_degree=0)
            (temporary / f"frame_{number:04d}.obj").write_text(_obj_text(gaussians, t), encoding="ascii")
            on_frame()
    return folder


def _obj_text(gaussians: Gaussians3D, t: float) -> str:
    mean = gaussians.mean.astype(np.float64)
    edges = np.pad(_axes(gaussians.factor[:, :2, :2].astype(np.float64)), [(0, 0), (0, 0), (0, 1)])
    vertices = np.concatenate([mean[:, None], mean[:, None] + edges], axis=1) * _AXES_TURN
    colors = np.repeat(np.clip(gaussians.color, 0, 1), 3, axis=0)
    rows = np.concatenate([vertices.reshape(-1, 3), colors], axis=1) + 0.0  # no -0
    lines = ["# foldgauss pseudomesh: a face for each Gaussian, front first"]
    lines.append(f"# time {t:.9g}")
    lines.extend("v {:.10g} {:.10g} {:.10g} {:.4g} {:.4g} {:.4g}".format(*row) for row in rows.tolist())
    lines.extend(f"f {k + 1} {k + 2} {k + 3}" for k in range(0, len(rows), 3))
    return "\n".join(lines) + "\n"


def _axes(factor: Float[np.ndarray, "num 2 2"]) -> Float[np.ndarray, "num 2 2"]:
    """s1 r1 and s2 r2 as rows: the factor's own columns where they are at right angles, else its principal axes."""
    first, second = factor[..., 0], factor[..., 1]
    lengths = np.linalg.norm(first, axis=-1) * np.linalg.norm(second, axis=-1)
    slanted = np.abs(np.sum(first * second, axis=-1)) > _AXES_SLANT * lengths
    rows = np.stack([first, second], axis=-2)
    axes, scale, _ = np.linalg.svd(factor[slanted])
    rows[slanted] = (axes * scale[:, None]).mT
    return rows
