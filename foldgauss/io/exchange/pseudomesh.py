"""GaMeS pseudomeshes: frames as triangles for mesh tools, in one `.obj` and one `.ply` file per frame.

The `.obj` contains the shape, one triangle per Gaussian; the `.ply`, an ordinary 3DGS file, opacity and color.
"""

import dataclasses
import json
import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import jax
import numpy as np
from jaxtyping import Float, UInt8

from foldgauss._runtime.checks import check_one_of, check_within, require
from foldgauss.io._atomic import PathLike, atomic_folder, missing_error
from foldgauss.io.exchange.gaussians_ply import check_times, frame_gaussians, read_3dgs_ply, write_gaussians_ply
from foldgauss.io.exchange.ply_file import FormatError, facts_error, format_error, parse_notes, read_bytes
from foldgauss.io.media.clip import Size
from foldgauss.io.media.frame_rate import DEFAULT_FPS
from foldgauss.io.media.images import natural_sort_key
from foldgauss.render import COMPOSITINGS, Camera, Gaussians3D, RenderOptions, Splats2D, Triangles, cpu, project
from foldgauss.render.splats import check_size
from foldgauss.render.triangle import COLLINEAR
from foldgauss.video.models.background import BLACK, check_background
from foldgauss.video.models.renderer import RenderedVideo, VideoRenderer, to_bytes

#: Frame times, size and rate of the video, and render options, which an `.obj` cannot hold.
NOTES = "pseudomesh.json"
_FILES = r"frame_[0-9]{4,}\.(obj|ply)|pseudomesh\.json"
#: Model space (x right, y down, z away) to the axes of mesh tools (x right, y up, z towards the viewer), and back.
_AXES_TURN = np.array([1.0, -1.0, -1.0])
#: How to cure a soup of triangles whose vertices a tool changed.
_KEEP_ORDER = "Export with the vertices' order kept, and merge none by distance."
#: No sine of the angle between two edges is smaller than that in a face that float32 tells from a line.
_COLLINEAR = COLLINEAR * float(np.finfo(np.float32).eps)
_LARGEST = 1e38  # of a coordinate: float32 holds the difference of two such
_AXES_SLANT = 1e-6  # cosine up to which two columns of a factor are its axes: rounding of float32


@dataclass(frozen=True, eq=False)
class Pseudomesh:
    """Frames as triangles with opacity and color: what a folder of `.obj` and `.ply` files holds.

    **Shapes:** `triangles` one `Triangles` (NumPy leaves, front first) for each frame, of its own number of faces;
    `times` (num_frames,), those of the frames in [0, 1]. **Units:** model space.

    `size` is (height, width), `fps` the rate; `options` and `compositing` are the render options.
    """

    triangles: tuple[Triangles, ...]
    times: Float[np.ndarray, "num_frames"]
    size: Size
    fps: float
    options: RenderOptions
    compositing: str = "over"

    @property
    def num_frames(self) -> int:
        return len(self.triangles)

    def vertices(self, number: int) -> Float[np.ndarray, "num 3 3"]:
        """The vertices m, v1 and v2 of each face of a frame, in model space."""
        faces = self.triangles[number]
        return np.concatenate([faces.origin[:, None], faces.origin[:, None] + faces.edges], axis=1)

    def splats(self, number: int, size: Size | None = None) -> Splats2D:
        """The conditioned Gaussians of a frame, in pixels of an image of `size` (default: the video's own).

        They are those that the front camera sees, in array order. Source: VeGaS eq:gaussrecons1, eq:gaussrecons2.
        """
        size = self.size if size is None else size
        check_size(size)
        camera = Camera.front(self.size[0] / self.size[1])
        return jax.tree.map(np.asarray, project(self.triangles[number].to_gaussians(), camera, size, order="array"))

    def frames(
        self, size: Size | None = None, *, background: tuple[float, float, float] = BLACK
    ) -> Iterator[UInt8[np.ndarray, "height width 3"]]:
        """The images of all frames one by one. Raises ValueError for an invalid size or background."""
        size = self.size if size is None else tuple(size)
        behind = check_background(background, self.compositing)
        for number in range(self.num_frames):
            splats = self.splats(number, size)
            leaves = (splats.mean, splats.factor, splats.opacity, splats.color)
            drawn = cpu.forward(*leaves, behind, size, compositing=self.compositing, options=self.options)
            yield to_bytes(drawn.image)


# ---------------------------------------------------------------------------------------------- writing


