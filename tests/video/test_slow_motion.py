"""Images between frames: the video's own and the prediction by optical flow, averaged where that is possible."""

import dataclasses

import numpy as np
import pytest
import scipy

from foldgauss.envelope import TimeLikelihood
from foldgauss.render import RenderOptions
from foldgauss.video import FitConfig, FrameTimes, VideoModel, edit, fit, interpolate_frames, interpolated_times, psnr
from foldgauss.video.models.splats import FoldedSplats
from foldgauss.video.motion.optical_flow import Motion

NUM_FRAMES, SIZE, SPEED = 6, (64, 96), 4.0  # pixels per frame


def textured() -> VideoModel:
    """Blobs that move to the right together, and shrink between frames as those do that live shortly."""
    rng = np.random.default_rng(0)
    num = 900
    time = np.clip(rng.integers(0, NUM_FRAMES, num) / (NUM_FRAMES - 1), 0.01, 0.99)
    velocity = SPEED * (NUM_FRAMES - 1) / max(SIZE)  # at time t a Gaussian is at loc + coefficient (m_t - t)
    splats = FoldedSplats(
        loc=np.float32(rng.uniform([-0.5, -0.35], [0.5, 0.35], (num, 2))),
        log_scale=np.full((num, 2), np.log(0.03), np.float32),
        angle_logit=np.zeros(num, np.float32),
        time_loc_logit=np.float32(np.log(time / (1 - time))),
        log_time_scale=np.full(num, np.log(0.07), np.float32),
        coefficients=np.float32(np.broadcast_to([[[-velocity, 0]]], (num, 1, 2))),
        opacity_logit=np.full(num, 1.0, np.float32),
        color_dc=np.float32(rng.uniform(-1.5, 1.5, (num, 3))),
        envelope=TimeLikelihood(np.float32(2), np.float32(0)),
    )
    return VideoModel(splats, FrameTimes.uniform(NUM_FRAMES), SIZE, 25.0, RenderOptions(), "over")


def panned(num_frames: int, size: tuple[int, int] = (128, 192)) -> np.ndarray:
    """A smooth random image that moves by 2 pixels per frame, with a disc that moves the other way."""
    rng = np.random.default_rng(4)
    image = scipy.ndimage.gaussian_filter(rng.uniform(0, 1, (size[0], size[1] + 2 * num_frames, 3)), (2, 2, 0))
    image = np.uint8(255 * (image - image.min()) / np.ptp(image))
    y, x = np.mgrid[: size[0], : size[1]]
    frames = [image[:, 2 * k : 2 * k + size[1]].copy() for k in range(num_frames)]
    for k, frame in enumerate(frames):
        frame[(x - 20 - 2 * k) ** 2 + (y - 32) ** 2 < 100] = (250, 120, 20)
    return np.stack(frames)


@pytest.fixture(scope="module")
def pan() -> VideoModel:
    return fit(panned(7)[::2], FitConfig(num_gaussians=4000, steps=200, seed=0)).model


def test_it_is_nearer_to_the_truth_than_the_gaussians_alone(pan):
    half_way = interpolated_times(np.asarray(pan.frame_times.times()), 2)[1::2]
    alone, averaged = (
        np.mean([psnr(truth, image) for truth, image in zip(panned(7)[1::2], images, strict=True)])
        for images in (pan.frames(half_way), interpolate_frames(pan, half_way))
    )
    assert averaged > alone + 0.3, (alone, averaged)


def test_images_between_frames_are_weighted_averages(pan):
    half_way = interpolated_times(np.asarray(pan.frame_times.times()), 2)[3:4]
    (own,), (shown,), frames = pan.frames(half_way), interpolate_frames(pan, half_way), np.stack(list(pan.frames()))
    predicted = Motion.from_frames(frames).interpolate(frames, 1, 0.5, pan.size)
    weight = 0.75 / (1 + predicted.difference / 4000)[..., None]
    assert np.ptp(weight) > 0.1
    np.testing.assert_allclose(shown, (1 - weight) * own + weight * np.clip(predicted.image, 0, 255), atol=0.6)


def test_frames_are_the_videos_own():
    model = textured()
    for own, shown in zip(model.frames(), interpolate_frames(model), strict=True):
        np.testing.assert_array_equal(shown, own)


def test_images_near_a_frame_are_like_it():
    model = textured()
    times = np.asarray(model.frame_times.times())
    near, at = interpolate_frames(model, np.array([times[2] + 0.002 * (times[3] - times[2]), times[2]]))
    assert np.abs(near.astype(int) - at).max() <= 6


def test_cuts_and_images_with_alpha_are_left_alone():
    model = textured()
    logits = np.array(model.frame_times.logits)
    logits[2] += np.log(100)
    cut = dataclasses.replace(model, frame_times=FrameTimes(logits))
    times = np.asarray(cut.frame_times.times())
    inside = np.linspace(times[2], times[3], 5)[1:-1].astype(np.float32)
    for own, shown in zip(cut.frames(inside), interpolate_frames(cut, inside), strict=True):
        np.testing.assert_array_equal(shown, own)
    half_way = interpolated_times(np.asarray(model.frame_times.times()), 2)[1::2]
    transparent = model.frames(half_way, background=None)
    for own, shown in zip(transparent, interpolate_frames(model, half_way, background=None), strict=True):
        assert shown.shape == (*SIZE, 4)
        np.testing.assert_array_equal(shown, own)


@pytest.mark.parametrize("order", ["backwards", "shuffled"])
def test_images_do_not_depend_on_their_order(order):
    model = textured()
    times = interpolated_times(np.asarray(model.frame_times.times()), 3)
    places = np.arange(len(times))[::-1] if order == "backwards" else np.random.default_rng(0).permutation(len(times))
    images = list(interpolate_frames(model, times))
    for place, shown in zip(places, interpolate_frames(model, times[places]), strict=True):
        np.testing.assert_array_equal(shown, images[place])


def test_other_sizes_edited_videos_and_few_frames():
    model = edit(textured()).move((0.1, 0.0), frames=(0, 3)).video()
    times = interpolated_times(np.asarray(model.frame_times.times()), 2)
    assert [image.shape for image in interpolate_frames(model, times[:4], (32, 48))] == 4 * [(32, 48, 3)]
    for num in (1, 2):
        few = dataclasses.replace(textured(), frame_times=FrameTimes.uniform(num))
        assert len(list(interpolate_frames(few, np.linspace(0, 1, 5)))) == 5


def test_bad_times_are_refused():
    with pytest.raises(ValueError, match="times: expected a list of times"):
        list(interpolate_frames(textured(), np.array([1.5])))
