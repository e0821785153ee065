"""Sampling of frame times by emcee: known posteriors, seeds, files of draws, argument checks."""

import dataclasses
import subprocess
import sys
import tracemalloc

import emcee
import numpy as np
import pytest
import scipy.stats
from time_clips import clip, free_times, model, parabolas, uneven, white

from foldgauss.uncertainty import (
    FrameNoise,
    FrameTimeLogProb,
    Increments,
    LikelihoodProfiles,
    ProfileCurves,
    exact_posterior,
    frame_time_log_prob,
    frame_time_posterior,
    rendered_log_likelihood,
)
from foldgauss.uncertainty.posterior.laplace import laplace_approximation
from foldgauss.uncertainty.posterior.moves import BlockSweep
from foldgauss.uncertainty.posterior.optional_imports import import_optional
from foldgauss.video.editing.edited_video import EditedVideo, Layer

#: Two of the three are so near that their order constrains them.
NEAR = (0.3, 0.34, 0.7), (0.03, 0.05, 0.04)
#: A toy whose posterior is Gaussian: 0.08 apart at 10 standard deviations.
MANY = np.linspace(0, 1, 16)[1:-1], np.full(14, 0.006)


def toy(means, widths, concentration: float = 1.0, nodes: int = 401) -> FrameTimeLogProb:
    return FrameTimeLogProb(parabolas(means, widths, nodes), free_times(len(means) + 2, concentration))


def sampled(log_prob, **settings):
    return frame_time_posterior(log_prob=log_prob, progress=False, **{"steps": 6000, "ensembles": 2, **settings})


