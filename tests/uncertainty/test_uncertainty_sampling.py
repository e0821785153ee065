"""Sampling of frame times by emcee: known posteriors, seeds, files of draws, argument checks."""

import dataclasses

import emcee
import numpy as np
import pytest
import scipy.stats
from time_clips import parabolas

from foldgauss._runtime.optional_imports import import_optional
from foldgauss.uncertainty import (
    ExactPosterior,
    FrameNoise,
    LikelihoodProfiles,
    ProfileCurves,
    exact_posterior,
    frame_time_posterior,
)
from foldgauss.uncertainty.posterior import log_prob, moves

#: Two of the three are so near that their order constrains them.
NEAR = (0.3, 0.34, 0.7), (0.03, 0.05, 0.04)
#: A toy whose posterior is Gaussian: 0.08 apart at 10 standard deviations.
MANY = np.linspace(0, 1, 16)[1:-1], np.full(14, 0.006)


def toy(means, widths, nodes: int = 401) -> LikelihoodProfiles:
    return profiles_of(parabolas(means, widths, nodes))


def profiles_of(curves: ProfileCurves) -> LikelihoodProfiles:
    noise = FrameNoise(np.full(curves.num_frames, 0.02), np.ones(curves.num_frames))
    return LikelihoodProfiles(curves, noise, np.zeros(curves.num_frames), np.ones(3), 9)


def sampled(profiles, **settings):
    return frame_time_posterior(profiles, **{"steps": 6000, "ensembles": 2, **settings})


