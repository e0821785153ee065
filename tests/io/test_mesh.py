"""Frames as triangles: out, through a mesh tool, and back; and what a tool may have done to them."""

import dataclasses
import json
import math

import numpy as np
import pytest
from made_clips import one_line
from random_models import random_model

from foldgauss.io import FormatError, frame_gaussians, read_pseudomesh, write_pseudomesh
from foldgauss.io.exchange.pseudomesh import NOTES, _axes, read_obj
from foldgauss.render import RenderOptions
from foldgauss.video import FrameTimes
from foldgauss.video.models.renderer import VideoRenderer

NUM, FRAMES, SIZE = 40, 3, (48, 80)


def evenly(model):
    return dataclasses.replace(model, frame_times=FrameTimes.uniform(FRAMES))


@pytest.fixture(scope="module")
def model():
    return evenly(random_model(NUM, degree=2))


@pytest.fixture
def folder(tmp_path, model):
    return write_pseudomesh(tmp_path / "mesh", model)


def test_the_frames_come_back(folder, model):
    mesh = read_pseudomesh(folder)
    names = [f"frame_{k:04d}.{kind}" for k in range(FRAMES) for kind in ("obj", "ply")]
    assert sorted(path.name for path in folder.iterdir()) == [*names, NOTES]
    assert (mesh.num_frames, mesh.size, mesh.fps, mesh.options) == (FRAMES, SIZE, 29.97, model.options)
    np.testing.assert_allclose(mesh.times, [0, 0.5, 1], atol=1e-6)
    pictures = list(mesh.frames())
    for picture, expected in zip(pictures, model.frames(), strict=True):
        assert expected.std() > 10
        assert np.abs(picture.astype(int) - expected).max() <= 1  # a rounding of 8 bits
    _, white, _ = mesh.frames((30, 40), background=(1, 1, 1))
    expected = VideoRenderer(model, (30, 40), background=(1, 1, 1)).frame(0.5)
    assert np.abs(white.astype(int) - expected).max() <= 1


def test_faces_are_mean_and_axes(folder, model):
    """eq:traingle_face: V = [m, m + s1 r1, m + s2 r2], upright in the axes of mesh tools."""
    gaussians = frame_gaussians(model, 0.5, depth_step=0)
    faces = read_obj(folder / "frame_0001.obj")
    assert len(faces) == len(gaussians.mean) > 20
    assert not faces[..., 2].any()
    np.testing.assert_allclose(faces[:, 0, :2], gaussians.mean[:, :2] * [1, -1], atol=1e-7)
    edges = (faces[:, 1:] - faces[:, :1])[..., :2]
    np.testing.assert_allclose(np.sum(edges[:, 0] * edges[:, 1], axis=-1), 0, atol=1e-7)
    covariance = gaussians.factor[:, :2, :2] @ gaussians.factor[:, :2, :2].mT
    np.testing.assert_allclose(edges.mT @ edges, covariance * [[1, -1], [-1, 1]], rtol=1e-4, atol=1e-9)


def test_axes_of_any_factor():
    """An edited Gaussian's columns need not be at right angles; its triangle's edges are."""
    factor = np.random.default_rng(0).normal(size=(30, 2, 2))
    factor[:10] = np.linalg.svd(factor[:10])[0] * [0.3, 0.2]  # at right angles: they stay
    rows = _axes(factor)
    np.testing.assert_array_equal(rows[:10], factor[:10].mT)
    np.testing.assert_allclose(np.sum(rows[:, 0] * rows[:, 1], axis=-1), 0, atol=1e-12)
    np.testing.assert_allclose(rows.mT @ rows, factor @ factor.mT, rtol=1e-10, atol=1e-12)


def edited(path, change):
    """The file with its vertices changed, as a tool writes it: no colors, no comments, other index forms."""
    faces = change(read_obj(path))
    lines = ["mtllib none.mtl", "o soup", *("v " + " ".join(map(repr, row)) for row in faces.reshape(-1, 3).tolist())]
    lines += ["vn 0 0 1", "s off"]
    lines += [f"f {3 * k + 1}//1 {3 * k + 2}/{3 * k + 2}/1 {3 * k + 3}" for k in range(len(faces))]
    path.write_text("\r\n".join(lines) + "\r\n")


