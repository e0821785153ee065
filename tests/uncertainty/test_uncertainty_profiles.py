"""Likelihood profiles: interpolated log-likelihoods match those of images rendered at the same times."""

import dataclasses
import warnings

import numpy as np
import pytest
import scipy.interpolate
from soft_models import soft_model
from time_clips import NUM_FRAMES, SCALE, SIZE, clip, model, parabolas, rendered_log_likelihood, uneven, white

from foldgauss.uncertainty import (
    FrameNoise,
    FrameTimeLogProb,
    LikelihoodProfiles,
    ProfileCurves,
    exact_posterior,
    likelihood_profiles,
)
from foldgauss.uncertainty.likelihood import likelihood_profiles as drawing
from foldgauss.uncertainty.likelihood.residuals import random_projection
from foldgauss.uncertainty.posterior.log_prob import log_prior
from foldgauss.video.models.shared_paths import SharedPaths


@pytest.fixture(scope="module")
def profiles() -> LikelihoodProfiles:
    return likelihood_profiles(model(), clip(uneven()), noise=white())


def test_between_nodes_a_profile_is_the_cubic_with_its_slopes():
    rng = np.random.default_rng(0)
    nodes = np.sort(rng.uniform(size=(2, 9)), axis=1)
    curves = ProfileCurves.from_nodes(nodes, np.sin(5 * nodes))
    t = rng.uniform(nodes[:, :1], nodes[:, -1:], (2, 50)).T
    for k in range(2):
        slopes = np.gradient(np.sin(5 * nodes[k]), nodes[k], edge_order=2)
        expected = scipy.interpolate.CubicHermiteSpline(nodes[k], np.sin(5 * nodes[k]), slopes)(t[:, k])
        np.testing.assert_allclose(curves(t)[:, k], expected, rtol=1e-10, atol=1e-12)


def test_parabolas_are_interpolated_exactly():
    curves = parabolas([0.3, 0.6], [0.05, 0.1], 31)
    t = np.random.default_rng(1).uniform(size=(100, 4))
    expected = -((t[:, 1] - 0.3) ** 2) / 0.005
    np.testing.assert_allclose(curves(t)[:, 1], expected, atol=1e-9)


def test_outside_of_the_nodes_and_nan_give_minus_infinity():
    curves = ProfileCurves.from_nodes([np.linspace(0.2, 0.4, 5)], [np.zeros(5)])
    found = curves(np.array([0.2, 0.4, 0.19, 0.41, np.nan])[:, None])[:, 0]
    np.testing.assert_array_equal(found, [0, 0, -np.inf, -np.inf, -np.inf])


def test_curves_match_rendered_log_likelihoods(profiles):
    # Within the posterior, to the stated precision: MISS nats and a fraction of the depth.
    rng, times = np.random.default_rng(0), uneven()
    modes = profiles.curves.modes()
    modes[[0, -1]] = times[[0, -1]]
    best = rendered_log_likelihood(model(), clip(times), modes, white())
    noise = profiles.noise
    std = exact_posterior(profiles.curves).std()
    for _ in range(10):
        t = np.clip(modes + 2.5 * std * rng.standard_normal(NUM_FRAMES), 0, 1)
        drawn = rendered_log_likelihood(model(), clip(times), t, noise) - best
        looked_up = profiles.curves(t) - profiles.curves(modes)
        depth = np.maximum(-drawn, 0)
        assert (np.abs(looked_up - drawn)[1:-1] < 0.1 + 0.05 * depth[1:-1]).all()


def test_log_prob_is_the_sum_over_frames(profiles):
    log_prob = FrameTimeLogProb(profiles.curves)
    total = rendered_log_likelihood(model(), clip(uneven()), uneven(), white()).sum()
    best = rendered_log_likelihood(model(), clip(uneven()), profiles.curves.modes(), white()).sum()
    prior = log_prior(uneven(), 1.0)
    assert log_prob(uneven()[1:-1]) - prior == pytest.approx(total - best, abs=1.0)
    assert profiles.log_likelihood.sum() == pytest.approx(best, rel=1e-6)


