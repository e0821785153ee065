"""Fitted videos and running fits on disk: exact, and refused where they do not belong."""

import dataclasses

import jax
import numpy as np
import pytest
from soft_models import assert_same, soft_model

from foldgauss.io import ModelFileError, load_video_model, save_video_model
from foldgauss.io.models.checkpoint import load_checkpoint, save_checkpoint
from foldgauss.io.models.model_file import save_model
from foldgauss.video import FitConfig, fit_steps
from foldgauss.video.fitting.config import Growth
from foldgauss.video.fitting.loop import to_model

CONFIG = FitConfig(num_gaussians=60, steps=8, degree=2)
SOURCE = {"clip": "somewhere.mp4", "num_frames": 3, "size": [24, 32]}


def frames():
    return np.random.default_rng(0).integers(0, 256, (3, 24, 32, 3)).astype(np.uint8)


def test_checkpoint_goes_on_to_the_same_bits(tmp_path):
    path = tmp_path / "c"
    for state, info in fit_steps(frames(), CONFIG):
        if info.step == 3:
            save_checkpoint(path, state, config=CONFIG, source=SOURCE)
    whole = to_model(state, CONFIG, (24, 32), 25.0)
    kept = load_checkpoint(path, config=CONFIG, source=SOURCE)
    assert kept.step == 3
    for state, _ in fit_steps(frames(), CONFIG, kept):
        pass
    assert_same(whole, to_model(state, CONFIG, (24, 32), 25.0))


def test_checkpoint_of_a_good_state_holds_it_once(tmp_path):
    state, _ = next(fit_steps(frames(), CONFIG))
    size = save_checkpoint(tmp_path / "two", state, config=CONFIG, source=SOURCE).stat().st_size
    state.last_finite = state.copy()
    path = save_checkpoint(tmp_path / "one", state, config=CONFIG, source=SOURCE)
    assert path.stat().st_size < 0.6 * size
    kept = load_checkpoint(path, config=CONFIG, source=SOURCE)
    for one in (kept, kept.last_finite):
        jax.tree.map(np.testing.assert_array_equal, one.copy(), state.copy())
    assert not np.shares_memory(kept.rows, kept.last_finite.rows)


def test_checkpoint_keeps_what_growth_is_decided_by(tmp_path, monkeypatch):
    """Kept between two births: the second is decided by the gradients of before, too."""
    monkeypatch.setattr(Growth, "for_plan", lambda self, plan: self)
    growth = Growth(from_step=1, until_step=25, every=10, screen_gradient=2e-3, time_gradient=5e-3)
    config = CONFIG.replace(steps=30, **{"strategy.growth": growth})
    path, numbers = tmp_path / "c", []
    for state, info in fit_steps(frames(), config):
        numbers.append(info.num_gaussians)
        if info.step == 17:
            save_checkpoint(path, state, config=config, source=SOURCE)
    assert 60 < numbers[10] < numbers[20]
    whole = to_model(state, config, (24, 32), 25.0)
    kept = load_checkpoint(path, config=config, source=SOURCE)
    assert kept.statistics.seen.any()
    for state, _ in fit_steps(frames(), config, kept):
        pass
    assert_same(whole, to_model(state, config, (24, 32), 25.0))
    save_checkpoint(path, state, config=config, source=SOURCE)  # growth is over
    assert load_checkpoint(path, config=config, source=SOURCE).statistics is None
    with pytest.raises(ValueError, match=r"overwrite: expected strategy\.growth="):
        load_checkpoint(path, config=config.replace(**{"strategy.growth": None}), source=SOURCE)


def test_checkpoint_of_another_fit_is_refused(tmp_path):
    path = tmp_path / "c"
    state, _ = next(fit_steps(frames(), CONFIG))
    save_checkpoint(path, state, config=CONFIG, source=SOURCE)
    with pytest.raises(ValueError, match=r"overwrite: expected degree=2, got degree=3"):
        load_checkpoint(path, config=dataclasses.replace(CONFIG, degree=3), source=SOURCE)
    with pytest.raises(ValueError, match="num_frames"):
        load_checkpoint(path, config=CONFIG, source=SOURCE | {"num_frames": 4})
    for odd in ("none", ["num_frames"], 3):
        save_model(path, state, metadata={"config": odd, "source": SOURCE})
        with pytest.raises(ValueError, match="overwrite: expected"):
            load_checkpoint(path, config=CONFIG, source=SOURCE)


def test_kinds_are_not_mixed_up(tmp_path):
    state, _ = next(fit_steps(frames(), CONFIG))
    save_checkpoint(tmp_path / "c", state, config=CONFIG, source=SOURCE)
    with pytest.raises(ModelFileError, match="fit-checkpoint"):
        load_video_model(tmp_path / "c")
    save_video_model(tmp_path / "m", soft_model())
    with pytest.raises(ValueError, match=r"overwrite|kind"):
        load_checkpoint(tmp_path / "m", config=CONFIG, source=SOURCE)


def test_names_of_models(tmp_path):
    for name in ("m", "m.safetensors", "M.SafeTensors", "m.v2.safetensors"):
        assert load_video_model(save_video_model(tmp_path / name, soft_model())).num_frames
