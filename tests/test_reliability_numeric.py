"""NaN and infinities, far too high learning rates, and models at the limits of float32."""

import dataclasses
import math
import warnings

import jax
import numpy as np
import pytest
from soft_models import soft_model
from tiny_clips import moving_disc

from foldgauss.io.models.checkpoint import load_checkpoint, save_checkpoint
from foldgauss.render import ENGINES, RenderOptions
from foldgauss.render.pallas import HIGHEST_CEILING
from foldgauss.video import DivergenceWarning, FitConfig, FitDiverged, LearningRates, evaluate, fit
from foldgauss.video import fit_steps as steps_of
from foldgauss.video.fitting.loop import start, start_from, to_model

CLIP = moving_disc()
CONFIG = FitConfig(num_gaussians=200, steps=240, seed=1)


def fitted_with(config):
    """dB of a fit, and what it warned of; that its model is finite is checked."""
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        model = fit(CLIP, config).model
    assert all(np.isfinite(leaf).all() for leaf in map(np.asarray, jax.tree.leaves(model)))
    assert all(issubclass(one.category, DivergenceWarning) for one in told)
    return evaluate(model, CLIP).mean_psnr, [str(one.message) for one in told]


@pytest.fixture(scope="module")
def at_start() -> float:
    """dB before the first step."""
    return evaluate(to_model(start(CLIP, CONFIG), CONFIG, CLIP.shape[1:3], 25.0), CLIP).mean_psnr


def too_high(leaf, factor):
    rates = dataclasses.replace(LearningRates(), **{leaf: factor * getattr(LearningRates(), leaf)})
    return dataclasses.replace(CONFIG, rates=rates)


#: What is said of a leaf's rate a thousand and a million times too high. Where nothing is, the leaf comes to an end of
#: what it can do: angles turn round, opacities are 0 or 1, and the
#: falling rates find a poorer end. With log_time_scale go the rates that are in its units.
NAMED = {
    "loc": "loc moved most",
    "coefficients": "coefficients moved most",
    "log_scale": "no finite log_scale",
    "angle_logit": None,
    "opacity_logit": None,
    "color_dc": "color_dc moved most",
    "time_loc_logit": None,
    "log_time_scale": "no finite time_loc_logit",
    "frame_times": "frame times moved by e^",
}


#: Rates of 10^6 in quick runs: the names that a warning has, or none, differ between these.
HIGHEST = ("loc", "log_scale", "opacity_logit")
#: Rates of 10^3 in quick runs. Pictures alone do not show frame times that diverge.
HIGH = ("coefficients", "frame_times")


@pytest.mark.parametrize(
    ("leaf", "power"),
    [
        *(pytest.param(leaf, 3, marks=[] if leaf in HIGH else [pytest.mark.slow]) for leaf in NAMED),
        *(pytest.param(leaf, 6, marks=[] if leaf in HIGHEST else [pytest.mark.slow]) for leaf in NAMED),
    ],
)
def test_too_high_rate_is_named_and_the_model_not_worse_than_its_start(at_start, leaf, power):
    """Pictures alone do not show frame times that diverge: they end poorly, and are never worse than before."""
    config, named = too_high(leaf, 10.0**power), NAMED[leaf]
    psnr, told = fitted_with(config)
    times_alone = (leaf, power) == ("frame_times", 3)
    assert psnr - at_start > (8 if times_alone else -0.3)
    assert bool(told) == (named is not None)
    assert not times_alone or len(told) == 1
    if told:
        assert named in told[0]
        assert "diverged at step " in told[0]


def test_a_rate_too_high_for_all_backoffs_ends_the_fit():
    with pytest.warns(DivergenceWarning), pytest.raises(FitDiverged, match=r"step \d+: no finite time_loc_logit"):
        fit(CLIP, too_high("log_time_scale", 1e9))


def test_exhausted_backoffs_restore_the_last_finite_state(at_start):
    psnr, told = fitted_with(too_high("color_dc", 1e8))
    assert "the fit ended at step 240" in told[-1]
    assert "lower these learning rates" in told[-1]
    assert psnr == pytest.approx(at_start, abs=0.3)


@pytest.mark.parametrize(
    ("leaf", "power"),
    [
        pytest.param("loc", 6, marks=pytest.mark.slow),
        ("color_dc", 6),
        pytest.param("log_scale", 3, marks=pytest.mark.slow),
    ],
)
def test_resuming_keeps_divergence_and_recovery(tmp_path, leaf, power):
    """While it is taken back, and before it is seen to come apart: what was sound is kept with it."""
    config, path = too_high(leaf, 10.0**power), tmp_path / "kept.safetensors"

    def finished(stops):
        kept = None
        with warnings.catch_warnings(record=True) as warned:
            warnings.simplefilter("always")
            for stop in [*stops, config.steps]:
                state = next(state for state, info in steps_of(CLIP, config, kept) if info.step == stop)
                save_checkpoint(path, state, config=config, source={})
                kept = load_checkpoint(path, config=config, source={})
        return kept, len(warned)

    (whole, told), (stopped, told_too) = finished([]), finished([10, 30, 60, 100, 150, 200])
    assert told == told_too > 0
    np.testing.assert_array_equal(stopped.rows, whole.rows)
    np.testing.assert_array_equal(stopped.time_logits, whole.time_logits)


