"""The starts of a fit: along edges, in order of time."""

import math

import numpy as np
import pytest
from clips import moving_blobs

from foldgauss.envelope import TimeLikelihood
from foldgauss.video import Economy
from foldgauss.video.fitting.config import FitConfig, most_alive
from foldgauss.video.fitting.initialize import ELONGATION, count_alive, initialize, sample_orientations


def stripes(angle: float, size: tuple[int, int] = (40, 60)) -> np.ndarray:
    """Stripes along the direction `angle`, x right and y down, as a clip of one frame."""
    y, x = np.mgrid[: size[0], : size[1]]
    wave = 127 + 100 * np.sin(0.8 * (np.cos(angle) * y - np.sin(angle) * x))
    return np.repeat(wave[None, ..., None], 3, axis=-1).astype(np.uint8)


@pytest.mark.parametrize("angle", [0.0, 0.4, 1.2, 2.5])
def test_edges_have_their_direction(angle):
    position = np.random.default_rng(0).uniform([8, 8], [52, 32], (20, 2))
    found, straight = sample_orientations(stripes(angle), np.zeros(20, int), position)
    np.testing.assert_allclose(np.sin(found - angle), 0, atol=0.05)
    assert (found >= np.pi / 2 - 1e-6).all()  # far from the ends of the sigmoid
    assert (found <= 3 * np.pi / 2 + 1e-6).all()
    assert (straight > 0.99).all()


def test_flat_frames_have_no_edges():
    found, straight = sample_orientations(
        np.full((1, 20, 30, 3), 90, np.uint8), np.zeros(5, int), np.full((5, 2), 10.0)
    )
    assert (straight == 0).all()
    assert np.isfinite(found).all()


def test_starts_are_elongated_along_edges():
    """Their covariance has its longer axis along the stripes; their area is that of round ones."""
    angle = 0.4
    splats = initialize(stripes(angle), 300, degree=1, envelope=TimeLikelihood(power=np.float32(1)), seed=0)
    factor = np.asarray(splats.gaussians().scale_tril)
    covariance = factor @ factor.transpose(0, 2, 1)
    values, axes = np.linalg.eigh(covariance)
    direction = np.array([np.cos(angle), np.sin(angle)])
    along = np.abs(axes[:, :, 1] @ direction)
    assert np.median(along) > 0.98
    np.testing.assert_allclose(np.median(np.sqrt(values[:, 1] / values[:, 0])), np.exp(2 * ELONGATION), rtol=0.1)


def test_gaussians_are_in_order_of_time():
    """So that those alive at a time lie side by side in memory."""
    splats = initialize(moving_blobs(), 500, degree=1, envelope=TimeLikelihood(power=np.float32(1)), seed=0)
    home = np.round(5 / (1 + np.exp(-splats.time_loc_logit.astype(float))))
    assert (np.diff(home) >= 0).all()


def test_fewer_start_where_more_would_be_alive_at_once():
    """The limit holds for the mean over frames; without it, or above what is alive, the number is what is asked for."""
    frames = moving_blobs()
    envelope = TimeLikelihood(power=np.float32(1))
    for most in (40.0, 150.0):
        splats = initialize(frames, 5000, degree=1, envelope=envelope, seed=0, most_alive=most)
        times, spread = np.linspace(0, 1, len(frames)), np.exp(splats.log_time_scale)
        alive = count_alive(1 / (1 + np.exp(-splats.time_loc_logit)), spread, times)
        assert alive.mean() == pytest.approx(most, rel=0.15)
    assert initialize(frames, 300, degree=1, envelope=envelope, seed=0, most_alive=1e4).num_gaussians == 300
    assert initialize(frames, 300, degree=1, envelope=envelope, seed=0, most_alive=1e-9).num_gaussians == 1


def test_minutes_limit_how_many_are_alive():
    """Only where they choose the number: more time, more alive; half the threads are worth half the minutes."""
    size = 132, 160, 320
    least, most = (most_alive(FitConfig(minutes=m), *size, threads=2) for m in (1.0, 10.0))
    assert 0 < least < most < math.inf
    assert most_alive(FitConfig(minutes=10.0), *size, threads=1) == most_alive(FitConfig(minutes=5.0), *size, threads=2)
    for config in (FitConfig(), FitConfig(minutes=1.0, num_gaussians=9), FitConfig(minutes=1.0, economy=Economy())):
        assert most_alive(config, *size) == math.inf
