"""Layers of clips in segments: what stands before or behind them goes by the whole clip's time."""

import dataclasses

import numpy as np
import pytest
from object_clips import named_model
from soft_models import OBJECT, soft_model
from soft_models import soft_segments as ground

from foldgauss.io import load_video_model, save_video_model
from foldgauss.io.edit_script import parse_edit_script
from foldgauss.render import Camera, cpu
from foldgauss.video import EditedVideo, FrameTimes, SegmentedVideo, edit, layers
from foldgauss.video.segmented.segmented_video import Segment

FIRSTS, NUM_FRAMES = (0, 4, 10), 16
BLACK = np.zeros(3, np.float32)


def brighter(gaussians, t):
    return dataclasses.replace(gaussians, color=gaussians.color * (1 + t))


def short_lived():
    """Many Gaussians, most of which are there for a while only."""
    named = named_model(12, (40, 64), each=60)[0]
    lasting = np.asarray(named.splats.log_time_scale)
    splats = dataclasses.replace(named.splats, log_time_scale=np.where(lasting < 0, lasting - 2, lasting))
    return dataclasses.replace(named, splats=splats, options=soft_model().options)


def front(kind):
    """Something of one piece, short or long, that moves."""
    model = soft_model(seed=9, num_frames=NUM_FRAMES)
    if kind == "plain":
        return model
    if kind == "short-lived":
        return short_lived()
    if kind == "one frame":
        return dataclasses.replace(short_lived(), frame_times=FrameTimes.uniform(1))
    if kind == "spans":
        chain = edit(model).recolor(gain=0.2, frames=(3, 9), ease=3, curve="smooth")
        return chain.select(OBJECT).multiply([(0.2, 0)], frames=(None, 6), ease=2).rotate(0.4, frame=11).video()
    if kind == "clocks":
        chain = edit(short_lived()).select(lambda model: np.arange(model.num_gaussians) % 2 == 0)
        return chain.retime(stretch=-1, about=0.5).select().freeze(3, frames=(2, 6)).video()
    return edit(model).apply(brighter).video()


def together(video, others, k, *, before=True):
    """Frame k of the clip with the splats of another video before it, or with those of each segment of another."""
    image = 0
    for number, share in video.weights(k):
        segment = video.segments[number]
        own = segment.model.at(float(segment.model.frame_times.times()[k - segment.first]))
        if isinstance(others, SegmentedVideo):
            model = others.segments[number].model
            other = model.at(float(model.frame_times.times()[k - segment.first]))
        else:
            other = others.at(k / (NUM_FRAMES - 1) if others.num_frames > 1 else 0.0, video.size)
        pair = (other, own) if before else (own, other)
        leaves = [
            np.concatenate([np.asarray(getattr(one, name)) for one in pair])
            for name in ("mean", "factor", "opacity", "color")
        ]
        image = image + share * cpu.forward(*leaves, BLACK, video.size, options=video.options).image
    return np.moveaxis(image, 0, -1)


@pytest.mark.parametrize(
    ("kind", "evenly"),
    [
        pytest.param("plain", False, marks=pytest.mark.slow),
        pytest.param("short-lived", False, marks=pytest.mark.slow),
        pytest.param("one frame", False, marks=pytest.mark.slow),
        pytest.param("plain", True, marks=pytest.mark.slow),
        pytest.param("spans", False, marks=pytest.mark.slow),
        ("spans", True),
        pytest.param("clocks", False, marks=pytest.mark.slow),
        ("function", False),
    ],
)
def test_each_frame_has_the_others_frame_over_it(kind, evenly):
    video = ground(evenly=evenly)
    over = front(kind)
    made = layers(over, video)
    assert isinstance(made, SegmentedVideo)
    assert made.num_gaussians == sum(segment.model.num_gaussians for segment in made.segments)
    if kind == "short-lived":  # a segment has no more of it than it shows
        assert made.num_gaussians < video.num_gaussians + 3 * over.num_gaussians - 50
    plain = np.stack([np.moveaxis(together(video, over, k), -1, 0) for k in range(NUM_FRAMES)])
    shown = np.stack([np.moveaxis(np.asarray(made.render(t)), -1, 0) for t in made.frame_times.times()])
    np.testing.assert_allclose(shown, plain, atol=2e-4)
    assert np.abs(shown[5] - np.moveaxis(video.render(1 / 3), -1, 0)).max() > 0.1
    behind = layers(video, over, timeline=0)
    np.testing.assert_allclose(behind.render(5 / 15), together(video, over, 5, before=False), atol=2e-4)


def test_one_segment_is_layered_as_the_model_to_the_bit():
    over, model = front("spans"), soft_model()
    wanted = layers(over, model)
    made = layers(over, SegmentedVideo.from_models([(0, model)]))
    assert not any(layer.clocks for layer in made.segments[0].model.layers)
    np.testing.assert_array_equal(list(made.frames()), list(wanted.frames()))


def test_two_clips_in_segments():
    one, other = ground(), ground(seed=5)
    made = layers(other, one)
    for k in (0, 5, 8, 11, 15):
        np.testing.assert_allclose(made.render(k / 15), together(one, other, k), atol=1e-4)


def test_layers_are_saved_and_edited_and_come_from_scripts(tmp_path):
    save_video_model(tmp_path / "front.safetensors", front("spans"))
    script = '[[layers]]\nmodel = "front.safetensors"\nwhere = "front"\n[camera]\nazimuth = 20'
    made = parse_edit_script(script, folder=tmp_path).apply(ground())
    wanted = edit(layers(front("spans"), ground())).seen_from(Camera.front(40 / 64).orbit(np.radians(20), 0.0)).video()
    np.testing.assert_array_equal(list(made.frames()), list(wanted.frames()))
    save_video_model(tmp_path / "made.safetensors", made)
    loaded = load_video_model(tmp_path / "made.safetensors")
    assert [len(segment.model.layers) for segment in loaded.segments] == [2, 2, 2]
    np.testing.assert_array_equal(list(loaded.frames()), list(made.frames()))
    gone = edit(loaded).select(layer=0).vanish().video()
    assert not np.array_equal(list(gone.frames()), list(loaded.frames()))


def test_models_are_loaded_when_they_are_drawn():
    loads = []

    def segment(first, model):
        one = Segment.from_model(first, model)
        return dataclasses.replace(one, load=lambda: loads.append(first) or model)

    video = ground()
    made = layers(front("plain"), SegmentedVideo([segment(part.first, part.model) for part in video.segments]))
    assert loads == list(FIRSTS)
    assert isinstance(made.segments[0].model, EditedVideo)
    assert loads == [*FIRSTS, 0]


@pytest.mark.parametrize(
    ("make", "match"),
    [
        (
            lambda: layers(ground(), soft_model()),
            "timeline: expected the number of the video in segments, got a VideoM",
        ),
        (
            lambda: layers(soft_model(), ground(), timeline=2),
            "timeline: expected the number of one of 2 videos, got 2",
        ),
        (
            lambda: layers(SegmentedVideo.from_models([(0, soft_model(num_frames=16))]), ground()),
            "videos: expected the segments of video 1, 0:7, 4:13, 10:16, got 0:16 in video 0",
        ),
        (lambda: layers(3, ground()), "video: expected a VideoModel or an EditedVideo, got int"),
        (lambda: layers(soft_model(size=(30, 64)), ground()), "frames of one aspect ratio"),
        (
            lambda: layers(edit(soft_model()).seen_from(Camera.front(1)).video(), ground()),
            "videos without a camera",
        ),
    ],
)
def test_mistakes(make, match):
    with pytest.raises(ValueError, match=match):
        make()
