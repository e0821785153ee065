"""Refitted frame times: bootstrap residuals, and statistics of the replicates."""

import dataclasses

import numpy as np
import pytest

from foldgauss.uncertainty import RefitTimes, likelihood_profiles, refit_frame_times
from foldgauss.uncertainty.likelihood.refit import resample_blocks, resample_frames
from foldgauss.uncertainty.likelihood.residuals import Residuals
from foldgauss.video import FitConfig, LearningRates, Views, fit

CONFIG = FitConfig(num_gaussians=150, steps=200, degree=2, views=Views(interpolation_fraction=0.0))
#: Learning rates with which only the frame times are fitted.
HELD = LearningRates(0, 0, 0, 0, 0, 0, 0, 0, frame_times=4e-3)


def passing(num_frames=7, height=24, width=40, noise=3.0):
    """A bright spot that crosses the frame: uint8 (num_frames, height, width, 3), noise in gray levels."""
    y, x = np.mgrid[0:height, 0:width]
    place = np.linspace(0.2, 0.8, num_frames)[:, None, None] * width
    spot = np.exp(-((x - place) ** 2 + (y - height / 2) ** 2) / 30)
    frames = np.stack([40 + 150 * spot, 60 + 80 * spot, 90 + 2 * x + 0 * spot], -1)
    return np.clip(np.rint(frames + np.random.default_rng(5).normal(0, noise, frames.shape)), 0, 255).astype(np.uint8)


@pytest.fixture(scope="module")
def frames():
    return passing()


@pytest.fixture(scope="module")
def model(frames):
    return fit(frames, CONFIG).model


def own_times(model):
    return np.asarray(model.frame_times.times(), np.float64)


def inner_std(curves):
    """Standard deviations of the times given their curves alone, except for the first and the last frame."""
    t = np.linspace(0, 1, 20_001)
    log = np.stack([curves[k](t[:, None])[:, 0] for k in range(1, curves.num_frames - 1)])
    weight = np.exp(log - log.max(1, keepdims=True))
    weight /= weight.sum(1, keepdims=True)
    return np.sqrt((weight * (t - (weight @ t)[:, None]) ** 2).sum(1))


# Bootstrap residuals


@pytest.mark.parametrize("block", [1, 5, 16])
def test_kept_blocks_change_sign_as_one(block):
    residual = np.ones((3, 30, 41), np.float32)
    drawn = resample_blocks(residual, block, np.random.default_rng(1))
    assert (np.abs(drawn) == 1).all()
    assert (drawn == drawn[:1]).all()  # all channels
    for axis in (1, 2):
        changes = np.flatnonzero((np.diff(drawn, axis=axis) != 0).any((0, 3 - axis)))
        assert len(set((changes % block).tolist())) == 1  # one grid


def test_the_grid_of_blocks_lies_at_random():
    residual, offsets = np.ones((1, 8, 32), np.float32), []
    for seed in range(40):
        drawn = resample_blocks(residual, 8, np.random.default_rng(seed))
        offsets.append(int(np.flatnonzero((np.diff(drawn, axis=2) != 0).any((0, 1)))[0]) % 8)
    assert len(set(offsets)) > 5


def test_mean_and_variance_of_resampled_residuals():
    """At every pixel: z-scores of 600 draws, beyond 5 in one of 480 pixels with probability 3e-4."""
    rng = np.random.default_rng(3)
    residual = rng.normal(0, 1, (1, 20, 24)) * np.where(np.arange(24) < 12, 1.0, 3.0) + 0.4
    drawn = np.stack([resample_blocks(residual, 4, rng)[0] for _ in range(600)])
    assert np.abs(drawn.mean(0) / np.sqrt(residual[0] ** 2 / 600)).max() < 5
    np.testing.assert_allclose((drawn**2).mean(0), residual[0] ** 2)