def worst_ks(found, cdfs) -> float:
    """The least p-value over frames, of draws thinned until they count as independent."""
    free = found.free
    flat = found.draws
    every = max(1, int(np.ceil(len(flat) / found.ess.min())))
    rng = np.random.default_rng(0)
    some = flat[rng.choice(len(flat), len(flat) // (2 * every), replace=False)]
    return min(scipy.stats.kstest(some[:, k], cdf).pvalue for k, cdf in zip(free, cdfs, strict=True))


def exact_cdfs(found):
    for edges, masses in zip(found.exact.edges, found.exact.masses, strict=True):
        summed = np.append(0, np.cumsum(masses))
        yield lambda t, edges=edges, summed=summed: np.interp(t, edges, summed)


def agrees(found, tolerance: float = 5.0) -> bool:
    """Means and standard deviations meet the exact ones, within so many Monte Carlo standard errors."""
    free, exact = found.free, found.exact
    error = exact.std()[free] / np.sqrt(found.ess)
    mean = np.abs(found.mean() - exact.mean())[free] / error
    std = np.abs(found.std() / np.where(exact.std() > 0, exact.std(), 1) - 1)[free] * np.sqrt(found.ess)
    return bool(mean.max() < tolerance and std.max() < tolerance)


@pytest.fixture(scope="module")
def near():
    return sampled(toy(*NEAR), steps=3000, ensembles=4)


def test_few_frames_sample_the_known_posterior(near):
    assert near.converged
    assert near.message.startswith("Converged")
    assert (near.r_hat < 1.01).all()
    assert (near.ess > 400).all()
    assert (near.tau >= 1).all()
    assert (near.acceptance > 0.5).all()
    assert near.acceptance.shape == (4,)
    assert agrees(near)
    np.testing.assert_allclose(near.interval(0.9), near.exact.interval(0.9), atol=0.15 * near.exact.std().max())
    assert worst_ks(near, exact_cdfs(near)) > 1e-3
    wide = toy(NEAR[0], np.array(NEAR[1]) * 1.2)
    wrong = dataclasses.replace(near, exact=exact_posterior(wide.curves))
    assert worst_ks(near, exact_cdfs(wrong)) < 1e-3


def test_wrong_prior_is_detected(monkeypatch):
    # One power of every increment too many in the density that a move of emcee samples, not in the exact posterior.
    monkeypatch.setattr(moves, "FrameSweep", lambda log_prob: emcee.moves.DEMove())
    prior = log_prob.log_prior
    wrong = lambda times, concentration: prior(times, concentration + 1)  # noqa: E731
    monkeypatch.setattr(log_prob, "log_prior", wrong)
    assert not agrees(sampled(toy(*NEAR), steps=2000))


def test_draws_keep_their_order_and_their_ends(near):
    assert (np.diff(near.times) > 0).all()
    assert (near.times[..., 0] == 0).all()
    assert (near.times[..., -1] == 1).all()
    assert near.draws.shape == (near.times[..., 0].size, 5)


@pytest.mark.parametrize("concentration", [pytest.param(1.0, marks=pytest.mark.slow), 3.0])
def test_sweeps_sample_the_known_posterior(concentration):
    found = sampled(toy((0.2, 0.25, 0.4, 0.42, 0.75), (0.03, 0.04, 0.03, 0.05, 0.06)), concentration=concentration)
    assert found.converged
    assert agrees(found)
    assert found.acceptance.min() > 0.6
    others = exact_posterior(found.log_prob.curves, concentration + 1)
    assert not agrees(dataclasses.replace(found, exact=others))


@pytest.mark.slow
def test_many_frames_sample_a_gaussian():
    found = sampled(toy(*MANY, nodes=2001), steps=20_000)
    assert found.converged
    assert agrees(found)
    np.testing.assert_allclose(found.mean()[1:-1], MANY[0], atol=5e-4)
    np.testing.assert_allclose(found.std()[1:-1], MANY[1], rtol=0.06)
    correlation = np.corrcoef(found.draws[:, 1:-1].T) - np.eye(14)
    assert np.abs(correlation).max() < 0.12
    assert worst_ks(found, [scipy.stats.norm(m, w).cdf for m, w in zip(*MANY, strict=True)]) > 1e-3


@pytest.fixture(scope="module")
def two_modes():
    """The second of three frames has two equal modes, 0.2 apart: the exact spread is 0.1, that of a mode 0.004."""
    nodes = np.linspace(0, 1, 401)

    def about(m, w):
        return -((nodes - m) ** 2) / (2 * w**2)

    two = np.maximum(np.logaddexp(about(0.4, 0.004), about(0.6, 0.004)), -2000)
    values = [about(0, 0.01), about(0.2, 0.01), two, about(0.8, 0.01), about(1, 0.01)]
    return profiles_of(ProfileCurves.from_nodes([nodes] * 5, values))


def test_few_frames_change_modes(two_modes):
    found = sampled(two_modes)
    assert found.converged
    assert agrees(found)
    assert (found.draws[:, 2] > 0.5).mean() == pytest.approx(0.5, abs=0.03)
    assert found.std()[2] == pytest.approx(found.exact.std()[2], rel=0.02)


def test_ensembles_that_all_miss_a_mode_have_not_converged(two_modes, monkeypatch):
    # Started at one mode, emcee's moves stay there: tau and R-hat do not detect the other one.
    monkeypatch.setattr(moves, "FrameSweep", lambda log_prob: emcee.moves.DEMove())
    draws = exact_posterior(two_modes.curves).sample(400)
    monkeypatch.setattr(ExactPosterior, "sample", lambda self, num, seed: draws[draws[:, 2] < 0.5][:num])
    found = sampled(two_modes, steps=1500)
    assert (found.r_hat < 1.01).all()
    assert found.std()[2] < 0.005
    assert not found.converged
    assert "emcee and the exact posterior disagree at frame 2" in found.message


def test_message_counts_identified_frames():
    found = sampled(toy((0.2, 0.5, 0.8), (0.02, 5.0, 0.02)))
    assert found.converged
    assert found.identified().sum() == 4
    assert found.message.endswith(" 2 of 3 frame times are identified.")


def test_a_single_frame_between_the_first_and_the_last():
    found = sampled(toy([0.5], [0.2 / 3]))
    assert found.converged
    assert agrees(found)
    np.testing.assert_array_equal(found.free, [1])


def test_seeds_reproduce_to_the_bit():
    one, again, other = (sampled(toy(*NEAR), steps=100, ensembles=4, seed=seed) for seed in (3, 3, 4))
    np.testing.assert_array_equal(one.times, again.times)
    assert not np.array_equal(one.times[0, -1], other.times[0, -1])
    assert len({each.tobytes() for each in one.times}) == 4


def test_too_few_steps_are_reported():
    found = sampled(toy(*NEAR), steps=200)
    assert not found.converged
    assert found.message.startswith("Not converged after 200 steps")
    assert "autocorrelation times" in found.message


def test_resumed_run_equals_an_uninterrupted_one(tmp_path):
    profiles, settings = toy(*NEAR), {"steps": 600, "seed": 5}
    whole = sampled(profiles, **settings)
    sampled(profiles, **{**settings, "steps": 300}, backend=tmp_path / "run.h5")
    for _ in range(2):
        found = sampled(profiles, **settings, backend=tmp_path / "run.h5")
        np.testing.assert_array_equal(found.times, whole.times)
    assert [path.name for path in tmp_path.iterdir()] == ["run.h5"]
    assert emcee.backends.HDFBackend(str(tmp_path / "run.h5"), name="ensemble_1").get_chain().shape == (60, 32, 3)


def test_interrupted_run_goes_on(tmp_path):
    def interrupt(done, total):
        if done == 300:
            raise KeyboardInterrupt

    profiles, settings = toy(*NEAR), {"steps": 600, "backend": tmp_path / "run.h5"}
    with pytest.raises(KeyboardInterrupt):
        sampled(profiles, **settings, on_progress=interrupt)
    np.testing.assert_array_equal(sampled(profiles, **settings).times, sampled(profiles, steps=600).times)


def test_file_of_another_run_is_refused(tmp_path):
    path = tmp_path / "run.h5"
    sampled(toy(*NEAR), steps=100, backend=path)
    before = path.read_bytes()
    changes = {"seed": 1}, {"profiles": toy(NEAR[0], (0.03, 0.05, 0.041))}, {"ensembles": 3}, {"concentration": 2.0}
    for change in changes:
        with pytest.raises(ValueError, match="of another run"):
            sampled(**{"profiles": toy(*NEAR), "steps": 100, "backend": path, **change})
    assert path.read_bytes() == before
    (tmp_path / "text.h5").write_text("no such file")
    with pytest.raises(ValueError, match=r"backend: expected a file of draws, or none yet, got .*damaged"):
        sampled(toy(*NEAR), steps=100, backend=tmp_path / "text.h5")
    assert (tmp_path / "text.h5").read_text() == "no such file"


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"ensembles": 1}, "ensembles"),
        ({"steps": 5}, "steps"),
        *[({name: value}, name) for name in ("ensembles", "steps", "seed") for value in (32.0, "9", np.nan)],
        ({"seed": -1}, "seed"),
        ({"profiles": 3}, "profiles"),
        ({"concentration": 0.5}, "concentration"),
        ({"backend": "none/run.h5"}, "backend"),
        ({"backend": "."}, "backend"),
    ],
)
def test_what_is_refused(change, word):
    with pytest.raises(ValueError, match=f"^{word}"):
        frame_time_posterior(**{"profiles": toy(*NEAR), **change})