def write_pseudomesh(
    folder: PathLike,
    model: RenderedVideo,
    times: Sequence[float] | None = None,
    *,
    overwrite: bool = False,
    on_frame: Callable[[], object] = lambda: None,
) -> Path:
    """Write frames as triangles: frame_0000.obj, frame_0000.ply and so on, and pseudomesh.json; returns the folder.

    Face k of an `.obj` is Gaussian k of the frame, front first, with three vertices of its own: m, m + s1 r1 and
    m + s2 r2, the covariance's axes to one standard deviation; x is right, y up, z towards the viewer, the frame's
    center the origin and its longer side 1. The `.ply` beside it is the frame as a 3DGS file, y down. After editing,
    with vertices kept in number and order, `read_pseudomesh` takes the shape from the `.obj`, the rest from the `.ply`.

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
        notes = {
            "times": [float(t) for t in times],
            "size": list(model.size),
            "fps": model.fps,
            "options": dataclasses.asdict(model.options),
            "compositing": model.compositing,
        }
        (temporary / NOTES).write_text(json.dumps(notes, indent=1) + "\n", encoding="ascii")
    return folder


def _obj_text(gaussians: Gaussians3D, t: float) -> str:
    mean = gaussians.mean.astype(np.float64)
    edges = np.pad(_axes(gaussians.factor[:, :2, :2].astype(np.float64)), [(0, 0), (0, 0), (0, 1)])
    vertices = np.concatenate([mean[:, None], mean[:, None] + edges], axis=1) * _AXES_TURN
    colors = np.repeat(np.clip(gaussians.color, 0, 1), 3, axis=0)
    rows = np.concatenate([vertices.reshape(-1, 3), colors], axis=1) + 0.0  # no -0
    lines = ["# foldgauss pseudomesh: a face for each Gaussian, front first; keep the order of vertices and faces"]
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


# ---------------------------------------------------------------------------------------------- reading


def read_pseudomesh(folder: PathLike, *, size: Size | None = None, fps: float | None = None) -> Pseudomesh:
    """Read frames as triangles, after editing in a mesh tool or straight from `write_pseudomesh`.

    Every `NAME.obj` of the folder, in natural order, with `NAME.ply` beside it: shape from the one, opacity and color
    from the other, face k being Gaussian k. `size` = (height, width), `fps` and the times come from pseudomesh.json;
    without that file `size` must be given, the rate is 25 and the frames are evenly spaced. The `.obj` has the
    same axes as `write_pseudomesh` writes.

    **Raises:** `FileNotFoundError`; `FormatError`, with the file and where it can the line, for a file that is damaged
    or incomplete, faces that are no triangles or have no area, and vertices that a tool merged, split or reordered.

    **Example:** `write_video("edited.mp4", read_pseudomesh("mesh").frames(), fps=25)`

    **Source:** VeGaS eq:gaussrecons1, eq:gaussrecons2; GaMeS.
    """
    folder = Path(folder)
    if not os.path.exists(folder):
        raise missing_error(folder, "a folder")
    paths = sorted(folder.glob("*.obj"), key=lambda path: natural_sort_key(path.name)) if folder.is_dir() else []
    require(
        paths,
        str(folder),
        expected="a folder with .obj files",
        got="none",
        cure="Give the folder that write_pseudomesh or `foldgauss export --format obj` made.",
        kind=FormatError,
    )
    given = {name: value for name, value in (("size", size), ("fps", fps)) if value is not None}
    facts = _read_facts(folder, len(paths), given)
    return Pseudomesh(tuple(_read_frame(path) for path in paths), **facts)


def _read_facts(folder: Path, num_frames: int, given: dict) -> dict:
    """Size, rate, times and options: as given, else as in pseudomesh.json, else defaults."""
    evenly, path = np.linspace(0, 1, num_frames).tolist(), folder / NOTES
    defaults = {"times": evenly, "size": None, "fps": DEFAULT_FPS, "options": {}, "compositing": "over"}
    found = parse_notes(path, read_bytes(path).decode(errors="replace")) if path.exists() else {}
    notes = defaults | {name: value for name, value in found.items() if name in defaults} | given
    require(
        notes["size"] is not None,
        str(folder),
        expected=f"a size in {NOTES}",
        got="none",
        cure="Give the size of the video, such as size=(480, 854).",
        kind=FormatError,
    )
    try:
        times, size, fps = np.asarray(notes["times"], np.float64), tuple(notes["size"]), float(notes["fps"])
        options = RenderOptions(**notes["options"])
        check_one_of("compositing", notes["compositing"], COMPOSITINGS)
        check_size(size)
        check_within("fps", fps, "(0, inf)", "a positive rate")
        require(
            times.shape == (num_frames,) and ((times >= 0) & (times <= 1)).all(),
            "times",
            expected=f"{num_frames} numbers in [0, 1], one for each .obj",
            got=f"shape {times.shape}",
            cure="A frame was added or removed: correct the list too, or remove the file and give size.",
        )
    except (TypeError, ValueError, OverflowError) as error:
        raise facts_error(folder / NOTES, error) from error
    return notes | {"times": times, "size": (int(size[0]), int(size[1])), "fps": fps, "options": options}


def _read_frame(path: Path) -> Triangles:
    beside = path.with_suffix(".ply")
    require(
        beside.exists(),
        str(path.parent),
        expected="a .ply with opacity and color beside every .obj",
        got=f"{path.name!r} without {beside.name!r}",
        kind=FormatError,
    )
    look, vertices = read_3dgs_ply(beside), read_obj(path)  # both are empty where no Gaussian was visible
    require(
        len(vertices) == len(look.opacity),
        str(path),
        expected=f"{len(look.opacity)} faces, a face for each Gaussian of {beside.name!r}",
        got=str(len(vertices)),
        cure="Faces were added or removed: keep them all, and hide Gaussians by opacity instead.",
        kind=FormatError,
    )
    vertices = vertices * _AXES_TURN
    edges = vertices[:, 1:] - vertices[:, :1]
    _check_area(path, edges)
    origin = vertices[:, 0].astype(np.float32) + np.float32(0)  # no -0
    return Triangles(origin, edges.astype(np.float32), look.opacity, look.color)


def _check_area(path: Path, edges: Float[np.ndarray, "num 2 3"]) -> None:
    first, second = edges[:, 0], edges[:, 1]
    with np.errstate(over="ignore", invalid="ignore"):
        area = np.linalg.norm(np.cross(first, second), axis=-1)
        valid = area > _COLLINEAR * np.linalg.norm(first, axis=-1) * np.linalg.norm(second, axis=-1)
    if not valid.all():
        raise format_error(
            path,
            expected="faces of nonzero area",
            got=f"none in face {np.argmin(valid) + 1}",
            cure="Move a vertex off the line through the other two.",
        )


def read_obj(path: PathLike) -> Float[np.ndarray, "faces 3 3"]:
    """The vertices of a triangle soup in an `.obj` file, (x, y, z) as they stand there, float64.

    Face k must have vertices 3k + 1, 3k + 2, 3k + 3 of the file, in this order: its first vertex is the Gaussian's
    center, and a tool that merges or reorders vertices destroys that. Everything but `v` and `f` lines is skipped, and
    so is what follows x, y and z in a `v` line (a color) or the vertex in an `f` line (`1/2/3`). Indices may be
    negative.

    **Raises:** `FileNotFoundError`; `FormatError` with the line.

    **Example:** `read_obj("mesh/frame_0000.obj").shape`

    **Source:** Wavefront, "Object Files (.obj)", appendix B1 of the Advanced Visualizer manual.
    """
    path = Path(path)
    vertices: list[tuple[float, ...]] = []
    num_faces = 0
    for number, line in enumerate(read_bytes(path).splitlines(), start=1):
        kind, *words = line.decode("utf-8", errors="replace").split("#", 1)[0].split() or [""]
        if kind == "v":
            vertices.append(_parse_vertex(path, number, words))
        elif kind == "f":
            num_faces += 1
            _check_face(f"{path}, line {number}", words, num_faces)
    require(
        len(vertices) == 3 * num_faces,
        str(path),
        expected="3 vertices of its own for each face",
        got=f"{len(vertices)} vertices for {num_faces} faces: a tool merged, split or dropped some",
        cure=_KEEP_ORDER,
        kind=FormatError,
    )
    return np.array(vertices).reshape(-1, 3, 3)


def _parse_vertex(path: Path, number: int, words: list[str]) -> tuple[float, ...]:
    try:
        place = tuple(float(word) for word in words[:3])
    except ValueError:
        place = ()
    require(
        len(place) == 3 and all(abs(x) <= _LARGEST for x in place),
        f"{path}, line {number}",
        expected="a vertex x y z",
        got=repr(" ".join(words)[:60]),
        cure="The file is damaged, or the tool wrote NaN.",
        kind=FormatError,
    )
    return place


def _check_face(where: str, words: list[str], number: int) -> None:
    """Raise unless face `number`, from 1 on, has three vertices of its own, in the order in which they were written."""
    require(
        len(words) == 3,
        where,
        expected="a face of 3 vertices",
        got=repr(" ".join(words)[:60]),
        cure="Only triangles represent Gaussians: disable the merging of triangles into polygons.",
        kind=FormatError,
    )
    own = [str(3 * number + k) for k in (-2, -1, 0)]
    require(
        [word.split("/", 1)[0] for word in words] == own,
        where,
        expected=f"face {number} of vertices {', '.join(own)}",
        got=f"{' '.join(words)[:60]}: a tool merged, split or reordered them",
        cure=_KEEP_ORDER,
        kind=FormatError,
    )