def worst_ks(found, cdfs) -> float:
    """The least p-value over frames, of draws thinned until they count as independent."""
    free = found.free
    flat = found.draws
    every = max(1, int(np.ceil(len(flat) / found.ess.min())))
    rng = np.random.default_rng(0)
    some = flat[rng.choice(len(flat), len(flat) // (2 * every), replace=False)]
    return min(scipy.stats.kstest(some[:, k], cdf).pvalue for k, cdf in zip(free, cdfs, strict=True))


def exact_cdfs(found):
    for grid, density in zip(found.exact.grids, found.exact.densities, strict=True):
        steps = np.concatenate([[0], np.cumsum((density[1:] + density[:-1]) / 2 * np.diff(grid))])
        yield lambda t, grid=grid, steps=steps: np.interp(t, grid, steps)


def agrees(found, tolerance: float = 5.0) -> bool:
    """Means and standard deviations meet the exact ones, within so many Monte Carlo standard errors."""
    free, exact = found.free, found.exact
    error = exact.std()[free] / np.sqrt(found.ess)
    mean = np.abs(found.mean() - exact.mean())[free] / error
    std = np.abs(found.std() / np.where(exact.std() > 0, exact.std(), 1) - 1)[free] * np.sqrt(found.ess)
    return bool(mean.max() < tolerance and std.max() < tolerance)


@pytest.fixture(scope="module")
def near():
    return sampled(toy(*NEAR), ensembles=4)


def test_few_frames_sample_the_known_posterior(near):
    assert near.converged
    assert near.message.startswith("Converged")
    assert (near.r_hat < 1.01).all()
    assert (near.ess > 400).all()
    assert (near.tau >= 1).all()
    assert ((near.acceptance > 0.1) & (near.acceptance < 0.9)).all()
    assert near.acceptance.shape == (4,)
    assert agrees(near)
    np.testing.assert_allclose(near.interval(0.9), near.exact.interval(0.9), atol=0.15 * near.exact.std().max())
    assert worst_ks(near, exact_cdfs(near)) > 1e-3
    wide = toy(NEAR[0], np.array(NEAR[1]) * 1.2)
    assert (
        worst_ks(near, exact_cdfs(dataclasses.replace(near, exact=exact_posterior(wide.curves, wide.increments))))
        < 1e-3
    )


def test_wrong_jacobian_is_detected(monkeypatch):
    # One power of every increment too many in the density that emcee samples, not in the exact posterior.
    right = Increments.log_prior

    def wrong(self, coordinates):
        return right(Increments(self.held, self.free, self.concentration + 1), coordinates)

    monkeypatch.setattr(Increments, "log_prior", wrong)
    assert not agrees(sampled(toy(*NEAR)))


def test_draws_keep_their_order_and_their_ends(near):
    assert (np.diff(near.times) > 0).all()
    assert (near.times[..., 0] == 0).all()
    assert (near.times[..., -1] == 1).all()
    np.testing.assert_allclose(near.logits.mean(-1), 0, atol=1e-10)
    assert near.draws.shape == (near.times[..., 0].size, 5)


@pytest.mark.parametrize("concentration", [0.5, pytest.param(3.0, marks=pytest.mark.slow)])
def test_block_sweeps_sample_the_known_posterior(concentration):
    log_prob = toy((0.2, 0.25, 0.4, 0.42, 0.75), (0.03, 0.04, 0.03, 0.05, 0.06), concentration)
    found = sampled(log_prob, moves=BlockSweep(log_prob, block=2), walkers=16)
    assert found.converged
    assert agrees(found)


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


def test_both_modes_are_reached():
    # Two modes of the middle frame, 12 standard deviations apart, of equal mass.
    nodes = np.linspace(0, 1, 401)
    modes = np.logaddexp(-((nodes - 0.4) ** 2) / (2 * 0.015**2), -((nodes - 0.58) ** 2) / (2 * 0.015**2))
    flat = np.zeros_like(nodes)
    log_prob = FrameTimeLogProb(ProfileCurves.from_nodes([nodes] * 3, [flat, modes, flat]), free_times(3))
    found = sampled(log_prob, moves=BlockSweep(log_prob), walkers=16)
    left = (found.draws[:, 1] < 0.5).mean()
    if found.converged:
        assert left == pytest.approx(0.5, abs=0.1)
    else:
        assert found.message.startswith("Not converged")


@pytest.fixture(scope="module")
def two_modes():
    """The second of three frames has two equal modes, 0.2 apart: the exact spread is 0.1, that of a mode 0.004."""
    nodes = np.linspace(0, 1, 401)

    def about(m, w):
        return -((nodes - m) ** 2) / (2 * w**2)

    two = np.maximum(np.logaddexp(about(0.4, 0.004), about(0.6, 0.004)), -2000)
    values = [about(0, 0.01), about(0.2, 0.01), two, about(0.8, 0.01), about(1, 0.01)]
    return FrameTimeLogProb(ProfileCurves.from_nodes([nodes] * 5, values), free_times(5))


def test_few_frames_change_modes(two_modes):
    found = sampled(two_modes)
    assert found.converged
    assert agrees(found)
    assert (found.draws[:, 2] > 0.5).mean() == pytest.approx(0.5, abs=0.03)
    assert found.std()[2] == pytest.approx(found.exact.std()[2], rel=0.02)


def test_ensembles_that_all_miss_a_mode_have_not_converged(two_modes):
    # emcee's own moves stay at their mode: tau and R-hat do not detect the other one.
    moves = [(emcee.moves.DEMove(), 0.7), (emcee.moves.StretchMove(), 0.3)]
    found = sampled(two_modes, moves=moves, steps=1500, ensembles=2)
    assert (found.r_hat < 1.01).all()
    assert found.std()[2] < 0.005
    assert not found.converged
    assert found.message.startswith("Not converged")
    assert "emcee and the exact posterior disagree at frame 2" in found.message


def test_message_counts_identified_frames():
    log_prob = toy((0.2, 0.5, 0.8), (0.02, 5.0, 0.02))
    found = sampled(log_prob)
    assert found.converged
    assert found.identified().sum() == 4
    assert found.message.endswith(" 2 of 3 frame times are identified.")


@pytest.mark.parametrize(("num", "frames"), [pytest.param(5, [3], marks=pytest.mark.slow), (7, [1, 3, 4]), (3, None)])
def test_single_frames_between_held_ones(num, frames):
    means = np.linspace(0, 1, num)
    curves = parabolas(means[1:-1], np.full(num - 2, 0.2 / num))
    log_prob = FrameTimeLogProb(curves, Increments.with_free(means, frames))
    laplace = laplace_approximation(curves, log_prob.increments, means)
    free = log_prob.increments.free
    np.testing.assert_allclose(laplace.mode, means, atol=1e-3)
    np.testing.assert_allclose(laplace.std[free], exact_posterior(curves, log_prob.increments).std()[free], rtol=0.05)
    draws = laplace.sample(4000)
    assert (np.diff(draws) > 0).all()
    assert (draws[:, ~free] == means[~free]).all()
    np.testing.assert_allclose(draws.std(0)[free], laplace.std[free], rtol=0.06)
    found = sampled(log_prob)
    assert found.converged
    assert agrees(found)
    np.testing.assert_array_equal(found.free, np.flatnonzero(free))


def test_low_concentration_samples_unresolved_gaps():
    # A thousandth of increments are below 1e-16.
    flat = [np.zeros(61)] * 16
    log_prob = FrameTimeLogProb(ProfileCurves.from_nodes([np.linspace(0, 1, 61)] * 16, flat), free_times(16, 0.2))
    found = sampled(log_prob, steps=400)
    assert (np.diff(found.times) >= 0).all()
    assert np.isfinite(found.logits).all()
    assert np.isfinite(found.to_arviz().sample_stats["lp"].values).all()


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


@pytest.mark.parametrize("blocks", [False, True])
def test_resumed_run_equals_an_uninterrupted_one(tmp_path, blocks):
    log_prob = toy(*NEAR)
    moves = BlockSweep(log_prob, block=2) if blocks else None
    settings = {"steps": 60, "thin_by": 1, "moves": moves, "seed": 5}
    whole = sampled(log_prob, **settings)
    sampled(log_prob, **{**settings, "steps": 30}, backend=tmp_path / "run.h5")
    found = sampled(log_prob, **settings, backend=tmp_path / "run.h5")
    np.testing.assert_array_equal(found.times, whole.times)
    again = sampled(log_prob, **settings, backend=tmp_path / "run.h5")
    np.testing.assert_array_equal(again.times, whole.times)
    assert [path.name for path in tmp_path.iterdir()] == ["run.h5"]


def test_file_of_another_run_is_refused(tmp_path):
    path = tmp_path / "run.h5"
    sampled(toy(*NEAR), steps=100, backend=path)
    before = path.read_bytes()
    changes = {"seed": 1}, {"log_prob": toy(NEAR[0], (0.03, 0.05, 0.041))}, {"ensembles": 3}, {"walkers": 34}
    for change in (*changes, {"moves": emcee.moves.StretchMove()}):
        with pytest.raises(ValueError, match="backend"):
            sampled(**{"log_prob": toy(*NEAR), "steps": 100, "backend": path, **change})
    assert path.read_bytes() == before
    (tmp_path / "text.h5").write_text("no such file")
    with pytest.raises(ValueError, match="backend"):
        sampled(toy(*NEAR), steps=100, backend=tmp_path / "text.h5")


def test_symbolic_links_beside_the_draws_are_not_followed(tmp_path):
    """Symbolic links at the paths of temporary files beside a file of draws are not followed."""
    precious, path = tmp_path / "precious", tmp_path / "draws" / "run.h5"
    path.parent.mkdir()
    precious.write_text("mine")
    for steps in (20, 40):
        for ending in ("running", "new"):
            (path.parent / f".run.h5.{ending}").symlink_to(precious)
        sampled(toy(*NEAR), steps=steps, ensembles=2, backend=path)
        assert precious.read_text() == "mine"
        assert [one.name for one in path.parent.iterdir()] == ["run.h5"]
        assert not path.is_symlink()


def test_file_of_draws_has_one_writer(tmp_path):
    path, told = tmp_path / "run.h5", []
    settings = {"log_prob": toy(*NEAR), "steps": 20, "ensembles": 2, "backend": path}

    def meanwhile(what, done, total):
        with pytest.raises(BlockingIOError, match="backend: expected a file that no other run is writing") as error:
            sampled(**settings)
        told.append(str(error.value))

    def interrupt(what, done, total):
        raise KeyboardInterrupt

    found = frame_time_posterior(**settings, progress=meanwhile)
    assert told
    with pytest.raises(KeyboardInterrupt):
        frame_time_posterior(**settings | {"steps": 40}, progress=interrupt)
    assert [one.name for one in tmp_path.iterdir()] == ["run.h5"]
    np.testing.assert_array_equal(sampled(**settings).times, found.times)  # the lock is released
    assert [one.name for one in tmp_path.iterdir()] == ["run.h5"]


@pytest.mark.slow
def test_lock_of_another_process_is_respected(tmp_path):
    """The lock ends with its process; the remaining file does not block others."""
    path = tmp_path / "run.h5"
    holding = (
        "import pathlib, sys, time\n"
        "from foldgauss.uncertainty.posterior.draws_file import lock_draws\n"
        "with lock_draws(pathlib.Path(sys.argv[1])):\n"
        "    print('held', flush=True)\n"
        "    time.sleep(240)\n"
    )
    words = [sys.executable, "-c", holding, path]
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout.readline() == "held\n"
            with pytest.raises(BlockingIOError, match="no other run"):
                sampled(toy(*NEAR), steps=20, ensembles=2, backend=path)
            assert not path.exists()
        finally:
            process.kill()
    sampled(toy(*NEAR), steps=20, ensembles=2, backend=path)
    assert [one.name for one in tmp_path.iterdir()] == ["run.h5"]


def test_fingerprint_covers_settings_and_moves(tmp_path):
    path, settings = tmp_path / "run.h5", {"steps": 20, "ensembles": 2, "backend": tmp_path / "run.h5"}
    log_prob = toy(*NEAR)
    whole = sampled(log_prob, **settings, walkers=32, seed=1, thin_by=10)
    numbers = {"walkers": np.int32(32), "seed": np.int64(1), "thin_by": np.int16(10)}
    np.testing.assert_array_equal(sampled(log_prob, **settings, **numbers).times, whole.times)
    path.unlink()
    stretch, walk = emcee.moves.StretchMove(a=2.0), emcee.moves.DEMove()
    sampled(log_prob, **settings, moves=[(stretch, 0.5), (walk, 0.5)])
    sampled(log_prob, **settings, moves=[(stretch, 0.5), (walk, 0.5)])  # the same objects, after a run
    others = [(emcee.moves.StretchMove(a=9.0), 0.5), (walk, 0.5)], [(stretch, 0.4), (walk, 0.6)]
    for moves in (*others, [(stretch, 0.5), (emcee.moves.DEMove(sigma=1e-3), 0.5)]):
        with pytest.raises(ValueError, match="backend"):
            sampled(log_prob, **settings, moves=moves)
    path.unlink()
    sampled(log_prob, **settings, moves=emcee.moves.GaussianMove(0.1))
    with pytest.raises(ValueError, match="backend"):
        sampled(log_prob, **settings, moves=emcee.moves.GaussianMove(0.2))


@pytest.mark.parametrize("num", [1, 2, 8, 9, 11, 12, 13])
def test_default_walkers_suffice(num):
    means = np.linspace(0, 1, num + 2)[1:-1]
    found = sampled(toy(means, np.full(num, 0.2 / num), nodes=101), steps=20, ensembles=2)
    assert found.times.shape[2] % 2 == 0
    assert found.times.shape[3] == num + 2


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"walkers": 4}, "walkers"),
        ({"walkers": 33}, "walkers"),
        ({"ensembles": 1}, "ensembles"),
        ({"thin_by": 0}, "thin_by"),
        ({"steps": 5}, "steps"),
        *[({name: value}, name) for name in ("walkers", "ensembles", "thin_by", "steps") for value in (32.0, "9")],
        *[({name: np.nan}, name) for name in ("walkers", "ensembles", "thin_by", "steps", "seed")],
        *[({"seed": seed}, "seed") for seed in (-1, None, 1.5)],
        *[({"moves": moves}, "moves") for moves in ("stretch", [], ["stretch"], 3, emcee.moves.StretchMove)],
        ({"moves": (emcee.moves.StretchMove(), 0.5)}, "moves"),
        ({"moves": [(emcee.moves.StretchMove(), 0.0)]}, "weights"),
        ({"moves": [(emcee.moves.StretchMove(), np.nan)]}, "moves"),
        ({"log_prob": 3}, "log_prob"),
        ({"progress": "yes"}, "progress"),
        ({"progress": lambda: None}, "progress"),
        ({"backend": 3.0}, "backend"),
        ({"model": 3}, "model.*beside `log_prob`"),
        ({"video": np.zeros((5, 4, 4, 3), np.uint8)}, "video"),
        ({"frames": [1]}, "frames"),
        ({"noise": "effective"}, "noise"),
        ({"noise": white()}, "noise"),
        ({"level": "colors"}, "level"),
        ({"concentration": 2.0}, "concentration"),
        ({"profiles": 3}, "profiles"),
        ({"moves": emcee.moves.DESnookerMove()}, "DESnookerMove"),
        ({"moves": [(emcee.moves.StretchMove(), 0.5), (emcee.moves.DESnookerMove(), 0.5)]}, "DESnookerMove"),
    ],
)
def test_what_is_refused(change, word):
    with pytest.raises(ValueError, match=word):
        frame_time_posterior(**{"log_prob": toy(*NEAR), "progress": False, **change})


