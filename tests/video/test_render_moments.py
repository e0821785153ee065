"""`render` of all videos by time, by frame and by seconds: the same moments, and what is none."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from soft_models import soft_model

from foldgauss.video import FrameTimes, SegmentedVideo, edit, times_at
from foldgauss.video.models.frame_times import make_time_logits
from foldgauss.video.models.renderer import VideoRenderer

NUM = 7


def learned_model(logits=None):
    """Uneven frame times, at 8 frames a second."""
    logits = 0.5 * np.random.default_rng(0).standard_normal(NUM - 1) if logits is None else logits
    return dataclasses.replace(
        soft_model(num_frames=len(logits) + 1), frame_times=FrameTimes(np.float32(logits)), fps=8.0
    )


VIDEOS = {
    "model": learned_model,
    "edited": lambda: edit(learned_model()).rotate(0.3, frames=(2, 4)).video(),
    "segmented": lambda: SegmentedVideo.from_models([(0, learned_model()), (5, learned_model())]),
    "with a cut": lambda: learned_model(make_time_logits(NUM, [3])),
    "edited, with a cut": lambda: edit(learned_model(make_time_logits(NUM, [3]))).rotate(0.3, frames=(2, 4)).video(),
    "one frame": lambda: learned_model(np.zeros(0)),
}


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.slow if "with a cut" in name else []) for name in VIDEOS]
)
def test_frames_are_those_of_their_learned_times(name):
    video = VIDEOS[name]()
    times, num = np.asarray(video.frame_times.times()), video.num_frames
    images = [np.asarray(video.render(frame=k)) for k in range(num)]
    for k, image in enumerate(images):
        np.testing.assert_array_equal(image, video.render(times[k]))
        np.testing.assert_array_equal(image, video.render(time=times[k]))
        np.testing.assert_array_equal(image, video.render(frame=np.int64(k - num)))
        np.testing.assert_allclose(image, np.moveaxis(VideoRenderer(video).image(times[k]), 0, -1), atol=2e-5)
        np.testing.assert_allclose(video.render(seconds=k / video.fps), image, atol=1e-5)
    assert num == 1 or np.abs(images[1] - images[0]).max() > 1e-3


@pytest.mark.parametrize("name", VIDEOS)
def test_seconds_between_frames(name):
    """As `times_at` interpolates frame positions; the last frame stays until the clip's end."""
    video = VIDEOS[name]()
    times, num = np.asarray(video.frame_times.times()), video.num_frames
    for position in np.arange(0.25, num - 1, 0.75):
        at = video.render(times_at(times, position))
        np.testing.assert_allclose(video.render(seconds=position / video.fps), at, atol=1e-5)
    for seconds in ((num - 0.5) / video.fps, num / video.fps):
        np.testing.assert_array_equal(video.render(seconds=seconds), video.render(frame=-1))
    np.testing.assert_array_equal(video.render(seconds=0), video.render(0.0))


@pytest.mark.parametrize("name", ["with a cut", "edited, with a cut"])
def test_between_shots_the_nearer_frame_is_shown(name):
    video = VIDEOS[name]()
    times = np.asarray(video.frame_times.times())
    for share, k in ((0.1, 2), (0.9, 3)):
        t = (1 - share) * times[2] + share * times[3]
        np.testing.assert_allclose(video.render(float(t)), video.render(frame=k), atol=1e-6)
        np.testing.assert_array_equal(VideoRenderer(video).frame(t), VideoRenderer(video).frame(times[k]))


def test_size_is_still_the_second_argument():
    for video in (VIDEOS["model"](), VIDEOS["edited"]()):
        small = video.render(0.5, (20, 30))
        assert small.shape == (20, 30, 3)
        assert video.render(frame=3, size=(20, 30), background=(1, 1, 1)).shape == (20, 30, 3)


BOTH = r"expected exactly one of time, frame and seconds, got"
WRONG_MOMENTS = [
    ({}, TypeError, rf"{BOTH} none\.$"),
    ({"time": 0.0, "frame": 0}, TypeError, rf"{BOTH} time and frame\.$"),
    ({"frame": 0, "seconds": 0}, TypeError, rf"{BOTH} frame and seconds\.$"),
    *(
        ({"frame": k}, IndexError, r"^frame: expected a number from -{num} to {last} of {num} frames")
        for k in (99, -99)
    ),
    *(({"frame": k}, ValueError, r"^frame: expected the number of a frame, .*use time or") for k in (2.5, "1", True)),
    *(
        ({"seconds": s}, ValueError, r"^seconds: expected seconds in \[0, {end:g}\], as {num} frames at 8")
        for s in (-0.1, 99.0, float("nan"), "x")
    ),
    ({"time": 5}, ValueError, r"^time: expected a time in \[0, 1\], got 5.*render\(frame=k\)"),
    ({"time": [0.1, 0.2]}, ValueError, r"^time: expected one time in \[0, 1\], got \[0.1, 0.2\]"),
]


@pytest.mark.parametrize(("moment", "error", "message"), WRONG_MOMENTS)
@pytest.mark.parametrize("name", ["model", "edited", "segmented"])
def test_errors(name, moment, error, message):
    video = VIDEOS[name]()
    num = video.num_frames
    with pytest.raises(error, match=message.format(num=num, last=num - 1, end=num / 8)):
        video.render(**moment)


@pytest.mark.parametrize("name", ["model", "edited", "segmented"])
def test_frames_and_seconds_end_where_the_clip_does(name):
    video = VIDEOS[name]()
    num = video.num_frames
    for beyond, error in (({"frame": num}, IndexError), ({"frame": -num - 1}, IndexError)):
        with pytest.raises(error, match=rf"got {beyond['frame']}\.$"):
            video.render(**beyond)
    with pytest.raises(ValueError, match=r"^seconds: expected"):
        video.render(seconds=num / 8 + 0.01)


@pytest.mark.parametrize("moment", [pytest.param({"frame": 2}, marks=pytest.mark.slow), {"seconds": 0.3}])
def test_learned_times_have_gradients(moment):
    def loss(logits):
        model = dataclasses.replace(learned_model(), frame_times=FrameTimes(logits))
        return jnp.sum(model.render(**moment) ** 2)

    gradient = jax.jit(jax.grad(loss))(jnp.asarray(learned_model().frame_times.logits))
    assert bool(jnp.isfinite(gradient).all())
    assert float(jnp.abs(gradient).max()) > 1e-4
