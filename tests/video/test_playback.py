"""`VideoRenderer` renders the same images as the slow path."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from path_models import path_model

from foldgauss.envelope import TimeLikelihood
from foldgauss.render import RenderOptions
from foldgauss.video.fitting.initialize import initialize
from foldgauss.video.models.frame_times import FrameTimes
from foldgauss.video.models.renderer import VideoRenderer, to_bytes
from foldgauss.video.models.video_model import VideoModel


def _model(power=2.0, floor=0.0, size=(37, 50)) -> VideoModel:
    clip = np.random.default_rng(0).integers(0, 255, (5, *size, 3), np.uint8)
    splats = initialize(clip, 300, degree=3, envelope=TimeLikelihood(power, floor), seed=0)
    splats = eqx.tree_at(lambda s: s.log_scale, splats, splats.log_scale + 0.7)
    return VideoModel(splats, FrameTimes.uniform(5), size, 25.0, RenderOptions())


@pytest.mark.parametrize(
    ("size", "power", "floor"),
    [
        ((60, 41), 2.0, 0.1),
        pytest.param(None, 1.0, 0.0, marks=pytest.mark.slow),
        pytest.param(None, 2.0, 0.1, marks=pytest.mark.slow),
        pytest.param((60, 41), 1.0, 0.0, marks=pytest.mark.slow),
        *(
            pytest.param(s, *of_a, marks=pytest.mark.slow)
            for s in ((37, 50), (16, 90))
            for of_a in ((1, 0.0), (2, 0.1))
        ),
    ],
)
def test_renderer_matches_model_render(size, power, floor):
    model = _model(power, floor)
    for t in (0.0, 0.31, 1.0):
        slow = np.asarray(model.render(t, size, engine="reference"))
        fast = VideoRenderer(model, size).frame(t)
        assert fast.shape == slow.shape
        assert fast.std() > 5  # there is something to see
        # A pixel at a cutoff, or half way between two levels, may fall to the other side.
        assert (np.abs(np.clip(slow, 0, 1) * 255 - fast) < 0.5 + 1e-2).mean() > 0.999
        np.testing.assert_allclose(fast / 255, np.clip(slow, 0, 1), atol=0.02)


def test_frames_are_those_of_the_frame_times():
    model = _model()
    played = list(VideoRenderer(model).frames())
    assert len(played) == 5
    np.testing.assert_array_equal(played[2], VideoRenderer(model).frame(np.asarray(model.frame_times.times())[2]))
    np.testing.assert_array_equal(np.stack(list(model.frames())), played)


def test_bytes_are_rounded_and_clipped():
    image = np.broadcast_to(np.float32([-3, 0, 0.5 / 255 - 1e-6, 0.5 / 255 + 1e-6, 1, 7, np.inf]), (3, 2, 7))
    np.testing.assert_array_equal(to_bytes(np.ascontiguousarray(image))[1, :, 0], [0, 0, 0, 1, 255, 255, 255])


ENTRANCES = {
    "render": lambda model, t=0.5, size=None: np.asarray(model.render(t, size)),
    "frames": lambda model, t=0.5, size=None: next(model.frames([t], size)) / 255,
    "renderer": lambda model, t=0.5, size=None: next(VideoRenderer(model, size).frames([t])) / 255,
}


def _without_gaussians(model):
    return dataclasses.replace(model, splats=model.splats.take(np.zeros(0, int)))


@pytest.mark.parametrize("entrance", ENTRANCES)
@pytest.mark.parametrize(
    ("change", "how", "message"),
    [
        *((None, {"size": size}, r"^size: expected \(height, width\)") for size in ((0, 5), (5.5, 5), (True, 5), 5)),
        *(
            (None, {"t": t}, "^times?: expected (a|one|a list of) time")
            for t in (1.001, -0.001, np.nan, True, 0.5j, "x", [0.5])
        ),
        ({"loc": np.full((300, 2), np.nan, np.float32)}, {}, "finite numbers, got others in 300 Gaussians"),
    ],
)
def test_all_ways_refuse_the_same(entrance, change, how, message):
    model = _model()
    if change is not None:
        model = dataclasses.replace(model, splats=dataclasses.replace(model.splats, **change))
    with pytest.raises(ValueError, match=message):
        ENTRANCES[entrance](model, **how)


@pytest.mark.parametrize(
    ("change", "how"),
    [
        (lambda model: model, {"t": 1 + 5e-7}),
        (lambda model: model, {"t": np.float64(-5e-7)}),
        (lambda model: model, {"t": 1}),
        (lambda model: model, {"size": (np.int64(30), np.int32(41))}),
        (lambda model: model.with_options(RenderOptions(tile_size=8)), {}),
        (_without_gaussians, {}),
    ],
)
def test_all_ways_accept_the_same(change, how):
    first, *others = (enter(change(_model()), **how) for enter in ENTRANCES.values())
    for image in others:
        assert np.abs(image - np.clip(first, 0, 1)).mean() < 0.003


@pytest.mark.parametrize("entrance", ENTRANCES)
@pytest.mark.parametrize(
    ("where", "value", "message"),
    [
        (lambda m: m.splats.envelope.power, np.float32(np.nan), "^power: expected a finite number"),
        (lambda m: m.splats.envelope.floor, np.float32(1), "^floor: expected a number in"),
        (lambda m: m.splats.envelope.power, np.ones(300, np.float32), "^envelope: expected a TimeLikelihood with one"),
        (
            lambda m: m.frame_times.logits,
            np.full(4, np.inf, np.float32),
            "finite numbers, got others in its frame times",
        ),
    ],
)
def test_what_was_replaced_in_a_tree_is_checked(entrance, where, value, message):
    with pytest.raises(ValueError, match=message):
        ENTRANCES[entrance](eqx.tree_at(where, _model(), value))


def test_render_has_gradients_by_every_leaf_with_shared_paths():
    """Outside `jit`, too, where integers and counts have known values beside what is differentiated."""
    model = path_model()
    slopes = eqx.filter_grad(lambda one: one.render(0.5).sum())(model)
    assert np.abs(slopes.splats.paths.matrices).max() > 0
    which = jnp.stack([jnp.asarray(model.splats.path_index)] * 2)
    dark = jax.vmap(lambda own: eqx.tree_at(lambda m: m.splats.path_index, model, own).render(0.5).sum())(which)
    np.testing.assert_allclose(dark, float(model.render(0.5).sum()), rtol=1e-5)


def test_unknown_compositing_is_no_model():
    with pytest.raises(ValueError, match=r"^compositing: expected one of"):
        dataclasses.replace(_model(), compositing="under")
