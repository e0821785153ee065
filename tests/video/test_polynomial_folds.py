"""Shared paths written as polynomial folds: exact where they are polynomials, with the error stated elsewhere."""

import dataclasses
import warnings

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from path_models import INDEX, path_model
from soft_models import NUM, OBJECT, soft_model

from foldgauss.io import read_vegas_ply, write_vegas_ply
from foldgauss.video import FrameTimes, without_paths
from foldgauss.video.models.conditioning import PreparedModel
from foldgauss.video.models.shared_paths import SharedPaths


def smooth_model(place, *, num_knots=201, index=INDEX, **settings):
    """A model whose first path shifts by `place(t)`, (num, 2), and the second twice as far."""
    times = np.linspace(0, 1, num_knots)
    maps = np.tile(np.eye(2, 3), (2, num_knots, 1, 1))
    maps[0, :, :, 2], maps[1, :, :, 2] = place(times), 2 * place(times)
    paths = SharedPaths(np.tile(times, (2, 1)).astype(np.float32), maps.astype(np.float32))
    model = soft_model(**settings)
    return dataclasses.replace(model, splats=dataclasses.replace(model.splats, path_index=index, paths=paths))


def test_a_polynomial_path_is_represented():
    model = smooth_model(lambda t: np.stack([0.3 * t, 0.1 * t**2 - 0.2 * t], -1))
    plain, error = without_paths(model)
    assert (plain.splats.paths, plain.splats.path_index, plain.degree) == (None, None, model.degree)
    assert error.max() < 2e-3
    for t in (0.0, 0.3, 1.0):
        one, other = PreparedModel(model, model.size).at(t), PreparedModel(plain, plain.size).at(t)
        np.testing.assert_array_equal(one.alive, other.alive)
        np.testing.assert_allclose(other.mean, one.mean, atol=0.01)
        np.testing.assert_allclose(other.factor @ other.factor.mT, one.factor @ one.factor.mT, rtol=1e-4, atol=1e-4)


def test_the_error_is_what_is_left_at_the_frames_and_higher_degrees_reduce_it():
    model = smooth_model(lambda t: 0.1 * np.stack([np.sin(9 * t), np.cos(7 * t)], -1))
    model = dataclasses.replace(model, frame_times=FrameTimes.uniform(200))
    errors = [without_paths(model, degree)[1] for degree in (3, 5, 7)]
    plain, error = without_paths(model)
    assert plain.degree == 7
    assert errors[0][INDEX > 0].mean() > 5 * errors[2][INDEX > 0].mean()
    assert errors[0][INDEX > 0].max() > 0.5
    np.testing.assert_array_equal(error[INDEX == 0], 0)
    assert (error <= errors[0] + 1e-9).all()
    assert error[INDEX > 0].mean() < 1.5 * errors[2][INDEX > 0].mean() + 0.1
    # The error is that of the places, weighted by the envelope.
    fixed, stated = without_paths(model, 4)
    squares, total = np.zeros(NUM), np.zeros(NUM)
    at, gaussians = eqx.filter_jit(lambda splats, t: splats.at(t)), fixed.splats.gaussians()
    for t in np.asarray(model.frame_times.times()):
        one, other = at(model.splats, jnp.asarray(t)), at(fixed.splats, jnp.asarray(t))
        tau = (t - np.asarray(gaussians.time_loc)) / np.asarray(gaussians.time_scale)
        weight = np.exp(-(tau**2)) * (np.asarray(one.opacity) > 0)
        squares += weight * ((np.asarray(one.mean) - np.asarray(other.mean)) ** 2).sum(-1)
        total += weight
    np.testing.assert_allclose(np.sqrt(squares / total) * max(model.size), stated, rtol=0.1, atol=1e-3)


def test_places_and_covariances_at_their_own_times_are_exact():
    model = path_model()
    plain, _ = without_paths(model)
    one, other = model.splats.gaussians(), plain.splats.gaussians()
    np.testing.assert_allclose(other.loc, one.loc, atol=1e-6)
    np.testing.assert_allclose(other.scale_tril, one.scale_tril, atol=1e-5)
    for name in ("loc", "log_scale", "angle_logit"):
        mine, before = np.asarray(getattr(plain.splats, name)), np.asarray(getattr(model.splats, name))
        np.testing.assert_array_equal(mine[INDEX == 0], before[INDEX == 0])
    np.testing.assert_array_equal(
        plain.splats.coefficients[INDEX == 0, :3], np.asarray(model.splats.coefficients)[INDEX == 0]
    )
    np.testing.assert_array_equal(plain.splats.coefficients[INDEX == 0, 3:], 0)


def test_short_lives_between_frames_and_whole_clips_are_fitted():
    model = smooth_model(lambda t: 0.2 * np.stack([t, t**2], -1))
    scales = np.where(OBJECT, np.log(1e-4), np.log(1024)).astype(np.float32)
    model = dataclasses.replace(model, splats=dataclasses.replace(model.splats, log_time_scale=scales))
    plain, error = without_paths(model)
    assert np.isfinite(plain.splats.coefficients).all()
    assert error.max() < 0.01


def test_gaussians_without_folds_of_their_own_get_one():
    model = smooth_model(lambda t: np.stack([0.2 * t, -0.1 * t], -1), degree=0)
    plain, error = without_paths(model)
    assert plain.degree == 1
    assert error.max() < 1e-3


def test_what_cannot_be_converted():
    plain = soft_model()
    assert without_paths(plain)[0] is plain
    for degree in (0, 2, 2.5):
        with pytest.raises(ValueError, match="degree: expected a whole number from 3"):
            without_paths(path_model(), degree)
    with pytest.raises(ValueError, match="model: expected a VideoModel"):
        without_paths(plain.splats)


def test_vegas_files_have_folds_for_paths_and_say_how_good_they_are(tmp_path):
    model = path_model()
    with pytest.warns(UserWarning, match=r"model: the file has no shared paths: 26 Gaussians .* degree 7.* pixels"):
        path = write_vegas_ply(tmp_path / "v.ply", model)
    again, plain = read_vegas_ply(path), without_paths(model)[0]
    np.testing.assert_allclose(again.splats.coefficients, plain.splats.coefficients, rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(again.splats.loc, plain.splats.loc, atol=1e-6)
    with warnings.catch_warnings(action="error"):
        write_vegas_ply(tmp_path / "w.ply", plain)
