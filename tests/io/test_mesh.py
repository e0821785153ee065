"""Frames as triangles for mesh tools."""

import dataclasses

import numpy as np
import pytest
from random_models import random_model

from foldgauss.io import frame_gaussians, read_3dgs_ply, write_pseudomesh
from foldgauss.io.exchange.pseudomesh import _axes
from foldgauss.video import FrameTimes

NUM, FRAMES = 40, 3


@pytest.mark.parametrize("compositing", ["over", "sum"])
def test_faces_are_mean_and_axes(tmp_path, compositing):
    """eq:traingle_face: V = [m, m + s1 r1, m + s2 r2], upright in the axes of mesh tools, beside the frame's splats."""
    model = random_model(NUM, degree=2, compositing=compositing)
    model = dataclasses.replace(model, frame_times=FrameTimes.uniform(FRAMES))
    folder = write_pseudomesh(tmp_path / "mesh", model)
    names = [f"frame_{k:04d}.{kind}" for k in range(FRAMES) for kind in ("obj", "ply")]
    assert sorted(path.name for path in folder.iterdir()) == names
    for k, t in enumerate((0.0, 0.5, 1.0)):
        gaussians = frame_gaussians(model, t, depth_step=0)
        beside = read_3dgs_ply(folder / f"frame_{k:04d}.ply")
        np.testing.assert_allclose(beside.opacity, gaussians.opacity, atol=1e-6)
        np.testing.assert_allclose(beside.color, gaussians.color, atol=1e-6)
        text = (folder / f"frame_{k:04d}.obj").read_text()
        faces = [line for line in text.splitlines() if line.startswith("f ")]
        assert faces == [f"f {j + 1} {j + 2} {j + 3}" for j in range(0, 3 * len(gaussians.mean), 3)]
        vertices = np.array([line.split()[1:] for line in text.splitlines() if line.startswith("v ")], np.float64)
        np.testing.assert_allclose(vertices[::3, 3:], np.clip(gaussians.color, 0, 1), atol=1e-4)
        places = vertices[:, :3].reshape(-1, 3, 3)
        assert len(places) == len(gaussians.mean) > 20
        assert not places[..., 2].any()
        np.testing.assert_allclose(places[:, 0, :2], gaussians.mean[:, :2] * [1, -1], atol=1e-7)
        edges = (places[:, 1:] - places[:, :1])[..., :2]
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