def test_profile_is_refined_between_equal_coarse_nodes():
    # Both nodes are as far below the maximum as each other: their difference is 0.
    nodes = np.linspace(0, 1, 25)
    times = np.array([0, (nodes[5] + nodes[6]) / 2, (nodes[12] + nodes[13]) / 2, 1])
    profiles = likelihood_profiles(model(), clip(times, scale=0.0), noise=white(0.01))
    for k in (1, 2):
        at, _ = profiles.curves.nodes_and_values(k)
        assert np.abs(at - times[k]).min() < 0.002


def test_profiles_recover_scale_and_times(profiles):
    measured = likelihood_profiles(model(), clip(uneven()), noise="independent")
    np.testing.assert_allclose(measured.noise.scale, SCALE, rtol=0.1)
    spread = exact_posterior(profiles.curves)
    miss = (spread.mean() - uneven())[1:-1] / spread.std()[1:-1]
    assert np.abs(miss).max() < 4
    assert (miss**2).mean() < 2.5
    assert measured.residual_correlation[0] == pytest.approx(1)
    assert np.abs(measured.residual_correlation[2:]).max() < 0.1


def test_alpha_is_composited_over_black():
    frames = clip(uneven())
    opaque = np.concatenate([frames, np.full((*frames.shape[:3], 1), 255, np.uint8)], axis=3)
    one, other = (rendered_log_likelihood(model(), each, uneven(), white()) for each in (frames, opaque))
    np.testing.assert_allclose(one, other, rtol=1e-4)


def test_flat_profile_keeps_its_prior():
    curves = parabolas([0.25, 0.5, 0.75], [0.02, 10.0, 0.02])
    found = exact_posterior(curves)
    assert found.std()[2] > 0.8 * 0.5 / np.sqrt(12)
    assert found.std()[1] == pytest.approx(0.02, rel=0.02)


def test_a_clip_of_another_size_or_type_is_refused():
    frames = clip(uneven())
    for wrong in (frames[:, :-1], frames[..., :2], frames.astype(np.float32), frames[0]):
        with pytest.raises(ValueError, match="video"):
            likelihood_profiles(model(), wrong)
    with pytest.raises(ValueError, match="3 frames"):
        likelihood_profiles(model(), frames[:2])


def test_a_model_of_another_video_is_refused():
    other = np.random.default_rng(0).integers(0, 256, (NUM_FRAMES, *SIZE, 3), np.uint8)
    with pytest.raises(ValueError, match="explains"):
        likelihood_profiles(model(), other)


def test_a_constant_video_has_no_times():
    still = np.repeat(clip(np.array([0.0, 0.5, 1.0]))[:1], 6, axis=0)
    with pytest.raises(ValueError, match="nothing changes"):
        likelihood_profiles(model(), still)


def test_too_large_noise_raises():
    with pytest.raises(ValueError, match="not identified"):
        likelihood_profiles(model(), clip(uneven()), noise=FrameNoise(1.0, 1e-6))


def test_frames_backwards_are_refused():
    with pytest.warns(UserWarning, match="held at time"), pytest.raises(ValueError, match="order"):
        exact_posterior(likelihood_profiles(model(), clip(uneven(), scale=0.0)[::-1], noise=white(0.0012)).curves)


@pytest.mark.parametrize("noise", ["loud", "", None, 1.0])
def test_unknown_noise_is_refused(noise):
    with pytest.raises(ValueError, match="noise"):
        likelihood_profiles(model(), clip(uneven()), noise=noise)


def test_curves_refuse_wrong_shapes_and_values():
    t = np.linspace(0, 1, 5)
    for nodes, values, word in (
        ([t[:2]], [t[:2]], "three"),
        ([t], [t[:4]], "increasing"),
        ([t[::-1]], [t], "increasing"),
        ([t], [np.where(t > 0.5, np.nan, t)], "finite"),
        ([t, t], [t], "as many"),
    ):
        with pytest.raises(ValueError, match=word):
            ProfileCurves.from_nodes(nodes, values)
    with pytest.raises(ValueError, match="shape"):
        parabolas([0.5], [0.1])(np.zeros(2))


def test_another_seeded_model_is_another_scene():
    frames = clip(uneven(), of=soft_model(size=SIZE, seed=5))
    with pytest.raises(ValueError, match="video"):
        likelihood_profiles(model(), frames)


