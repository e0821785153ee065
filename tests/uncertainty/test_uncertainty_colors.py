"""Profiles with colors integrated out, against explicit covariances of all pixels."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats
from soft_models import NUM, NUM_FRAMES, soft_model

from foldgauss.uncertainty import FrameNoise, likelihood_profiles
from foldgauss.uncertainty.likelihood import color_marginalization as module
from foldgauss.uncertainty.likelihood.color_marginalization import marginalize_colors
from foldgauss.uncertainty.likelihood.color_normal_equations import ColorEquations, solve_conjugate_gradient
from foldgauss.uncertainty.likelihood.residuals import Residuals

SIZE, NOISE, PRIOR, FRAME = (20, 32), 0.03, 0.3, 3


@pytest.fixture(scope="module", params=["over", "sum"])
def scene(request):
    model = soft_model(size=SIZE, compositing=request.param)
    if request.param == "sum":  # contributions add up: lower opacities
        splats = dataclasses.replace(model.splats, opacity_logit=model.splats.opacity_logit - 2)
        model = dataclasses.replace(model, splats=splats)
    return _filmed(model)


@pytest.fixture(scope="module")
def over():
    return _filmed(soft_model(size=SIZE))


def _filmed(model):
    rng = np.random.default_rng(5)
    shown = np.moveaxis(np.stack(list(Residuals(model, _nothing()).render_at(model.frame_times.times()))), 1, -1)
    video = np.clip(np.rint(255 * (shown + NOISE * rng.normal(size=shown.shape))), 0, 255).astype(np.uint8)
    return model, video, likelihood_profiles(model, video, noise=FrameNoise(np.array(NOISE), np.array(0.5)))


def _nothing():
    return np.zeros((NUM_FRAMES, *SIZE, 3), np.uint8)


def _equations(model, video, base, prior_scale=PRIOR):
    times = base.curves.modes()
    times[[0, -1]] = 0, 1
    return ColorEquations(Residuals(model, video), base.noise, times, prior_scale)


def _by_hand(equations, k, t, prior_scale=PRIOR):
    """The density of frame k's pixels from their explicit covariance."""
    precision, rhs = np.eye(NUM) / prior_scale**2, np.zeros((NUM, 3))
    frames = equations.residuals.frames.reshape(NUM_FRAMES, -1, 3) / 255
    for j in range(NUM_FRAMES):
        if j != k:
            a = equations.weights(equations.times[j]).toarray()
            precision += a.T @ a / equations.variance[j]
            rhs += a.T @ (frames[j] - a @ equations.color) / equations.variance[j]
    covariance = np.linalg.inv(precision)
    color, a = equations.color + covariance @ rhs, equations.weights(t).toarray()
    pixels = equations.variance[k] * np.eye(len(a)) + a @ covariance @ a.T
    pixels = scipy.stats.Covariance.from_cholesky(np.linalg.cholesky(pixels))  # one factorization for all channels
    logpdf = scipy.stats.multivariate_normal.logpdf
    return sum(logpdf(x, mean, pixels) for x, mean in zip(frames[k].T, (a @ color).T, strict=True))


def _times(equations, k):
    return equations.times[k] + np.array([-0.04, -0.01, 0.0, 0.02])


def test_exact_profile_is_the_gaussian_density_of_all_pixels(scene):
    equations = _equations(*scene)
    curve = module._Dense(equations, FRAME)
    times = _times(equations, FRAME)
    for t in times:
        curve.evaluate(t)
    expected = np.array([_by_hand(equations, FRAME, t) for t in times])
    assert np.ptp(expected) > 0.5
    np.testing.assert_allclose(curve.profile()[1], expected - expected.max(), rtol=1e-6, atol=1e-6)


def test_estimated_profile_with_all_probes_is_exact(over):
    """Unit vectors of all pixels as probes, scaled as the mean over probes requires: no Monte Carlo error remains."""
    equations = _equations(*over)
    num_pixels = SIZE[0] * SIZE[1]
    exact = module._Dense(equations, FRAME)
    estimated = module._Estimated(equations, FRAME, np.sqrt(num_pixels) * np.eye(num_pixels))
    for t in equations.times[FRAME] + np.linspace(-0.3, 0.3, 13):
        exact.evaluate(t)
        estimated.evaluate(t)
    without = np.array([point.log_likelihood for point in estimated.points])
    expected, found = exact.values() - without, estimated.values() - without
    assert np.ptp(expected) > 0.5
    np.testing.assert_allclose(found - found[6], expected - expected[6], atol=0.01 * np.ptp(expected))


