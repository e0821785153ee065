"""Playback draws what the model says, whatever the way there."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

from foldgauss.envelope import TimeLikelihood
from foldgauss.render import RenderOptions
from foldgauss.video.frame_times import FrameTimes
from foldgauss.video.initialize import initialize
from foldgauss.video.model import VideoModel
from foldgauss.video.playback import Playback, to_bytes


def _model(power=2.0, floor=0.0, size=(37, 50)) -> VideoModel:
    clip = np.random.default_rng(0).integers(0, 255, (5, *size, 3), np.uint8)
    splats = initialize(clip, 300, degree=3, envelope=TimeLikelihood(power, floor), seed=0)
    splats = eqx.tree_at(lambda s: s.log_scale, splats, splats.log_scale + 0.7)
    return VideoModel(splats, FrameTimes.uniform(5), size, 25.0, RenderOptions())


@pytest.mark.parametrize(("power", "floor"), [(1.0, 0.0), (2.0, 0.1)])
@pytest.mark.parametrize("size", [None, (37, 50), (60, 41), (16, 90)])
def test_it_draws_what_the_slow_way_draws(size, power, floor):
    model = _model(power, floor)
    for t in (0.0, 0.31, 1.0):
        slow = np.asarray(model.render(t, size, engine="reference"))
        fast = Playback(model, size).frame(t)
        assert fast.shape == slow.shape
        assert fast.std() > 5  # there is something to see
        # A pixel at a cutoff, or half way between two levels, may fall to the other side.
        assert (np.abs(np.clip(slow, 0, 1) * 255 - fast) < 0.5 + 1e-2).mean() > 0.999
        np.testing.assert_allclose(fast / 255, np.clip(slow, 0, 1), atol=0.02)


def test_frames_are_those_of_the_frame_times():
    model = _model()
    played = list(Playback(model).frames())
    assert len(played) == 5
    np.testing.assert_array_equal(played[2], Playback(model).frame(np.asarray(model.frame_times.times())[2]))
    np.testing.assert_array_equal(np.stack(list(model.frames())), played)


def test_bytes_are_rounded_and_held():
    image = np.broadcast_to(np.float32([-3, 0, 0.5 / 255 - 1e-6, 0.5 / 255 + 1e-6, 1, 7, np.inf]), (3, 2, 7))
    np.testing.assert_array_equal(to_bytes(np.ascontiguousarray(image))[1, :, 0], [0, 0, 0, 1, 255, 255, 255])


def test_bad_models_and_sizes_are_refused():
    model = _model()
    with pytest.raises(ValueError, match="size"):
        Playback(model, (0, 5))
    broken = eqx.tree_at(lambda m: m.splats.loc, model, jnp.asarray(model.splats.loc).at[3].set(jnp.nan))
    with pytest.raises(ValueError, match="finite"):
        Playback(broken)