def test_moved_vertices_move_the_picture(folder, model):
    """A shift by whole pixels of all vertices shifts the picture; the frames beside it stay."""
    shift = 8 / 80  # model units to 8 pixels
    edited(folder / "frame_0001.obj", lambda faces: faces + np.array([shift, -shift, 0]))
    mesh = read_pseudomesh(folder)
    pictures = list(model.frames())
    still, moved, _ = mesh.frames()
    assert np.abs(moved[8:, 8:].astype(int) - pictures[1][:-8, :-8]).max() <= 2
    assert np.abs(still.astype(int) - pictures[0]).max() <= 1
    np.testing.assert_allclose(mesh.vertices(1)[..., 2], 0)


def test_scaled_and_mirrored_faces(folder, model):
    """Edges twice as long are standard deviations twice as large; a mirrored face is the same Gaussian."""
    before = read_pseudomesh(folder).splats(1)
    edited(folder / "frame_0001.obj", lambda faces: faces[:, :1] + 2 * (faces - faces[:, :1]))
    after = read_pseudomesh(folder).splats(1)
    np.testing.assert_allclose(after.factor, 2 * before.factor, rtol=1e-4, atol=1e-4)
    along = lambda faces: faces + np.array([0, 0, 0.5])[:, None] * (faces[:, 1:2] - faces[:, :1])  # noqa: E731
    edited(folder / "frame_0001.obj", along)  # v2 along the first edge: what is at right angles to it stays
    slanted = read_pseudomesh(folder).splats(1)
    np.testing.assert_allclose(slanted.factor, after.factor, rtol=1e-4, atol=1e-3)
    edited(folder / "frame_0001.obj", lambda faces: faces * np.array([-1, 1, 1]))
    mirrored = read_pseudomesh(folder).splats(1)
    np.testing.assert_allclose(mirrored.mean[:, 0], 80 - before.mean[:, 0], atol=1e-4)
    np.testing.assert_allclose(mirrored.opacity, before.opacity)


def test_depth_is_seen_by_the_front_camera(folder, model):
    """Moved towards the viewer by half the camera's distance all is twice as large, about the frame's center."""
    before = read_pseudomesh(folder).splats(1)
    distance = 0.5 / math.tan(0.6911112 / 2)
    edited(folder / "frame_0001.obj", lambda faces: faces + np.array([0, 0, distance / 2]))
    after = read_pseudomesh(folder).splats(1)
    center = np.array([40.0, 24.0], np.float32)
    np.testing.assert_allclose(after.mean - center, 2 * (before.mean - center), rtol=1e-4, atol=1e-3)
    covariance = lambda factor: np.asarray(factor) @ np.asarray(factor).mT  # noqa: E731
    np.testing.assert_allclose(covariance(after.factor), 4 * covariance(before.factor), rtol=1e-3, atol=1e-2)
    assert {picture.shape for picture in read_pseudomesh(folder).frames()} == {(*SIZE, 3)}


def test_sums_go_out_and_come_back(tmp_path):
    model = evenly(random_model(NUM, degree=2, compositing="sum"))
    mesh = read_pseudomesh(write_pseudomesh(tmp_path / "mesh", model, [0.5]))
    assert mesh.compositing == "sum"
    assert np.abs(next(mesh.frames()).astype(int) - VideoRenderer(model).frame(0.5)).max() <= 1


def test_a_folder_of_another_program(folder):
    (folder / NOTES).unlink()
    with one_line(FormatError, "size=(480, 854)"):
        read_pseudomesh(folder)
    mesh = read_pseudomesh(folder, size=(48, 80))
    assert (mesh.fps, mesh.options, mesh.times.tolist()) == (25.0, RenderOptions(), [0, 0.5, 1])
    for kind in ("obj", "ply"):
        for k in (0, 1, 2):
            (folder / f"frame_{k:04d}.{kind}").rename(folder / f"{9 + k}.{kind}")  # 9, 10, 11 in natural order
    again = read_pseudomesh(folder, size=(48, 80), fps=12)
    np.testing.assert_array_equal(again.vertices(2), mesh.vertices(2))
    assert again.fps == 12


# ----------------------------------------------------------------------------------------------- damage

