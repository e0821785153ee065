"""Simulation-based calibration: correct posteriors have uniform ranks, and wrong ones are detected."""

import dataclasses

import numpy as np
import pytest
import scipy.stats
from time_clips import SCALE, model, white

from benchmarks import _calibration
from benchmarks._calibration import SimulatedRanks, ecdf_band, simulated_ranks
from foldgauss.uncertainty import FrameNoise

REPLICATES, FRAMES = 300, 6
#: Each run checks some six quantities against 99% envelopes with a fixed seed: 1 in 20 correct runs would fail.


def ranks(**settings):
    settings = {"num_frames": FRAMES, "replicates": REPLICATES, **settings}
    return simulated_ranks(model(), white(), **settings)


slow = pytest.mark.slow


#: The envelopes are those of so many replicates: fewer fail as seldom where all is right.
FEW = 80


@pytest.mark.timeout(900)
@pytest.mark.parametrize(
    ("concentration", "replicates"), [(1.0, 80), *[pytest.param(a, REPLICATES, marks=slow) for a in (1.0, 3.0)]]
)
def test_exact_posterior_is_calibrated(concentration, replicates):
    found = ranks(concentration=concentration, replicates=replicates)
    assert found.inside(0.99).all()
    assert found.converged == 1
    assert found.ranks.shape == (replicates, FRAMES)
    assert found.names[-2:] == ["any frame", "log-likelihood"]
    for level in (0.5, 0.9):
        # All frames of a replicate count as two independent ones.
        error = np.sqrt(level * (1 - level) / (replicates * 2))
        assert abs(found.coverage(level)[:-2].mean() - level) < 3.3 * error


@pytest.mark.parametrize(
    ("factor", "replicates"), [(1.5, FEW), *[pytest.param(f, REPLICATES, marks=slow) for f in (1.5, 1 / 1.5)]]
)
def test_wrong_noise_level_is_detected(factor, replicates):
    found = ranks(assumed_noise=FrameNoise(SCALE * factor, 1.0), replicates=replicates)
    assert not found.inside(0.99)[-2:].any()
    too_wide = found.coverage(0.9)[-2] > 0.95
    assert too_wide == (factor > 1)


@slow
def test_estimated_noise_is_calibrated():
    assert ranks(assumed_noise="score").inside(0.99).all()


@slow
def test_ranks_through_frames_of_eight_bits():
    """The frames of a video: rounded, clipped, and compared as those are.

    Seeds 2 to 4 were fixed before they were run. Noise that is clipped at black shifts frames 1 and 4 by 0.07 of their
    standard deviations; 3,000 replicates show it, 900 rarely do.
    """
    parts = [ranks(eight_bits=True, seed=seed) for seed in (2, 3, 4)]
    found = dataclasses.replace(parts[0], ranks=np.concatenate([part.ranks for part in parts]))
    assert found.inside(0.99).all()
    error = np.sqrt(0.25 / (3 * REPLICATES * 2))
    assert abs(found.coverage(0.5)[:-2].mean() - 0.5) < 3.3 * error


@slow
def test_correlated_noise_needs_tempering():
    plain, fair = (ranks(assumed_noise=kind, correlation=1.0) for kind in ("independent", "score"))
    assert not plain.inside(0.99).any()
    assert plain.coverage(0.9)[-2] < 0.6
    assert fair.inside(0.99)[:-1].all()
    assert fair.coverage(0.9)[-2] > 0.85


@slow
def test_wrong_prior_is_detected(monkeypatch):
    right = _calibration.draw_times
    wrong = lambda num_frames, concentration, rng: right(num_frames, 4 * concentration, rng)  # noqa: E731
    monkeypatch.setattr(_calibration, "draw_times", wrong)
    settings = {"num_frames": 4, "replicates": REPLICATES}
    assert not simulated_ranks(model(), white(4.0), **settings).inside(0.99).all()
    monkeypatch.undo()
    assert simulated_ranks(model(), white(4.0), **settings).inside(0.99).all()


@slow
@pytest.mark.timeout(1800)
def test_emcee_is_calibrated():
    found = ranks(sampler="emcee", num_frames=5)
    assert found.inside(0.99).all()


@slow
def test_wrong_noise_level_is_detected_with_emcee():
    found = ranks(sampler="emcee", num_frames=5, replicates=100, assumed_noise=FrameNoise(SCALE * 1.5, 1.0))
    assert not found.inside(0.99).all()


def test_seeds_reproduce_and_replicates_do_not_depend_on_how_many():
    one, more = (ranks(replicates=num, seed=7) for num in (5, 8))
    np.testing.assert_array_equal(one.ranks, more.ranks[:5])
    np.testing.assert_array_equal(one.true, more.true[:5])
    assert (ranks(replicates=5, seed=8).ranks != one.ranks).any()


def test_emcee_draws_are_ranked_too():
    found = ranks(sampler="emcee", num_frames=3, replicates=2, draws=19, steps=500)
    assert found.num_ranks == 20
    assert ((found.ranks >= 0) & (found.ranks < 20)).all()


@pytest.mark.parametrize("level", [0.8, 0.99])
def test_envelope_has_its_level(level):
    low, high = ecdf_band(50, 20, level)
    assert low.shape == (20,)
    assert (low <= high).all()
    assert low[-1] == high[-1] == 1
    found = np.random.default_rng(1).integers(0, 20, (4000, 50))
    shares = (found[:, :, None] < np.arange(1, 21)).mean(1)
    inside = ((shares >= low - 1e-12) & (shares <= high + 1e-12)).all(1).mean()
    # Counts are integers: never less than the level, and slightly more.
    assert level - 0.02 < inside < level + 0.05


def test_the_envelope_is_pointwise_binomial():
    low, high = ecdf_band(200, 2, 0.95)
    expected = scipy.stats.binom.interval(0.95, 200, 0.5)
    np.testing.assert_allclose([low[0] * 200, high[0] * 200], expected, atol=1)


def test_coverage_counts_central_ranks():
    every = SimulatedRanks(np.arange(100)[:, None], 100, [], np.zeros(0), 1.0)
    for level in (0.5, 0.9, 0.98):
        assert every.coverage(level)[0] == pytest.approx(level)