def test_frames_spread_around_the_models_pictures(model, frames):
    residuals = Residuals(model, frames)
    pictures = np.stack(list(residuals.render_at(own_times(model))))
    draws = [resample_frames(residuals, 4, np.random.default_rng(seed)) for seed in range(100)]
    assert draws[0].dtype == np.uint8
    assert draws[0].shape == frames.shape
    drawn = np.moveaxis(np.stack(draws).astype(np.float64), -1, 2) / 255
    residual = np.stack([residuals.residual(k, picture) for k, picture in enumerate(pictures)])
    inside = (pictures - np.abs(residual) > 0) & (pictures + np.abs(residual) < 1)  # where nothing is clipped
    assert inside.mean() > 0.9
    missed, half = drawn.mean(0) - pictures, 0.5 / 255  # of two values each of which is rounded
    assert (np.maximum(np.abs(missed) - half, 0) / (np.abs(residual) + half))[inside].max() < 0.55  # 5.5 of 100 draws
    assert np.abs(missed[inside].mean()) < 0.1 / 255
    np.testing.assert_allclose(drawn.std(0)[inside].mean(), np.abs(residual)[inside].mean(), rtol=0.02)
    one, other = draws[0][2].astype(int) - draws[1][2], draws[0][3].astype(int) - draws[1][3]
    assert np.abs(np.corrcoef(one.ravel() != 0, other.ravel() != 0)[0, 1]) < 0.3  # frames are independent


# Replicates


def test_replicates_depend_on_the_seed_and_their_number(model, frames):
    def run(replicates=2, **how):
        models = []
        found = refit_frame_times(
            model, frames, CONFIG, steps=40, block=8, replicates=replicates, **how,
            on_replicate=lambda number, refitted: models.append((number, refitted)),
        )  # fmt: skip
        assert [number for number, _ in models] == list(range(replicates))
        np.testing.assert_array_equal([own_times(each) for _, each in models], found.times)
        return found

    found = run(3, seed=4)
    assert (np.diff(found.times) > 0).all()
    assert (found.times[:, [0, -1]] == [0, 1]).all()
    assert (found.std[1:-1] > 0).all()
    assert found.spread.max() < 0.2
    np.testing.assert_array_equal(run(seed=4).times, found.times[:2])
    assert (run(seed=5).times[:, 1:-1] != found.times[:2, 1:-1]).all()


def test_default_steps_are_the_end_of_the_schedule(model, frames):
    config = dataclasses.replace(CONFIG, steps=100, minutes=5.0, quality=10.0)
    original = dataclasses.replace(CONFIG, steps=30)
    ended, given = (
        refit_frame_times(model, frames, each, replicates=2, steps=steps).times
        for each, steps in ((config, None), (original, 30))
    )
    np.testing.assert_array_equal(ended, given)  # 30% of 100 steps, independent of minutes and quality


@pytest.mark.slow
def test_spread_with_held_splats_matches_the_profiles():
    """New noise and held splats: the spread of times matches the likelihood of independent pixels.

    With 24 replicates of 5 times the ratio is within a fifth of 1 with probability 0.998, were they independent. Held
    back by too few steps, they spread less: that is the power of it.
    """
    clean = passing(noise=0.0)
    base = fit(clean, CONFIG).model
    pictures = np.stack(list(base.frames())).astype(np.float64)
    noisy = np.clip(np.rint(pictures + np.random.default_rng(1).normal(0, 6, clean.shape)), 0, 255).astype(np.uint8)
    config = dataclasses.replace(CONFIG, rates=HELD)
    given = inner_std(likelihood_profiles(base, noisy, noise="independent").curves)
    std = np.concatenate([[0], given, [0]])
    how = {"replicates": 24, "block": 2}
    assert 0.8 < refit_frame_times(base, noisy, config, steps=200, **how).ratio_to(std) < 1.2
    assert refit_frame_times(base, noisy, config, steps=3, **how).ratio_to(std) < 0.6


# Statistics of replicates


