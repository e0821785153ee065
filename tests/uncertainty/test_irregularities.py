"""Duplicated and dropped frames are found without false positives; models are compared under one noise."""

import dataclasses

import numpy as np
import pytest
from synthetic_posteriors import posterior_about
from time_clips import rendered_log_likelihood
from tiny_clips import NUM_FRAMES, TWICE, clip_of, model_of_12

from foldgauss.uncertainty import (
    FrameNoise,
    exact_posterior,
    increment_intervals,
    irregularities,
    likelihood_profiles,
)
from foldgauss.uncertainty.diagnostics.irregularities import even_times
from foldgauss.video import FrameTimes, VideoModel


def times_of(steps):
    times = np.concatenate([[0.0], np.cumsum(steps)])
    return times / times[-1]


def kinds(found):
    return [(one.frames[0], one.kind) for one in found]


def test_duplicates_and_gaps_are_found():
    steps = np.ones(30)
    steps[[6, 20]], steps[12] = 0.01, 2.0
    found = irregularities(posterior_about(times_of(steps)))
    assert kinds(found) == [(6, "duplicated"), (12, "dropped"), (20, "duplicated")]
    assert all(one.probability > 0.99 for one in found)
    assert found[0].frames == (6, 7)
    assert 0 < found[0].low < found[0].size < found[0].high < 0.25
    assert found[1].low < 2.0 < found[1].high


@pytest.mark.parametrize(
    "steps",
    [
        np.linspace(0.4, 2.5, 30),  # six times as fast at the end
        1 + 0.7 * np.sin(np.linspace(0, 3 * np.pi, 40)),
        [1.0] * 12 + [40.0] + [1.0] * 12,  # a cut
        np.random.default_rng(0).uniform(0.7, 1.3, 30),
    ],
)
def test_smooth_rates_and_cuts_are_not_flagged(steps):
    assert irregularities(posterior_about(times_of(np.asarray(steps)))) == []


def test_local_median_ends_at_cuts():
    """After the cut the clip is three times slower, which is regular; a duplicate right after the cut is found."""
    steps = np.concatenate([np.ones(14), [40.0], np.full(14, 1 / 3)])
    steps[17] = 0.005
    assert kinds(irregularities(posterior_about(times_of(steps), 0.002))) == [(17, "duplicated")]


def test_flat_likelihoods_give_no_irregularities():
    """Under the prior alone increments are exponential: short and long ones, none of them with high probability."""
    posterior = posterior_about(np.linspace(0, 1, 25), 50.0)
    assert irregularities(posterior) == []
    assert not posterior.identified()[1:-1].any()
    assert irregularities(posterior, probability=0.05) == []  # they are not assessed


def test_a_long_step_beside_a_duplicate_is_explained():
    from foldgauss.uncertainty import summary

    steps = np.ones(20)
    steps[[8, 9]] = 0.01, 2.0
    assert "A long step beside a duplicated frame" in summary(posterior_about(times_of(steps)))
    steps[[9, 14]] = 1.0, 2.0
    assert "A long step" not in summary(posterior_about(times_of(steps)))


def test_intervals_cover():
    """Over 5 clips of 29 intervals, 90% intervals contain the truth with frequency 90%, within 4 standard errors.

    Intervals of 60% would not pass for them.
    """
    rng, wide, narrow = np.random.default_rng(3), [], []
    for n in range(5):
        steps = rng.uniform(0.7, 1.3, 29)
        truth = times_of(steps)
        posterior = posterior_about(truth + np.r_[0, 0.1 * rng.standard_normal(28), 0] / 29, 0.1, seed=n)
        steps = steps / np.median(steps)
        for level, inside in ((0.9, wide), (0.6, narrow)):
            found = increment_intervals(posterior, level)
            inside.append((found.low <= steps) & (steps <= found.high))
    assert 0.8 < np.mean(wide) < 1.0
    assert np.mean(narrow) < 0.75
    assert found.mean.shape == (29,)


