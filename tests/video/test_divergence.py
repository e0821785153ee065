"""Divergence: detected, named and undone; and no alarm in fits that converge."""

import warnings

import numpy as np
import pytest
from clips import moving_blobs
from soft_models import assert_same

from foldgauss.video import DivergenceWarning, FitConfig, FitDiverged, LearningRates, Views, evaluate, fit, fit_steps
from foldgauss.video.fitting import divergence
from foldgauss.video.fitting.divergence import MAX_BACKOFFS, Guard
from foldgauss.video.fitting.state import running_psnr, to_model
from foldgauss.video.fitting.steppers.cpu_stepper import CpuStepper
from foldgauss.video.models.row_layout import columns

CLIP = moving_blobs()
CONFIG = FitConfig(
    num_gaussians=200,
    steps=240,
    seed=1,
    rates=LearningRates(cooldown=0),
    views=Views(interpolation_fraction=0.0),
    follow_camera=False,
)


@pytest.fixture(scope="module")
def slowed(optimized) -> float:
    """dB of the fit whose rates fall at step 100 as those of a fit that backs off."""

    def back_off(state):
        state.backoffs = 1

    return _fit_with(back_off)


def _fit_with(change, config: FitConfig = CONFIG, at: int = 100) -> float:
    """dB of a fit whose state is changed after a step."""
    for state, info in fit_steps(CLIP, config):
        if info.step == at:
            change(state)
    assert np.isfinite(state.rows).all()
    assert info.step == config.steps
    return evaluate(to_model(state, CONFIG, CLIP.shape[1:3], 25.0), CLIP).mean_psnr


@pytest.mark.parametrize(
    ("leaf", "value"),
    [
        ("loc", np.nan),
        *(
            pytest.param(*case, marks=pytest.mark.slow)
            for case in (("coefficients", -np.inf), ("opacity_logit", np.inf), ("log_time_scale", np.nan))
        ),
    ],
)
def test_nonfinite_parameter_is_named_and_repaired(slowed, leaf, value):
    def spoil(state):
        state.rows[17, columns(CONFIG.fold_degree)[leaf]] = value

    with pytest.warns(DivergenceWarning, match=rf"step 101: .*no finite {leaf} in 1 Gaussians, the first of them 17"):
        got = _fit_with(spoil)
    assert got > slowed - 1.2  # steps since the last state kept are lost (seeds 0 to 5: 0.8 to 1.0 dB)


def test_nonfinite_frame_times_are_named():
    def spoil(state):
        state.time_logits = state.time_logits + np.float32(np.nan)

    with pytest.warns(DivergenceWarning, match="no finite frame times"):
        _fit_with(spoil)


def test_a_fit_that_may_not_back_off_any_more_raises_with_the_last_finite_state(monkeypatch):
    monkeypatch.setattr(divergence, "MAX_BACKOFFS", 0)

    def spoil(state):
        state.rows[:, columns(CONFIG.fold_degree)["log_scale"]] = np.nan

    with pytest.raises(FitDiverged, match=r"no finite log_scale in 200 Gaussians.*of step 120") as error:
        _fit_with(spoil, at=130)
    state = error.value.state
    assert state.step == 130  # as was told last: what watched goes on from there
    assert running_psnr(state) > 20
    assert np.isfinite(state.rows).all()
    assert evaluate(to_model(state, CONFIG, CLIP.shape[1:3], 25.0), CLIP).mean_psnr > 20


def test_exploding_folds_are_named_and_undone():
    def explode(state):
        state.rows[:, columns(CONFIG.fold_degree)["coefficients"]] *= 1e6

    def slow_down(state):  # the same rates from here on, without the explosion
        state.backoffs += 1

    with pytest.warns(DivergenceWarning, match="dB worse than they were; coefficients moved most"):
        got = _fit_with(explode)
    assert got > _fit_with(slow_down) - 1.5  # over seeds 0.9 to 1.1 dB less: steps are lost


def test_a_single_frame_that_is_worse_for_a_while_raises_no_warning():
    def spoil(num):
        def change(state):
            state.frame_errors[-num:] = 0.1

        return change

    with warnings.catch_warnings():
        warnings.simplefilter("error", DivergenceWarning)
        _fit_with(spoil(2), CONFIG, 150)  # the next step sees one of them
    with pytest.warns(DivergenceWarning, match="dB worse than they were"):
        _fit_with(spoil(3), CONFIG, 150)


def test_exhausted_backoffs_raise():
    def spoiled():
        for state, _ in fit_steps(CLIP, CONFIG):
            state.rows[:] = np.nan

    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always", DivergenceWarning)
        with pytest.raises(FitDiverged, match="lower these"):
            spoiled()
    assert sum(issubclass(one.category, DivergenceWarning) for one in told) == MAX_BACKOFFS


def _clips():
    rng = np.random.default_rng(0)
    flash = CLIP.copy()
    flash[3] = 255
    half_black = np.concatenate([np.zeros_like(CLIP[:3]), CLIP[:3]])
    hard = np.repeat(CLIP[:1], 6, axis=0)
    hard[5] = rng.integers(0, 256, CLIP.shape[1:], np.uint8)
    two = np.stack([np.zeros_like(CLIP[0]), hard[5]])
    text = np.zeros((2, 48, 64, 4), np.uint8)
    text[:, 20:28, 10:50, 3] = 255  # black, over what is random
    return {
        "black": np.zeros_like(CLIP),
        "white": np.full_like(CLIP, 255),
        "noise": rng.integers(0, 256, CLIP.shape, np.uint8),
        "flash": flash,
        "half black": half_black,
        "cut": np.concatenate([CLIP[:3], 255 - CLIP[3:]]),
        "one frame": CLIP[:1],
        "one frame of noise": hard,
        "one of two of noise": two,
        "alpha": text,
        "alpha, one frame": text[:1],
    }


#: Of each kind one; the long runs take the rest, and 200 Gaussians.
QUICK = ("black", "noise", "flash", "one frame of noise", "alpha")


@pytest.mark.parametrize("name", [pytest.param(k, marks=[] if k in QUICK else pytest.mark.slow) for k in _clips()])
@pytest.mark.parametrize("num", [3, pytest.param(200, marks=pytest.mark.slow)])
def test_good_fits_raise_no_warning(name, num):
    with warnings.catch_warnings():
        warnings.simplefilter("error", DivergenceWarning)
        fit(_clips()[name], FitConfig(num_gaussians=num, steps=150))


def test_guard_changes_no_bit(monkeypatch):
    watched = fit(CLIP, CONFIG).model
    monkeypatch.setattr(Guard, "find_fault", lambda self, state, result: "")
    monkeypatch.setattr(Guard, "keep_good", lambda self, state: None)
    monkeypatch.setattr(CpuStepper, "measure_start", lambda self, state: {})
    alone = fit(CLIP, CONFIG).model
    assert_same(watched, alone)


@pytest.mark.slow
def test_opacity_resets_raise_no_warning():
    small = {"num_gaussians": 200, "max_gaussians": 400, "steps": 300, "degree": 2}
    config = FitConfig.preset("paper", initialization="static", **small)
    with warnings.catch_warnings():
        warnings.simplefilter("error", DivergenceWarning)
        fit(CLIP, config)
