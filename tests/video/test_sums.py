"""Sum compositing: fits, renders, and what it refuses."""

import dataclasses

import numpy as np
import pytest
from clips import moving_blobs

from foldgauss.video import FitConfig, evaluate, fit
from foldgauss.video.fitting.loop import start, to_model


def test_sums_are_fitted_and_rendered_as_sums(tmp_path):
    frames = moving_blobs()
    config = FitConfig(num_gaussians=400, steps=300, compositing="sum")
    model = fit(frames, config).model
    assert model.compositing == "sum"
    assert evaluate(model, frames).mean_psnr > 30
    over = dataclasses.replace(model, compositing="over")
    assert evaluate(over, frames).mean_psnr < 28
    np.testing.assert_allclose(
        np.clip(np.asarray(model.render(0.5)) * 255, 0, 255), next(iter(model.frames(np.array([0.5])))), atol=1.01
    )
    order = np.random.default_rng(0).permutation(400)
    state = start(frames, config)
    shuffled = dataclasses.replace(state, rows=state.rows[order])
    one, other = (np.asarray(to_model(each, config, frames.shape[1:3], 25.0).render(0.3)) for each in (state, shuffled))
    np.testing.assert_allclose(one, other, atol=1e-5)


def test_sums_are_rendered_over_black_only():
    config = FitConfig(num_gaussians=50, steps=1, compositing="sum")
    model = to_model(start(moving_blobs(), config), config, (48, 64), 25.0)
    for draw in (lambda: model.render(0.5, background=(1, 1, 1)), lambda: next(model.frames(background=(1, 1, 1)))):
        with pytest.raises(ValueError, match=r"^background: expected black for a model fitted with compositing 'sum'"):
            draw()