def test_clip_that_begins_later_than_its_model_warns():
    with pytest.warns(UserWarning, match="Frame 0 is held at time 0"):
        likelihood_profiles(model(), clip(0.3 + 0.7 * uneven()), noise=white(0.02))


def test_gaussians_on_shared_paths_warn():
    still = np.array([[[[1, 0, 0], [0, 1, 0]]]], np.float32)  # one path, one knot
    index = np.arange(len(model().splats.loc)) % 4 == 0
    splats = dataclasses.replace(
        model().splats, path_index=index.astype(np.uint8), paths=SharedPaths(np.zeros((1, 1), np.float32), still)
    )
    with pytest.warns(UserWarning, match="25% of the Gaussians follow shared paths.*--no-follow-camera"):
        found = likelihood_profiles(dataclasses.replace(model(), splats=splats), clip(uneven()), noise=white())
    assert len(found.notes) == 1


def test_a_reach_that_is_too_short_is_widened(monkeypatch):
    times = np.linspace(0, 1, 9) ** 3
    whole = likelihood_profiles(model(), clip(times), noise=white(0.02))
    monkeypatch.setattr(drawing, "MOST_EVERYWHERE", 3)
    monkeypatch.setattr(drawing, "REACH", 1)
    widened = likelihood_profiles(model(), clip(times), noise=white(0.02))
    np.testing.assert_allclose(widened.curves.modes(), whole.curves.modes(), atol=2e-3)


def test_sketches_keep_distances_of_images():
    rng = np.random.default_rng(0)
    projection = random_projection(3 * 40 * 60)
    pictures = rng.random((12, 3, 40, 60), np.float32) * (rng.random((12, 1, 40, 60)) < 0.1)
    pictures = pictures.astype(np.float32)
    made = np.stack([projection @ picture.ravel() for picture in pictures])
    for one, other in ((0, 1), (2, 3), (4, 5), (6, 7), (8, 9), (10, 11)):
        truth = np.square(pictures[one] - pictures[other]).sum()
        assert np.square(made[one] - made[other]).sum() == pytest.approx(truth, rel=0.3)


def fast_speck():
    """A speck of 1 pixel that crosses a wide frame at 7 pixels per quarter of a frame, over a static background."""
    soft = soft_model(size=(24, 200))
    num = soft.num_gaussians
    first, second = np.arange(num) == 0, np.arange(num) == 1
    splats = dataclasses.replace(
        soft.splats,
        loc=np.zeros((num, 2), np.float32),
        log_scale=np.log(np.where(first, 0.006, 0.4)).astype(np.float32)[:, None].repeat(2, 1),
        time_loc_logit=np.zeros(num, np.float32),
        log_time_scale=np.full(num, 3, np.float32),
        coefficients=np.where(first[:, None, None], np.float32([[0.9, 0], [0, 0], [0, 0]]), np.float32(0)),
        opacity_logit=np.where(first, 4, np.where(second, 0, -20)).astype(np.float32),
        color_dc=np.where(first[:, None], 1.5, [-0.5, 0.0, 0.3]).astype(np.float32),
    )
    return dataclasses.replace(soft, splats=splats)


def test_small_fast_object_is_found_between_coarse_nodes():
    """The speck is at other places at all coarse nodes: only times in between match."""
    speck = fast_speck()
    truth = np.array([0.0, 0.155, 0.31, 0.47, 0.655, 0.81, 1.0])
    found = likelihood_profiles(speck, clip(truth, of=speck, scale=0.01), noise=white(0.01)).curves
    np.testing.assert_allclose(found.modes()[1:-1], truth[1:-1], atol=2e-3)


def test_another_clip_of_the_same_scene_warns():
    speck = fast_speck()
    frames = clip(np.linspace(0.05, 0.95, 7), of=speck, scale=0.005)
    mean = np.median(frames, axis=0).astype(np.int16)
    other = np.clip(mean + np.roll(frames - mean, 8, axis=1), 0, 255).astype(np.uint8)  # the speck takes another path
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        likelihood_profiles(speck, other, noise=white(0.02))
    assert any("of another one" in str(each.message) for each in caught)