@pytest.mark.parametrize("level", [0, 1, 2, "a", np.nan])
def test_levels_of_intervals(near, level):
    with pytest.raises(ValueError, match="level"):
        near.interval(level)


def test_statistics_of_many_frames_use_all_draws():
    shape = 2, 3, 4, 150
    times = np.sort(np.random.default_rng(0).random(shape))
    flat = times.reshape(-1, 150)
    found = dataclasses.replace(sampled(toy(*NEAR), steps=10, ensembles=2), times=times)
    np.testing.assert_allclose(found.mean(), flat.mean(0), rtol=1e-12)
    np.testing.assert_allclose(found.std(), flat.std(0), rtol=1e-12)
    np.testing.assert_allclose(found.interval(0.5), np.quantile(flat, [0.25, 0.75], axis=0), rtol=1e-12)


def test_progress_is_reported():
    told = []
    sampled(toy(*NEAR), steps=20, on_progress=lambda *each: told.append(each))
    assert told == [(10, 40), (20, 40), (30, 40), (40, 40)]


@pytest.fixture(scope="module")
def small():
    return sampled(toy(*NEAR), steps=100, ensembles=2)


def test_arviz_has_all_draws(small):
    """A chain per walker, whose draws are the steps; the ensemble of each is a coordinate."""
    data = small.to_arviz()
    ensembles, steps, walkers, frames = small.times.shape
    assert data.posterior["t"].shape == (ensembles * walkers, steps, frames)
    assert data.posterior["w"].shape == (ensembles * walkers, steps, frames - 1)
    np.testing.assert_allclose(data.posterior["w"].mean("interval"), 0, atol=1e-10)
    assert data.sample_stats["lp"].shape == (ensembles * walkers, steps)
    np.testing.assert_array_equal(data.posterior["t"].values[walkers + 3], small.times[1, :, 3])
    np.testing.assert_array_equal(data.posterior["ensemble"].values, np.repeat([0, 1], walkers))
    assert data.attrs["message"] == small.message


