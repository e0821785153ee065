"""Images between frames: the video's own and the prediction by optical flow, averaged where that is possible."""

import dataclasses

import numpy as np
import pytest
import scipy
from tiny_clips import model_of_12

from foldgauss.video import (
    FitConfig,
    FrameTimes,
    VideoModel,
    edit,
    fit,
    interpolate_frames,
    interpolated_times,
    psnr,
)
from foldgauss.video.motion.optical_flow import Motion


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
def model() -> VideoModel:
    """Four frames."""
    return fit(panned(7)[::2], FitConfig(num_gaussians=4000, steps=200, seed=0)).model


def half_way(video) -> np.ndarray:
    return interpolated_times(np.asarray(video.frame_times.times()), 2)[1::2]


def test_it_is_nearer_to_the_truth_than_the_gaussians_alone(model):
    alone, averaged = (
        np.mean([psnr(truth, image) for truth, image in zip(panned(7)[1::2], images, strict=True)])
        for images in (model.frames(half_way(model)), interpolate_frames(model, half_way(model)))
    )
    assert averaged > alone + 0.3, (alone, averaged)


def test_images_between_frames_are_weighted_averages(model):
    """In each interval, by the flow of the four frames around; less of the prediction where the frames disagree."""
    frames = np.stack(list(model.frames()))
    own, shown = model.frames(half_way(model)), interpolate_frames(model, half_way(model))
    for k, (one, other) in enumerate(zip(own, shown, strict=True)):
        around, inner = frames[max(k - 1, 0) : k + 3], min(k, 1)
        predicted = Motion.from_frames(around).interpolate(around, inner, 0.5, model.size)
        weight = 0.75 / (1 + predicted.difference / 4000)[..., None]
        assert np.ptp(weight) > 0.1
        expected = (1 - weight) * one + weight * np.clip(predicted.image, 0, 255)
        np.testing.assert_allclose(other, expected, atol=0.6, err_msg=f"after frame {k}")


def test_images_near_a_frame_are_like_it(model):
    times = np.asarray(model.frame_times.times())
    near = times[2] + np.array([0.0005, 0.002]) * (times[3] - times[2])
    (own,), (at,) = model.frames(near[:1]), model.frames(times[2:3])
    exact, shown = interpolate_frames(model, near)
    np.testing.assert_array_equal(exact, own)
    assert np.abs(shown.astype(int) - at).mean() < 0.2


def test_cuts_and_images_with_alpha_are_left_alone(model):
    logits = np.array(model.frame_times.logits)
    logits[2] += np.log(100)
    cut = dataclasses.replace(model, frame_times=FrameTimes(logits))
    times = np.asarray(cut.frame_times.times())
    inside = np.linspace(times[2], times[3], 5)[1:-1].astype(np.float32)
    for own, shown in zip(cut.frames(inside), interpolate_frames(cut, inside), strict=True):
        np.testing.assert_array_equal(shown, own)
    transparent = model.frames(half_way(model), background=None)
    for own, shown in zip(transparent, interpolate_frames(model, half_way(model), background=None), strict=True):
        assert shown.shape == (*model.size, 4)
        np.testing.assert_array_equal(shown, own)


@pytest.mark.parametrize(
    "order", ["shuffled", *(pytest.param(order, marks=pytest.mark.slow) for order in ("backwards", "one by one"))]
)
def test_images_do_not_depend_on_their_order(model, order):
    times = interpolated_times(np.asarray(model.frame_times.times()), 3)
    images = list(interpolate_frames(model, times))
    assert sum(not np.array_equal(*pair) for pair in zip(images, model.frames(times), strict=True)) == 6
    if order == "one by one":
        for t, image in zip(times, images, strict=True):
            np.testing.assert_array_equal(next(interpolate_frames(model, np.array([t]))), image)
        return
    places = np.arange(len(times))[::-1] if order == "backwards" else np.random.default_rng(0).permutation(len(times))
    for place, shown in zip(places, interpolate_frames(model, times[places]), strict=True):
        np.testing.assert_array_equal(shown, images[place])


def test_other_sizes_edited_videos_and_few_frames(model):
    edited = edit(model).move((0.1, 0.0), frames=(0, 3)).video()
    images, own = (list(draw(half_way(model)[:2], (64, 96))) for draw in (_interpolate(edited), edited.frames))
    assert [image.shape for image in images] == 2 * [(64, 96, 3)]
    assert not np.array_equal(images, own)
    for num in (1, 2):
        few = dataclasses.replace(model, frame_times=FrameTimes.uniform(num))
        assert len(list(interpolate_frames(few, np.linspace(0, 1, 5)))) == 5


def _interpolate(video):
    return lambda times, size: interpolate_frames(video, times, size)


def test_images_too_large_for_the_flow_are_the_videos_own():
    """OpenCV moves images of fewer than 2^15 - 1 pixels on each side."""
    small = model_of_12()
    t = half_way(small)[3:4]
    for width, same in ((2**15 - 2, False), (2**15 - 1, True)):
        (own,), (shown,) = small.frames(t, (2, width)), interpolate_frames(small, t, (2, width))
        assert np.array_equal(shown, own) == same


def test_pairs_are_joined_to_the_motion_of_all(model):
    frames = panned(4)
    joined, whole = Motion.join([Motion.from_frames(frames[k : k + 2]) for k in range(3)]), Motion.from_frames(frames)
    assert (joined.size, joined.miss) == (whole.size, whole.miss)
    for name in ("small", "there", "back"):
        np.testing.assert_array_equal(getattr(joined, name), getattr(whole, name))


def test_bad_times_are_refused(model):
    with pytest.raises(ValueError, match="times: expected a time in"):
        list(interpolate_frames(model, np.array([1.5])))
