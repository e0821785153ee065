"""PSNR and SSIM follow their usual definitions."""

import numpy as np
import pytest
from clips import moving_blobs
from test_conditioning import SIZE, random_splats

from foldgauss._runtime.threads import set_num_threads
from foldgauss.render import RenderOptions
from foldgauss.video import FrameTimes, VideoModel, evaluate, psnr, ssim


def test_psnr_of_known_error():
    black = np.zeros((20, 20, 3), np.uint8)
    assert psnr(black, black + 10) == pytest.approx(20 * np.log10(255 / 10))
    assert psnr(black, black) == 100


def test_ssim_of_equal_and_of_unrelated_pictures():
    one, other = moving_blobs()[0], np.random.default_rng(0).integers(0, 256, (48, 64, 3)).astype(np.uint8)
    assert ssim(one, one) == pytest.approx(1)
    assert ssim(one, other) < 0.2


def test_evaluate_compares_frame_by_frame():
    model = VideoModel(random_splats(), FrameTimes.uniform(3), SIZE, 25.0, RenderOptions())
    frames = np.stack(list(model.frames()))
    assert frames.dtype == np.uint8
    seen = []
    scores = evaluate(model, frames, seen.append)
    assert scores.psnr == (100, 100, 100)
    np.testing.assert_array_equal(seen, frames)
    assert evaluate(model, frames[::-1].copy()).psnr[1] == 100
    assert evaluate(model, frames[::-1].copy()).psnr[0] < 50
    with pytest.raises(ValueError, match="frames"):
        evaluate(model, frames[:2])
    with pytest.raises(ValueError, match=r"^frames: expected uint8 .*got list\."):
        evaluate(model, list(frames))


@pytest.mark.parametrize("threads", [1, 2, 4])
def test_frames_that_are_compared_at_once_have_their_own_scores(threads):
    model = VideoModel(random_splats(), FrameTimes.uniform(5), SIZE, 25.0, RenderOptions())
    frames = np.stack(list(model.frames()))[::-1].copy()
    set_num_threads(threads)
    try:
        scores = evaluate(model, frames)
    finally:
        set_num_threads(None)
    pairs = list(zip(frames, model.frames(), strict=True))
    assert scores.psnr == tuple(psnr(*pair) for pair in pairs)
    assert scores.ssim == tuple(ssim(*pair) for pair in pairs)


def test_frames_at_other_times_and_sizes():
    model = VideoModel(random_splats(), FrameTimes.uniform(3), SIZE, 25.0, RenderOptions())
    (picture,) = model.frames(np.array([0.37]), (96, 160))
    assert picture.shape == (96, 160, 3)
    small = np.asarray(model.render(0.37))
    halved = picture.reshape(48, 2, 80, 2, 3).mean((1, 3)) / 255
    assert np.abs(halved - small).mean() < 0.05  # the same picture, finer