def test_a_default_as_a_whole_number_is_none_beside_log_prob():
    with pytest.raises(ValueError, match=r"^walkers: "):  # not the concentration
        frame_time_posterior(log_prob=toy(*NEAR), progress=False, concentration=1, walkers=4)


@pytest.fixture(scope="module")
def profiles():
    """Profiles of another clip."""
    curves = parabolas((0.3, 0.6), (0.1, 0.1), 5)  # 4 frames
    return LikelihoodProfiles(curves, FrameNoise(np.full(4, 0.02), np.ones(4)), np.ones(3), 9)


def test_errors_are_raised_before_rendering(tmp_path, monkeypatch, profiles):
    def drawn(*_, **__):
        raise AssertionError("pictures were drawn")

    monkeypatch.setattr("foldgauss.uncertainty.posterior.sampling.likelihood_profiles", drawn)
    monkeypatch.setattr("foldgauss.uncertainty.posterior.log_prob.likelihood_profiles", drawn)
    frames = np.zeros((6, 4, 4, 3), np.uint8)
    (tmp_path / "text.h5").write_text("no such file")
    both = [
        ({"model": None}, "model"),
        ({"model": "x"}, "model"),
        ({"model": EditedVideo((Layer(model()),))}, "model.*EditedVideo.*Give the model"),
        ({"video": frames[:2]}, "video: expected at least 3 frames"),
        ({"video": None}, "video"),
        ({"frames": [9]}, "frames"),
        ({"frames": 3}, "frames"),
        ({"level": "everything"}, "level"),
        ({"noise": "loud"}, "noise"),
        ({"concentration": "a"}, "concentration"),
        ({"concentration": -1}, "concentration"),
        ({"profiles": profiles}, "video: expected the 4 frames of `profiles`"),
        ({"profiles": profiles, "video": None, "noise": white()}, "noise"),
        ({"profiles": profiles, "video": None, "level": "colors"}, "video"),
    ]
    alone = [
        ({"walkers": 3}, "walkers"),
        ({"seed": -1}, "seed"),
        ({"backend": tmp_path / "none" / "run.h5"}, "backend.*folder"),
        ({"backend": tmp_path}, "backend"),
        ({"backend": tmp_path / "text.h5"}, "backend"),
    ]
    for change, word in both + alone:
        with pytest.raises(ValueError, match=word):
            frame_time_posterior(**{"model": model(), "video": frames, "progress": False, **change})
    held = [({"held": np.linspace(0.2, 3, 6)}, "held"), ({"held": "x"}, "held"), ({"held": np.ones(2)}, "held")]
    for change, word in both + held:
        with pytest.raises(ValueError, match=word):
            frame_time_log_prob(**{"model": model(), "video": frames, "frames": [2], **change})
    with pytest.raises(ValueError, match="profiles"):
        frame_time_posterior(log_prob=toy(*NEAR), profiles=profiles, progress=False)