def test_estimate_is_near_the_exact_profile(over):
    model, video, base = over
    exact = marginalize_colors(model, video, base, frames=[FRAME], prior_scale=PRIOR).curves
    near = marginalize_colors(model, video, base, frames=[FRAME], prior_scale=PRIOR, most_dense=0, probes=16).curves
    nodes, values = exact[FRAME].nodes_and_values(0)
    top = values > -module.REACH
    np.testing.assert_allclose(near[FRAME](nodes[top, None])[:, 0], values[top], atol=0.5)


def test_narrow_color_prior_gives_the_base_profile(over):
    model, video, base = over
    found = marginalize_colors(model, video, base, frames=[FRAME], prior_scale=1e-7).curves
    nodes, values = base.curves.nodes_and_values(FRAME)
    top = values > -8
    np.testing.assert_allclose(found[FRAME](nodes[top, None])[:, 0], values[top], atol=0.1)


def test_profiles_widen_and_those_of_other_frames_are_kept(scene):
    model, video, base = scene
    done = []
    found = marginalize_colors(model, video, base, frames=[2, 4], on_frame=lambda *each: done.append(each))
    assert found.level == "colors"
    found = found.curves
    assert done == [(1, 2), (2, 2)]
    for k in range(NUM_FRAMES):
        if k not in (2, 4):
            np.testing.assert_array_equal(found.nodes_and_values(k), base.curves.nodes_and_values(k))
            continue
        assert _spread(found[k]) > 1.02 * _spread(base.curves[k])
        nodes, values = found.nodes_and_values(k)
        own, _ = base.curves.nodes_and_values(k)
        assert (nodes[0], nodes[-1]) == (own[0], own[-1])  # the same domain
        assert values.max() == 0
        fine = found[k](np.linspace(own[0], own[-1], 5001)[:, None])[:, 0]
        assert fine.max() < 0.1


def _spread(profile):
    times = np.linspace(0, 1, 20001)
    density = np.exp(profile(times[:, None])[:, 0])
    density /= density.sum()
    mean = (times * density).sum()
    return np.sqrt(((times - mean) ** 2 * density).sum())


def test_seeds_reproduce(over):
    model, video, base = over
    few = {"frames": [FRAME], "most_dense": 0, "probes": 2}
    one, same, other = (marginalize_colors(model, video, base, **few, seed=seed).curves for seed in (1, 1, 2))
    np.testing.assert_array_equal(one.values, same.values)
    assert one.count[FRAME] != other.count[FRAME] or (one.values[FRAME] != other.values[FRAME]).any()


def test_conjugate_gradients_without_convergence_raise():
    rhs = np.ones((4, 1))
    with pytest.raises(ValueError, match="prior_scale: expected colors solved to 1e-05"):
        solve_conjugate_gradient(np.zeros_like, lambda r: r, rhs, np.zeros_like(rhs), 1e-5)


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"frames": [0]}, "frames: expected different frames from 1 to 5"),
        ({"frames": [2, 2]}, "frames: expected different"),
        ({"frames": [6]}, "frames: expected different"),
        ({"frames": [1.5]}, "frames: expected different"),
        ({"prior_scale": 0}, "prior_scale: expected a number > 0"),
        ({"prior_scale": float("nan")}, "prior_scale: expected a number > 0"),
        ({"most_dense": -1}, "most_dense: expected a whole number >= 0"),
        ({"probes": 0}, "probes: expected a whole number >= 1"),
        ({"base": None}, "base: expected LikelihoodProfiles"),
        ({"video": np.zeros((4, *SIZE, 3), np.uint8)}, "base: expected profiles of 4 frames"),
        ({"video": np.zeros((7, 5, 5, 3), np.uint8)}, "video: expected"),
    ],
)
def test_wrong_input_raises(over, change, match):
    model, video, base = over
    with pytest.raises(ValueError, match=match):
        marginalize_colors(**{"model": model, "video": video, "base": base, **change})


def test_models_with_nan_raise(over):
    model, video, base = over
    broken = dataclasses.replace(model.splats, loc=jnp.asarray(model.splats.loc).at[0, 0].set(jnp.nan))
    with pytest.raises(ValueError, match="model: expected finite numbers"):
        marginalize_colors(dataclasses.replace(model, splats=broken), video, base)