@pytest.mark.parametrize(
    ("setting", "value"),
    [
        ("duplicate", 0),
        ("duplicate", 1.0),
        ("dropped", 1.0),
        ("dropped", np.nan),
        ("probability", 0),
    ],
)
def test_settings_out_of_range(setting, value):
    posterior = posterior_about(np.linspace(0, 1, 6))
    with pytest.raises(ValueError, match=rf"^{setting}: expected"):
        irregularities(posterior, **{setting: value})
    with pytest.raises(ValueError, match=r"^level: expected"):
        increment_intervals(posterior, 1.0)


def test_models_are_compared_under_one_noise():
    """One model with even times, one with those of the clip: the same splats, so only their own times differ."""
    even, clip = model_of_12(), clip_of(model_of_12())
    truth = np.linspace(0, 1, NUM_FRAMES)
    truth[TWICE + 1] = truth[TWICE] + 1e-4
    learned = VideoModel(
        even.splats, FrameTimes(np.log(np.diff(truth)).astype(np.float32)), even.size, even.fps, even.options
    )
    noise = FrameNoise(4 / 255, 1.0)
    profiles = [likelihood_profiles(one, clip, noise=noise) for one in (even, learned)]
    at_even, at_truth = (profiles[0].curves(each).sum() for each in (np.linspace(0, 1, NUM_FRAMES), truth))
    assert at_truth > at_even + 100
    one, other = (each.log_likelihood.sum() + exact_posterior(each.curves).log_evidence for each in profiles)
    assert one == pytest.approx(other, abs=0.5)
    # The evidence is an average of likelihoods: below the maximum, here about that of the truth.
    best = rendered_log_likelihood(even, clip, truth, noise).sum()
    assert best - 80 < one < best + 5


def test_summary_names_frames_that_are_not_identified():
    from foldgauss.uncertainty import frame_table, summary

    times, std = np.linspace(0, 1, 12), np.full(12, 0.02)
    std[5] = 40.0
    posterior = posterior_about(times, std)
    text = summary(posterior, times)
    assert "Not identified: frame 5.**" in text
    assert "None of 9 intervals shows a duplicated or dropped frame" in text
    assert "2 others were not assessed" in text
    assert "20" not in text.split("gray")[0].rsplit("residuals", 1)[1]
    unsure = dataclasses.replace(posterior, converged=False, message="Not converged after 9 steps.")
    assert summary(unsure).startswith("Not converged")
    table = frame_table(posterior, times)
    assert {len(column) for column in table.values()} == {12}
    np.testing.assert_allclose(table["exact_mean"], table["mean"], atol=5e-3)
    assert np.isnan(table["r_hat"][[0, 11]]).all()
    with pytest.raises(ValueError, match="fitted: expected 12 times"):
        frame_table(posterior, times[:3])


def test_even_times_within_shots():
    even, unit = even_times(posterior_about(np.linspace(0, 1, 9)))
    np.testing.assert_allclose(even, np.linspace(0, 1, 9), atol=2e-2 / 8)
    assert unit == pytest.approx(1 / 8)
    steps = np.concatenate([np.ones(5), [40.0], np.full(4, 2.0)])
    even, unit = even_times(posterior_about(times_of(steps), 0.002))
    np.testing.assert_allclose(np.diff(even), steps / steps.sum(), rtol=1e-2)
    assert unit == pytest.approx(13 / 9 / steps.sum(), rel=1e-2)


def test_summary_includes_notes_of_the_profiles():
    from foldgauss.uncertainty import summary

    posterior = posterior_about(np.linspace(0, 1, 12))
    noted = dataclasses.replace(posterior.profiles, notes=("It is late.",))
    text = summary(dataclasses.replace(posterior, profiles=noted))
    assert "**Note:** It is late." in text
    assert len(repr(posterior)) < 200
