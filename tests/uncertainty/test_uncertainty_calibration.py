"""Simulation-based calibration: correct posteriors have uniform ranks, and wrong ones are detected."""

import dataclasses

import numpy as np
import pytest
from time_clips import SCALE, model, white

from benchmarks._calibration import ecdf_band, simulated_ranks
from foldgauss.uncertainty import FrameNoise, Increments

REPLICATES, FRAMES = 300, 6
#: Each run checks some six quantities against 99% envelopes with a fixed seed: 1 in 20 correct runs would fail.


def ranks(**settings):
    settings = {"num_frames": FRAMES, "replicates": REPLICATES, **settings}
    return simulated_ranks(model(), white(), **settings)


slow = pytest.mark.slow
TOO_LOUD = FrameNoise(SCALE * 1.5, 1.0)


#: The envelopes are those of so many replicates: fewer fail as seldom where all is right.
FEW = 120


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
@pytest.mark.timeout(1800)
@pytest.mark.parametrize(
    ("settings", "calibrated"),
    [
        ({"assumed_noise": "score"}, True),
        ({"sampler": "emcee", "num_frames": 5}, True),
        (
            {"sampler": "emcee", "num_frames": 5, "replicates": 100, "assumed_noise": FrameNoise(SCALE * 1.5, 1.0)},
            False,
        ),
    ],
)
def test_estimated_noise_and_draws_of_emcee_are_calibrated(settings, calibrated):
    assert ranks(**settings).inside(0.99).all() == calibrated


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
    right = Increments.draw_prior

    def wrong(self, rng, num):
        return right(Increments(self.held, None, 4 * self.concentration), rng, num)

    monkeypatch.setattr(Increments, "draw_prior", wrong)
    settings = {"num_frames": 4, "replicates": REPLICATES}
    assert not simulated_ranks(model(), white(4.0), **settings).inside(0.99).all()
    monkeypatch.undo()
    assert simulated_ranks(model(), white(4.0), **settings).inside(0.99).all()


def test_seeds_reproduce_and_replicates_do_not_depend_on_how_many():
    one, more = (ranks(replicates=num, seed=7) for num in (5, 8))
    np.testing.assert_array_equal(one.ranks, more.ranks[:5])
    np.testing.assert_array_equal(one.true, more.true[:5])
    assert (ranks(replicates=5, seed=8).ranks != one.ranks).any()


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
