"""Layers flattened to one plain model: the same images, or an error."""

import equinox as eqx
import jax
import numpy as np
import pytest
from path_models import path_model
from soft_models import NUM, OBJECT, soft_model

from foldgauss.render import Camera, RenderOptions
from foldgauss.video import FrameTimes, VideoModel, edit, layers
from foldgauss.video.models.frame_times import make_time_logits
from foldgauss.video.models.renderer import VideoRenderer
from foldgauss.video.segmented.layering import flatten_video


def _edited_before_a_longer_one():
    front = edit(soft_model(degree=1, options=RenderOptions())).select(OBJECT).move((0.2, 0.1)).video()
    return layers(front, soft_model(seed=3, num_frames=9, options=RenderOptions()))


def _on_paths():
    """Equal paths are not repeated."""
    return layers(path_model(), soft_model(seed=3), path_model(num_paths=3, num_knots=2, seed=7), path_model())


@pytest.mark.parametrize(
    ("make", "num", "num_frames", "paths"), [(_edited_before_a_longer_one, 2, 9, None), (_on_paths, 4, 7, (5, 6))]
)
def test_flattened_layers_render_the_same_images(make, num, num_frames, paths):
    video = make()
    flat = flatten_video(video)
    assert isinstance(flat, VideoModel)
    assert (flat.num_gaussians, flat.degree, flat.num_frames) == (num * NUM, 3, num_frames)
    assert paths == (flat.splats.paths and flat.splats.paths.times.shape)
    for t in (0.0, 0.31, 1.0):
        np.testing.assert_array_equal(VideoRenderer(flat).frame(t), VideoRenderer(video).frame(t))


@pytest.mark.parametrize("name", ["power", "floor"])
def test_layers_of_several_envelopes_are_not_flattened(name):
    model = soft_model()
    other = eqx.tree_at(lambda m: getattr(m.splats.envelope, name), model, np.float32(0.5))
    with pytest.raises(ValueError, match="layers with one envelope"):
        flatten_video(layers(model, other))


def test_flattening_a_plain_model_changes_nothing():
    model = soft_model()
    assert flatten_video(model) is model
    assert flatten_video(layers(model)) is model


def _with_a_cut():
    model = soft_model()
    shared = (model.size, model.fps, model.options, model.compositing)
    return VideoModel(model.splats, FrameTimes(make_time_logits(7, (3,))), *shared)


@pytest.mark.parametrize(
    "video",
    [
        lambda: edit(soft_model()).select(OBJECT).move((0.1, 0), times=(0.5, 1)).video(),
        lambda: edit(soft_model()).select(OBJECT).freeze(2).video(),
        lambda: edit(soft_model()).seen_from(Camera.front(40 / 64)).video(),
        lambda: layers(soft_model(), soft_model(power=1.0)),
        lambda: layers(soft_model(), soft_model(floor=0.1)),
        lambda: layers(_with_a_cut(), soft_model()),
    ],
)
def test_videos_that_cannot_be_flattened_are_rejected(video):
    with pytest.raises(ValueError, match=r"model: expected .*foldgauss render"):
        flatten_video(video())


def test_cut_of_the_leading_layer_is_kept():
    flat = flatten_video(layers(soft_model(), _with_a_cut()))
    assert len(jax.tree.leaves(flat.frame_times)) == 1
    assert flat.num_frames == 7