def test_arviz_before_and_after_1_0_have_the_same_groups(small, monkeypatch):
    arviz = import_optional("arviz", "uncertainty")
    if not arviz.__version__.startswith("0."):
        pytest.skip("ArviZ has no InferenceData any more")
    before = small.to_arviz()
    monkeypatch.setattr(arviz, "__version__", "1.0.0")
    after = small.to_arviz()
    assert type(after).__name__ == "DataTree"
    assert after.attrs == before.attrs
    for group in ("posterior", "sample_stats"):
        assert after[group].to_dataset().identical(before[group])


#: Autoregressive walkers: their number and that of their steps, and the correlation of neighboring steps.
AR_WALKERS, AR_STEPS, AR_CORRELATION = 20, 2000, 0.9


def autoregressive(num: int, rng: np.random.Generator) -> np.ndarray:
    """Stationary AR(1) chains of standard deviation 1: (num, AR_STEPS)."""
    chains = rng.normal(size=(AR_STEPS, num))
    for k in range(1, AR_STEPS):
        chains[k] = AR_CORRELATION * chains[k - 1] + np.sqrt(1 - AR_CORRELATION**2) * chains[k]
    return chains.T


def test_arviz_statistics_of_known_chains(small):
    """ESS within 10% of that of AR(1) chains, n (1 - r) / (1 + r); R-hat 1, and the standard error of the mean.

    With the walkers of an ensemble within one chain, as they once were, the ESS would be more than five times too high.
    """
    arviz, rng = import_optional("arviz", "uncertainty"), np.random.default_rng(0)
    times, spread = np.repeat(np.array([0, 0.3, 0.5, 0.7, 1])[None, None, None], AR_STEPS, 1), 0.01
    times = np.repeat(np.repeat(times, AR_WALKERS, 2), 2, 0)
    for frame in (1, 2, 3):
        chains = autoregressive(2 * AR_WALKERS, rng).reshape(2, AR_WALKERS, AR_STEPS)
        times[..., frame] += spread * np.moveaxis(chains, 1, 2)
    drawn = dataclasses.replace(small, times=times).to_arviz()["posterior"]["t"].isel(frame=slice(1, 4)).to_dataset()
    truth = 2 * AR_WALKERS * AR_STEPS * (1 - AR_CORRELATION) / (1 + AR_CORRELATION)
    np.testing.assert_allclose(arviz.ess(drawn)["t"], truth, rtol=0.1)
    np.testing.assert_allclose(arviz.rhat(drawn)["t"], 1, atol=0.01)
    np.testing.assert_allclose(arviz.mcse(drawn)["t"], spread / np.sqrt(truth), rtol=0.1)
    interleaved = {"t": times.reshape(2, AR_STEPS * AR_WALKERS, 5)[..., 1:4]}
    assert (arviz.ess(arviz.convert_to_dataset(interleaved))["t"].values > 5 * truth).all()
