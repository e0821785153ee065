"""Paths that Gaussians share: maps in time, conditioning and its gradient, and files."""

import dataclasses
import tracemalloc

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from path_models import moving_model, moving_splats, random_paths, random_splats
from soft_models import assert_same

from foldgauss.io import load_video_model, save_video_model
from foldgauss.video import density_image
from foldgauss.video.models.row_layout import pack, unpack
from foldgauss.video.models.shared_paths import SharedPaths

SIZE, T = (48, 80), np.float32(0.4)


def test_maps_are_those_at_the_knots_and_linear_between_them():
    paths = random_paths()
    for p in range(2):
        for k in range(5):
            np.testing.assert_array_equal(paths.at(paths.times[p, k])[p], paths.matrices[p, k])
        middle = paths.times[p, 1] + 0.25 * (paths.times[p, 2] - paths.times[p, 1])
        expected = 0.75 * paths.matrices[p, 1] + 0.25 * paths.matrices[p, 2]
        np.testing.assert_allclose(paths.at(middle)[p], expected, atol=1e-5)
        np.testing.assert_array_equal(paths.at(np.float32(-1))[p], paths.matrices[p, 0])
        np.testing.assert_array_equal(paths.at(np.float32(2))[p], paths.matrices[p, -1])


def test_jax_and_numpy_give_the_same_maps_also_at_repeated_times():
    paths = random_paths()
    paths = dataclasses.replace(paths, times=np.repeat(paths.times[:, :1], 5, 1))
    for one in (paths, random_paths()):
        for t in np.linspace(-0.1, 1.1, 13, dtype=np.float32):
            own = jax.jit(lambda paths, t: paths.at(t))(jax.tree.map(jnp.asarray, one), t)
            np.testing.assert_allclose(own, one.at(t), atol=1e-6)
            assert np.isfinite(own).all()


def test_a_path_with_one_knot_does_not_move():
    paths = random_paths(num_knots=1)
    np.testing.assert_array_equal(paths.at(np.float32(0.7)), paths.matrices[:, 0])


def test_rows_hold_the_path_and_come_back():
    splats = moving_splats(50)
    rows = pack(splats)
    assert rows.shape == (50, 18)
    again = unpack(rows, 3, splats.envelope, splats.paths)
    assert_same(again, splats)


def test_files_hold_paths(tmp_path):
    model = moving_model()
    again = load_video_model(save_video_model(tmp_path / "m.safetensors", model))
    jax.tree.map(np.testing.assert_array_equal, again, model)


def changed_paths(leaf, value):
    own = getattr(random_paths(), leaf).copy()
    own[0, 3] = value
    return {"paths": dataclasses.replace(random_paths(), **{leaf: own})}


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        (changed_paths("matrices", np.nan), "finite times and matrices"),
        (changed_paths("times", np.inf), "finite times and matrices"),
        (changed_paths("times", -1.0), "times that do not decrease"),
        ({"path_index": np.full(300, 3, np.uint8)}, "paths from 0 to 2, got 3"),
    ],
)
def test_paths_that_make_no_sense_are_errors(tmp_path, changes, expected):
    model = moving_model(dataclasses.replace(moving_splats(), **changes))
    with pytest.raises(ValueError, match=expected):
        model.prepare(SIZE)
    path = save_video_model(tmp_path / "m.safetensors", model)
    with pytest.raises(ValueError, match=expected):
        load_video_model(path)


def test_places_of_many_take_no_memory_for_every_knot():
    rng = np.random.default_rng(0)
    times = np.sort(rng.random((2, 2000)), 1).astype(np.float32)
    paths = SharedPaths(times, rng.normal(size=(2, 2000, 2, 3)).astype(np.float32))
    t, path = rng.random(20_000).astype(np.float32), rng.integers(0, 2, 20_000)
    tracemalloc.start()
    maps = paths.by_path(t, path)
    assert tracemalloc.get_traced_memory()[1] < 2e7
    tracemalloc.stop()
    expected = jax.tree.map(jnp.asarray, paths).by_path(jnp.asarray(t[:50]), jnp.asarray(path[:50]))
    np.testing.assert_allclose(maps[:50], expected, atol=1e-5)


def test_folded_gaussians_are_those_of_the_frame():
    with jax.enable_x64(True):
        splats = jax.tree.map(
            lambda leaf: jnp.asarray(leaf, float) if leaf.dtype != np.uint8 else leaf, moving_splats()
        )
        fold, given = jax.jit(lambda splats: splats.gaussians()), eqx.filter_jit(lambda own, t: own.condition_time(t))
        shown, folded = jax.jit(lambda splats, t: splats.at(t)), fold(splats)
        for t in (0.1, 0.4, 0.8):
            there, at = shown(splats, jnp.asarray(t)), given(folded, jnp.asarray(t))
            np.testing.assert_allclose(at.loc, there.mean, atol=1e-12)
        one = jax.tree.map(jnp.asarray, splats.paths)
        maps = one.by_index(folded.time_loc, splats.path_index)
        own = maps[..., :2] @ splats._unmoved().scale_tril
        covariance = folded.scale_tril @ folded.scale_tril.mT
        np.testing.assert_allclose(covariance, own @ own.mT, rtol=1e-9, atol=1e-15)
        np.testing.assert_array_equal(np.triu(folded.scale_tril, 1), 0)
        # Paths without turn or stretch are represented exactly.
        still = jnp.broadcast_to(jnp.eye(2), (*one.matrices.shape[:3], 2))
        shifts = SharedPaths(one.times, jnp.concatenate([still, one.matrices[..., 2:]], -1))
        moved = dataclasses.replace(splats, paths=shifts)
        there, at = shown(moved, jnp.asarray(0.4)), given(fold(moved), jnp.asarray(0.4))
        np.testing.assert_allclose(at.covariance_matrix, there.factor @ there.factor.mT, rtol=1e-9, atol=1e-15)


def test_mixture_of_splats_on_paths_is_rendered_as_its_density():
    mixture = moving_splats(40).to_mixture()
    image = np.asarray(density_image(mixture, 0.4, SIZE))
    height, width = SIZE
    y, x = np.mgrid[0:height, 0:width] + 0.5
    place = (np.stack([x, y], -1) - [width / 2, height / 2]) / max(SIZE)
    grid = np.concatenate([place, np.full((*SIZE, 1), 0.4)], -1).astype(np.float32)
    density = np.asarray(mixture.pdf(grid))
    np.testing.assert_allclose(image, density, atol=1e-3 * density.max())
    assert mixture.sample(jax.random.key(0), (1000,)).shape == (1000, 3)


def test_models_without_paths_have_polynomial_folds():
    assert type(random_splats(5).gaussians().fold).__name__ == "PolynomialFold"
