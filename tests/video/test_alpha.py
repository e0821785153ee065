"""Frames with alpha: the fit learns alpha and not the background."""

import dataclasses
from collections import deque

import numpy as np
import pytest
from clips import moving_blobs

from foldgauss.video import FitConfig, evaluate, fit, fit_steps
from foldgauss.video.fitting.loop import start
from foldgauss.video.fitting.relocation import make_newborns
from foldgauss.video.fitting.schedule import to_planes
from foldgauss.video.models.background import check_background, composite, random_background
from foldgauss.video.models.renderer import VideoRenderer
from foldgauss.video.models.row_layout import columns

CONFIG = FitConfig(num_gaussians=400, steps=250)
WHITE, GREEN = (1.0, 1.0, 1.0), (0.0, 1.0, 0.0)


def clip():
    """A soft disc that moves, half transparent in its middle; premultiplied."""
    colors = moving_blobs(num_frames=5).astype(float)
    y, x = np.mgrid[0:48, 0:64]
    away = np.hypot(x - np.linspace(22, 42, 5)[:, None, None], y - 24)
    alpha = np.clip((16 - away) / 4, 0, 1) * np.where(away < 6, 0.5, 1.0)
    return np.concatenate([colors * alpha[..., None], 255 * alpha[..., None]], -1).round().astype(np.uint8)


@pytest.fixture(scope="module")
def fitted():
    return fit(clip(), CONFIG)


def test_composite_of_known_values():
    frame = np.array([[[100, 50, 0, 128], [0, 0, 0, 0], [9, 8, 7, 255], [0, 0, 0, 51]]], np.uint8)
    over = composite(frame, np.float32([1, 0.5, 0]))
    assert over.tolist() == [[[227, 114, 0], [255, 128, 0], [9, 8, 7], [204, 102, 0]]]
    np.testing.assert_array_equal(composite(frame, np.float32([0, 0, 0])), frame[..., :3])


def test_targets_are_the_frames_over_the_background():
    frame, background = clip()[2], np.float32([0.2, 0.7, 1.0])
    target = np.moveaxis(to_planes(frame, background), 0, -1)
    np.testing.assert_allclose(255 * target, composite(frame, background), atol=0.51)
    np.testing.assert_array_equal(
        to_planes(frame[..., :3].copy(), background), to_planes(frame[..., :3].copy(), 0 * background)
    )


def test_alpha_is_learned(fitted):
    frames = clip()
    scores = {color: evaluate(fitted.model, frames, background=color).mean_psnr for color in ((0, 0, 0), WHITE, GREEN)}
    assert min(scores.values()) > 30
    opaque = fit(frames[..., :3].copy(), CONFIG).model
    assert evaluate(opaque, frames).mean_psnr > 30
    assert evaluate(opaque, frames, background=WHITE).mean_psnr < 15  # a fit that saw black alone paints it
    assert abs(fitted.history[-1].psnr - np.mean(list(scores.values()))) < 3


def test_default_background_is_black(fitted):
    model = fitted.model
    black, white = next(model.frames()), next(model.frames(background=WHITE))
    assert black[0, 0].max() < 16
    assert white[0, 0].min() > 239
    np.testing.assert_array_equal(black, next(model.frames(background=(0, 0, 0))))
    slow = np.asarray(model.render(0.0, background=GREEN))
    np.testing.assert_allclose(255 * slow.clip(0, 1), VideoRenderer(model, background=GREEN).frame(0.0), atol=2)
    for wrong in ((0, 0), (0, 0, 2), "red", (0, 0, np.nan)):
        with pytest.raises(ValueError, match="background: expected red, green and blue"):
            check_background(wrong)


def test_backgrounds_depend_on_seed_and_step():
    one = random_background(0, 3)
    np.testing.assert_array_equal(one, random_background(0, 3))
    assert len({tuple(random_background(seed, step)) for seed in (0, 1) for step in range(50)}) == 100
    np.testing.assert_allclose(np.mean([random_background(0, k) for k in range(3000)], 0), 0.5, atol=0.03)  # 5 sigma


def test_without_a_background_images_have_alpha(fitted):
    """Over any color they are what is rendered over it."""
    model = fitted.model
    for k, image in enumerate(model.frames(background=None)):
        assert image.shape == (*model.size, 4)
        assert image[..., 3].min() < 100 < 200 < image[..., 3].max()
        over = next(model.frames(model.frame_times.times()[k : k + 1], background=GREEN))
        assert np.abs(composite(image, np.float32(GREEN)).astype(int) - over).max() <= 2
    whole = np.asarray(model.render(frame=0, background=None))
    expected = next(model.frames(background=None)) / 255
    np.testing.assert_allclose(np.clip(whole, 0, 1), expected, atol=0.01)
    sums = dataclasses.replace(model, compositing="sum")
    with pytest.raises(ValueError, match="background: expected black"):
        next(sums.frames(background=None))


def test_gaussians_start_and_are_added_where_a_clip_is_not_transparent():
    frames = np.zeros((6, 60, 90, 4), np.uint8)
    frames[:4, 20:32, 30:45] = [120, 60, 30, 255]  # and nothing in the last two
    frames[:4, 20:32:2, 30:45, :3] = [20, 90, 160]
    config = FitConfig(num_gaussians=300, steps=200, quality=70.0, seed=1)
    state = start(frames, config)
    before = np.array(state.leaf("loc")) * 90 + [45, 30]
    inside = (before > [29, 19]).all(1) & (before < [46, 33]).all(1)
    assert inside.all()
    ((state, _),) = deque(fit_steps(frames, config), maxlen=1)
    new = make_newborns(200, state, frames, config, None)
    at, size = columns(config.fold_degree)["loc"], columns(config.fold_degree)["log_scale"]
    places = new[:, at] * 90 + [45, 30]
    assert ((places > [29, 19]).all(1) & (places < [46, 33]).all(1)).all()
    assert np.median(np.exp(new[:, size])) * 90 < 1.5  # pixels; as far apart as Gaussians are where there are any
