"""Tempering fractions of the residual noise, against theory and simulation."""

import numpy as np
import pytest
import scipy.ndimage

from foldgauss.uncertainty import FrameNoise
from foldgauss.uncertainty.likelihood import noise as module
from foldgauss.uncertainty.likelihood.noise import covariances, rings

SHAPE = (3, 160, 200)


def smoothed(spread: float, seed: int = 0, shape=SHAPE) -> np.ndarray:
    """White noise smoothed by a Gaussian, on a torus; of variance 1."""
    white = np.random.default_rng(seed).standard_normal(shape)
    noise = scipy.ndimage.gaussian_filter(white, (0, spread, spread), mode="wrap")
    return noise / noise.std()


def autocorrelation(residual: np.ndarray, most: int | None = None) -> np.ndarray:
    return module.autocorrelation(covariances(residual, most))


def score_fraction(residual: np.ndarray, slope: np.ndarray) -> float:
    return module.score_fraction(residual, slope, covariances(residual))


def test_white_noise_counts_in_full():
    noise = smoothed(0.01)
    assert score_fraction(noise, np.ones(SHAPE)) == pytest.approx(1, abs=0.1)
    np.testing.assert_allclose(rings(autocorrelation(noise, 5)), [1, 0, 0, 0, 0, 0], atol=0.01)


def test_equal_channels_count_as_one():
    one = smoothed(0.01)[:1]
    assert score_fraction(np.repeat(one, 3, axis=0), np.ones(SHAPE)) == pytest.approx(1 / 3, rel=0.1)


def test_autocorrelation_matches_its_definition():
    values = np.random.default_rng(0).normal(size=(2, 7, 9))
    found = autocorrelation(values, 2)
    for dy, dx in ((0, 0), (1, 0), (2, -1), (-1, 2)):
        rows, columns = slice(max(dy, 0), 7 + min(dy, 0)), slice(max(dx, 0), 9 + min(dx, 0))
        back_rows, back_columns = slice(max(-dy, 0), 7 + min(-dy, 0)), slice(max(-dx, 0), 9 + min(-dx, 0))
        mean = (values[:, rows, columns] * values[:, back_rows, back_columns]).mean()
        assert found[2 + dy, 2 + dx] == pytest.approx(mean / (values**2).mean())


def test_rings_are_means_by_distance():
    lags = np.arange(-4, 5)
    distance = np.hypot(lags[:, None], lags[None, :])
    found = rings(np.rint(distance))
    np.testing.assert_array_equal(found, [0, 1, 2, 3, 4])


@pytest.mark.parametrize("spread", [0.01, *(pytest.param(spread, marks=pytest.mark.slow) for spread in (1.0, 2.0))])
def test_score_fraction_matches_the_variance_of_the_score(spread):
    # The score of a time is the sum over pixels of residual times slope: its variance is estimated over many noise
    # images.
    y, x = np.mgrid[:160, :200]
    bump = np.exp(-((x - 90) ** 2 + (y - 70) ** 2) / 1800) * np.sin(x / 6)
    slope = np.stack([bump, 0.5 * bump, -0.2 * bump])
    noises = np.stack([smoothed(spread, seed) for seed in range(300)])
    variance = (noises * slope).sum((1, 2, 3)).var()
    truth = min(1.0, (slope**2).sum() / variance)
    found = np.mean([1 / score_fraction(noise, slope) for noise in noises[:20]])
    # 300 noise images give a variance to 8%.
    assert 1 / found == pytest.approx(truth, rel=0.25)


def test_scores_that_cancel_do_not_increase_the_fraction():
    """At the mode the residual is orthogonal to the slope: its own score varies less than that of noise."""
    y, x = np.mgrid[:160, :200]
    slope = np.exp(-((x - 90) ** 2 + (y - 70) ** 2) / 50) * np.ones((3, 1, 1))
    found, truth = [], []
    for seed in range(60):
        noise = smoothed(3.0, seed)
        truth.append((noise * slope).sum())
        found.append(1 / score_fraction(noise - slope * (noise * slope).sum() / (slope**2).sum(), slope))
    assert np.mean(found) == pytest.approx(np.var(truth) / (slope**2).sum(), rel=0.4)


def test_no_residual_at_all_counts_in_full():
    nothing = np.zeros(SHAPE)
    assert score_fraction(nothing, np.ones(SHAPE)) == 1
    found = autocorrelation(nothing, 2)
    assert found[2, 2] == 1
    assert found.sum() == 1


def test_fractions_are_at_most_one():
    # Alternating residuals cancel: the fraction stays at most 1.
    y, x = np.mgrid[:40, :40]
    board = np.where((x + y) % 2, 1.0, -1.0)[None]
    assert score_fraction(board, np.ones((1, 40, 40))) <= 1


def test_frame_noise_is_broadcast():
    noise = FrameNoise(0.1, 0.5).for_frames(3)
    np.testing.assert_allclose(noise.weight, 0.5 / 0.02)
    assert noise.weight.shape == (3,)


@pytest.mark.parametrize(
    ("make", "word"),
    [
        (lambda: FrameNoise(0, 1), "scale"),
        (lambda: FrameNoise(np.nan, 1), "scale"),
        (lambda: FrameNoise(0.1, 1.5), "fraction"),
        (lambda: FrameNoise(0.1, 0), "fraction"),
        (lambda: FrameNoise(np.full(2, 0.1), 1.0).for_frames(3), "scale"),
        (lambda: autocorrelation(np.zeros((1, 5, 5)), 5), "most"),
    ],
)
def test_frame_noise_is_checked(make, word):
    with pytest.raises(ValueError, match=word):
        make()