def test_rendered_log_likelihood_checks_arguments():
    frames = clip(uneven())
    with pytest.raises(ValueError, match="noise"):
        rendered_log_likelihood(model(), frames, uneven(), "score")
    for times in (uneven()[:3], uneven() + 1, "x"):
        with pytest.raises(ValueError, match="times"):
            rendered_log_likelihood(model(), frames, times, white())


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


@pytest.mark.slow
def test_peak_memory_is_twice_the_draws():
    num = 40
    log_prob = toy(np.linspace(0, 1, num + 2)[1:-1], np.full(num, 0.005), nodes=101)
    settings = {"steps": 400, "thin_by": 1, "ensembles": 2}
    sampled(log_prob, **{**settings, "steps": 2})  # compilation
    tracemalloc.start()
    found = sampled(log_prob, **settings)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    kept = 8 * 2 * 400 * found.times.shape[2] * (num + 2)
    assert 1.9 * kept < peak < 2.8 * kept


def test_nan_in_the_density_raises():
    log_prob = toy(*NEAR)
    values = log_prob.curves.values.copy()
    values[1, 100:140] = np.nan
    broken = FrameTimeLogProb(dataclasses.replace(log_prob.curves, values=values), log_prob.increments)
    with pytest.raises(ValueError, match="NaN"):
        sampled(broken, steps=100)


