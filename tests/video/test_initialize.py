"""The starts of a fit: along edges, in order of time."""

import numpy as np
import pytest
from clips import moving_blobs

from foldgauss._runtime import threads
from foldgauss.envelope import TimeLikelihood
from foldgauss.video.fitting import initialize as start_module
from foldgauss.video.fitting.config import (
    ALIVE_POWER,
    LIFETIME_POWER,
    MOST_PER_PIXEL,
    FitConfig,
    default_num_gaussians,
)
from foldgauss.video.fitting.initialize import ELONGATION, count_alive, initialize, sample_orientations
from foldgauss.video.motion.optical_flow import Motion


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


def test_tracks_are_followed_alike_by_any_number_of_threads(monkeypatch):
    monkeypatch.setattr(start_module, "CHUNK", 40)
    monkeypatch.setattr(start_module, "AT_ONCE", 120)
    rng = np.random.default_rng(0)
    motion, home, position = Motion.from_frames(moving_blobs()), rng.integers(0, 6, 300), rng.uniform(4, 28, (300, 2))
    found = []
    for count in (1, 3):
        threads.set_num_threads(count)
        try:
            found.append(start_module.follow_tracks(motion, home, position, 3, np.random.default_rng(1)))
        finally:
            threads.set_num_threads(None)
    for own, other in zip(*found, strict=True):
        np.testing.assert_array_equal(own, other)
    assert np.abs(found[0][0]).max() > 0


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


def test_number_follows_from_the_lifetime():
    """A function of the mean lifetime in frames is given that of the starts."""
    frames, lifetimes = moving_blobs(), []

    def choose(lifetime):
        lifetimes.append(lifetime)
        return 2000

    splats = initialize(frames, choose, degree=1, envelope=TimeLikelihood(power=np.float32(1)), seed=0)
    times, spread = np.linspace(0, 1, len(frames)), np.exp(splats.log_time_scale)
    alive = count_alive(1 / (1 + np.exp(-splats.time_loc_logit)), spread, times)
    assert splats.num_gaussians == 2000
    assert lifetimes == [pytest.approx(alive.sum() / 2000, rel=0.15)]


def test_longer_lifetimes_mean_fewer_gaussians():
    """By a power of it; where they live throughout, by a limit of those alive, which grows with the time to an end."""
    size = 132, 160, 320
    number = [default_num_gaussians(FitConfig(minutes=1.0), *size, lifetime=life, threads=2) for life in (8.0, 32.0)]
    assert number[0] == pytest.approx(4**-LIFETIME_POWER * number[1], rel=1e-4)
    alive = [default_num_gaussians(FitConfig(minutes=m), *size, lifetime=132.0, threads=2) for m in (0.25, 1.0, 99.0)]
    assert alive[1] == pytest.approx(4**ALIVE_POWER * alive[0], rel=1e-4)
    assert alive[2] == pytest.approx(MOST_PER_PIXEL * 160 * 320, rel=1e-4)