SOUP = "v 0 0 0\nv 1 0 0\nv 0 1 0\n"
DAMAGED = {
    "no faces": (SOUP, "3 vertices"),
    "short": ("v 0 0\n", "line 1"),
    "words": ("v 0 north 0\n", "north"),
    "nan": ("v 0 nan 0\n", "line 1"),
    "infinite": ("v 0 0 0\nv 0 1e99 0\n", "line 2"),
    "a quad": (SOUP + "v 1 1 0\nf 1 2 3 4\n", "line 5"),
    "a line as a face": (SOUP + "f 1 2\n", "line 4"),
    "index 0": (SOUP + "f 0 1 2\n", "line 4"),
    "no index": (SOUP + "f a b c\n", "line 4"),
    "an index in parts": (SOUP + "f /1 /2 /3\n", "line 4"),
    "outside": (SOUP + "f 1 2 4\n", "line 4"),
    "below": (SOUP + "f -1 -2 -4\n", "line 4"),
    "digits": (SOUP + f"f 1 2 {'9' * 5000}\n", "line 4"),
    "merged": (SOUP + "v 1 1 0\nf 1 2 3\nf 2 3 4\n", "merged"),
    "reordered": (SOUP + "f 2 3 1\n", "reordered"),
    "swapped faces": (SOUP + SOUP + "f 4 5 6\nf 1 2 3\n", "line 7"),
}


@pytest.mark.parametrize("kind", DAMAGED)
def test_damaged_objects(tmp_path, kind):
    text, expected = DAMAGED[kind]
    path = tmp_path / "x.obj"
    path.write_text(text)
    with one_line(FormatError, expected, "x.obj"):
        read_obj(path)


def test_forms_of_an_object(tmp_path):
    text = "# soup\n\nv 0 0 0 1 0.5 0\nv 1 0 0 # end\nv 0 1 0 1.0\nvt 0 0\ng a\nf 1/1 2/1/1 3//1\nl 1 2\n"
    (tmp_path / "x.obj").write_text(text)
    np.testing.assert_array_equal(read_obj(tmp_path / "x.obj"), [[[0, 0, 0], [1, 0, 0], [0, 1, 0]]])


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (lambda faces: faces[:-1], "faces"),
        (lambda faces: np.concatenate([faces, faces[:1]]), "faces"),
        (lambda faces: np.where(np.arange(len(faces))[:, None, None] == 4, faces[:, :1], faces), "face 5"),
        (lambda faces: np.where(np.arange(3)[:, None] == 2, 2 * faces[:, 1:2] - faces[:, :1], faces), "face 1"),
    ],
)
def test_faces_that_are_lost_or_flat(folder, change, text):
    edited(folder / "frame_0002.obj", change)
    with one_line(FormatError, "frame_0002.obj", text):
        read_pseudomesh(folder)


@pytest.mark.parametrize(
    ("gone", "read", "error", "text"),
    [
        ([], "none", FileNotFoundError, "missing"),
        ([], "frame_0000.obj", FormatError, r"\.obj"),
        (["frame_0001.ply"], "", FormatError, r"frame_0001\.ply"),
        (["frame_0001.ply", "frame_0001.obj"], "", FormatError, "times"),
    ],
)
def test_incomplete_folders(folder, gone, read, error, text):
    for name in gone:
        (folder / name).unlink()
    with pytest.raises(error, match=text):
        read_pseudomesh(folder / read)
    with pytest.raises(FileNotFoundError, match="missing"):
        read_obj(folder / "none.obj")


@pytest.mark.parametrize(
    "notes", ["", "[]", '{"size": 4}', '{"size": [4.5, 4]}', '{"size": [4, 4], "fps": 0}', "[" * 100_000,
              '{"size": [4, 4], "times": [0]}', '{"size": [4, 4], "times": [0, 1, 2]}', '{"size": [4, 4], "fps": []}',
              '{"size": [4, 4], "compositing": "under"}', '{"size": [4, 4], "options": {"low_pass": "much"}}',
              '{"size": [4, 4], "options": []}', '{"size": [4, 4], "times": "now"}']
)  # fmt: skip
def test_notes_that_are_none(folder, notes):
    (folder / NOTES).write_text(notes)
    with one_line(FormatError, NOTES):
        read_pseudomesh(folder)


def test_unknown_notes_do_no_harm(folder):
    notes = json.loads((folder / NOTES).read_text()) | {"made by": "me"}
    (folder / NOTES).write_text(json.dumps(notes))
    assert read_pseudomesh(folder).num_frames == FRAMES


def test_a_time_with_nothing_to_see_comes_back(tmp_path):
    """A frame in which no Gaussian is alive is a frame without faces."""
    (tmp_path / "empty.obj").write_text("# nothing here\n")
    assert read_obj(tmp_path / "empty.obj").shape == (0, 3, 3)