def test_missing_model_and_density_raise():
    with pytest.raises(ValueError, match="model"):
        frame_time_posterior(progress=False)


@pytest.mark.slow
def test_some_frames_of_a_clip():
    found = frame_time_posterior(model(), clip(uneven()), frames=[3, 4], noise=white(), progress=False)
    assert found.converged
    assert agrees(found)
    np.testing.assert_array_equal(found.free, [3, 4])
    assert (found.std()[[1, 2, 5, 6]] < 1e-12).all()
    miss = (found.mean() - uneven())[[3, 4]] / found.std()[[3, 4]]
    assert np.abs(miss).max() < 4
    assert found.identified().all()


def test_progress_is_reported():
    told = []
    settings = {"noise": white(), "steps": 20, "ensembles": 2}
    frame_time_posterior(model(), clip(uneven()), frames=[3], **settings, progress=lambda *each: told.append(each))
    assert {what for what, _, _ in told} == {"images", "steps"}
    assert all(0 < done <= total for _, done, total in told)


@pytest.fixture(scope="module")
def small():
    return sampled(toy(*NEAR), steps=100, ensembles=2)


def test_arviz_has_all_draws(small):
    """A chain per walker, whose draws are the steps; the ensemble of each is a coordinate."""
    data = small.to_arviz()
    ensembles, steps, walkers, frames = small.times.shape
    assert data.posterior["t"].shape == (ensembles * walkers, steps, frames)
    assert data.posterior["w"].shape == (ensembles * walkers, steps, frames - 1)
    assert data.sample_stats["lp"].shape == (ensembles * walkers, steps)
    np.testing.assert_array_equal(data.posterior["t"].values[walkers + 3], small.times[1, :, 3])
    np.testing.assert_array_equal(data.posterior["ensemble"].values, np.repeat([0, 1], walkers))
    assert data.attrs["message"] == small.message


def test_arviz_before_and_after_1_0_have_the_same_groups(small, monkeypatch):
    arviz = import_optional("arviz")
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
    arviz, rng = import_optional("arviz"), np.random.default_rng(0)
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