@pytest.mark.parametrize("value", [math.nan, math.inf, -1.0])
@pytest.mark.parametrize("leaf", NAMED)
def test_nonfinite_rates_are_refused(leaf, value):
    with pytest.raises(ValueError, match=f"rates.{leaf}"):
        LearningRates(**{leaf: value})


# ---------------------------------------------------------------------------------------------------- frames


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_nonfinite_frames_are_located(value):
    frames = CLIP.astype(np.float32) / 255
    frames[2, 3, 5, 1] = frames[4, 0, 0, 0] = value
    with pytest.raises(
        ValueError, match=r"float32.* 2 of its values are NaN or infinite, the first at frames\[2, 3, 5, 1\]"
    ):
        fit(frames, CONFIG)


@pytest.mark.parametrize(
    "dtype", [bool, np.int8, np.int16, np.uint16, np.int64, np.float16, np.float64, np.complex64, object]
)
def test_frames_of_other_kinds_are_refused(dtype):
    """Never scaled or cut unasked: no array says of what its numbers are."""
    with pytest.raises(ValueError, match="frames: expected a uint8 array"):
        fit(CLIP.astype(dtype), CONFIG)


# ---------------------------------------------------------------------------------------------------- states


def with_leaf(model, name, value):
    leaf = np.array(getattr(model.splats, name))
    leaf.reshape(-1)[5] = value
    return dataclasses.replace(model, splats=dataclasses.replace(model.splats, **{name: leaf}))


@pytest.mark.parametrize("value", [np.nan, np.inf])
@pytest.mark.parametrize("name", ["loc", "coefficients", "opacity_logit"])
def test_nonfinite_models_are_refused(name, value):
    model = with_leaf(soft_model(size=CLIP.shape[1:3], num_frames=len(CLIP)), name, value)
    config = FitConfig(power=2.0, options=model.options)
    with pytest.raises(FitDiverged, match=f"state: expected finite parameters, got no finite {name} in 1 Gaussians"):
        next(steps_of(CLIP, config, start_from(model, config, 10)))


@pytest.mark.parametrize("huge", [1e6, 1e18, 1e38])
def test_exploding_folds_of_degree_7_stay_finite(huge):
    """Gaussians are thrown out of the picture; those that are left learn on."""
    model = soft_model(size=CLIP.shape[1:3], num_frames=len(CLIP), degree=7)
    coefficients = np.array(model.splats.coefficients)
    coefficients[::2] *= huge
    model = dataclasses.replace(model, splats=dataclasses.replace(model.splats, coefficients=coefficients))
    config = FitConfig(power=2.0, options=model.options, degree=7)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DivergenceWarning)
        for state, info in steps_of(CLIP, config, start_from(model, config, 30)):
            assert np.isfinite(state.rows).all()
            assert math.isfinite(info.loss)


# --------------------------------------------------------------------------------------------- far from usual


#: All engines but one: "pallas" takes no ceiling of 1, and is judged with the highest that it takes.
DRAWN = [engine for engine in ENGINES if engine not in ("auto", "pallas")]
LOW = dataclasses.replace(RenderOptions.exact(), alpha_ceiling=HIGHEST_CEILING)


def _extreme():
    """Leaves of some Gaussians at the ends of what is finite; the others are as they were."""
    far = np.float32(3e38)
    return {
        "centers far away": {"loc": [1e30, -1e30]},
        "centers at the largest number": {"loc": [far, -far]},
        "scales of 1e-30": {"log_scale": [math.log(1e-30)] * 2},
        "scales of 1e-45 and 1e30": {"log_scale": [-103.0, 69.0]},
        "scales that overflow": {"log_scale": [1e30, 1e30]},
        "opacities of 1": {"opacity_logit": 1e30},
        "opacities of 0": {"opacity_logit": -far},
        "angles far round": {"angle_logit": 1e30},
        "no time": {"log_time_scale": -100.0},
        "all time": {"log_time_scale": 80.0},
        "times at the end": {"time_loc_logit": 1e30},
        "folds of 1e6": {"coefficients": 1e6},
        "folds of the largest number": {"coefficients": far},
        "colors below black": {"color_dc": -far},
    }


@pytest.mark.parametrize("name", _extreme())
def test_engines_agree_on_extreme_models(name):
    """Degree 7; a Gaussian in three is far from usual. Colors of the others stay below white."""
    model = soft_model(degree=7)
    changed = {}
    for leaf, value in _extreme()[name].items():
        changed[leaf] = np.array(getattr(model.splats, leaf))
        changed[leaf][::3] = value
    model = dataclasses.replace(model, splats=dataclasses.replace(model.splats, **changed))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        pictures = {engine: np.asarray(model.render(0.37, engine=engine)) for engine in DRAWN}
        (played,) = model.frames(np.array([0.37]))
        low = dataclasses.replace(model, options=LOW)
        by_pallas, as_judged = (np.asarray(low.render(0.37, engine=engine)) for engine in ("pallas", "reference"))
    top = max(1.0, float(np.max(0.5 + 0.2821 * np.asarray(model.splats.color_dc))))
    for engine, picture in pictures.items():
        assert np.isfinite(picture).all(), engine
        assert picture.min() >= 0
        assert picture.max() <= top + 1e-4
        np.testing.assert_allclose(picture, pictures["reference"], atol=2e-4, err_msg=engine)
    np.testing.assert_allclose(by_pallas, as_judged, atol=2e-4)
    np.testing.assert_allclose(played / 255, np.clip(pictures["reference"], 0, 1), atol=0.5 / 255 + 1e-3)