def test_ratio_and_spread():
    rng, own = np.random.default_rng(2), np.linspace(0, 1, 41)
    std = np.where((own > 0) & (own < 1), 0.001 + 0.002 * own, 0.0)
    found = RefitTimes(own + 3 * std * rng.normal(size=(50, 41)), own)
    assert abs(found.ratio_to(std) - 3) < 0.2  # 1911 degrees of freedom: 4 standard errors
    assert abs(found.ratio_to(np.where(std > 0, 0.002, 0)) - 3) < 0.6
    np.testing.assert_allclose(found.spread, 40 * found.std, rtol=1e-6, atol=1e-12)


def test_local_ignores_smooth_warps():
    rng, own = np.random.default_rng(2), np.linspace(0, 1, 41)
    bump = np.sin(np.pi * own)
    warped = RefitTimes(own + 0.01 * rng.normal(size=(50, 1)) * bump, own)
    assert warped.local[1:-1].max() < 0.005 * warped.std.max()
    inner = (own > 0) & (own < 1)
    rough = RefitTimes(own + 0.01 * rng.normal(size=(200, 41)) * inner, own)
    np.testing.assert_allclose(rough.local[2:-2], 0.01 * np.sqrt(1.5), rtol=0.2)
    assert rough.local[0] == rough.local[-1] == 0


def test_spread_counts_frames_where_times_are_uneven():
    own = np.array([0.0, 0.1, 0.5, 1.0])
    times = own + np.array([[0, 0.04, 0, 0], [0, -0.01, 0, 0], [0, 0, 0, 0]])
    found = RefitTimes(times, own)
    np.testing.assert_allclose(found.spread[1], np.std([1.1, 0.9, 1.0], ddof=1))


def test_equal_float32_times_give_finite_spread():
    own = np.array([0.0, 0.5, 0.5, 1.0])
    assert np.isfinite(RefitTimes(np.stack([own, own]), own).spread).all()


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"replicates": 1}, "replicates: expected a whole number >= 2"),
        ({"replicates": 2.0}, "replicates: expected"),
        ({"seed": -1}, "seed: expected"),
        ({"block": 0}, "block: expected a whole number from 1 to 24"),
        ({"block": 25}, "block: expected a whole number from 1 to 24"),
        ({"steps": 0}, "steps: expected"),
        ({"video": lambda frames: frames[:-1]}, "video: expected the 7 frames"),
        ({"video": lambda frames: frames[:, :-1]}, "video: expected uint8"),
        ({"video": lambda frames: np.random.default_rng(1).integers(0, 256, frames.shape, np.uint8)}, "explains"),
        ({"video": lambda frames: np.insert(frames, 3, 255, axis=-1)}, "without alpha"),
        ({"config": CONFIG.replace(**{"rates.frame_times": 0.0})}, r"rates\.frame_times"),
        ({"config": dataclasses.replace(CONFIG, steps=None, minutes=1.0), "steps": None}, "ends by the clock"),
        ({"config": dataclasses.replace(CONFIG, degree=3)}, r"config\.degree"),
    ],
)
def test_arguments_that_do_not_fit_raise(model, frames, change, told):
    given = {"config": CONFIG, "steps": 5} | change
    with pytest.raises(ValueError, match=told):
        refit_frame_times(model, given.pop("video", np.asarray)(frames), **given)


def test_wrong_arguments_of_statistics_raise():
    own = np.linspace(0, 1, 7)
    found = RefitTimes(np.stack([own, own]), own)
    for std in (np.ones(6), np.zeros(7), 0.0, np.full(7, np.nan)):
        with pytest.raises(ValueError, match="std: expected"):
            found.ratio_to(std)


@pytest.mark.slow
def test_longer_refits_spread_more():
    """The documented effect of time warps, on a sufficiently large clip."""
    clip, config = passing(12, 48, 80), FitConfig(num_gaussians=800, steps=1000)
    whole = fit(clip, config).model
    short, long = (refit_frame_times(whole, clip, config, replicates=10, steps=steps) for steps in (100, 1000))
    assert np.mean(short.spread[1:-1] ** 2) < np.mean(long.spread[1:-1] ** 2)
