"""A fit that is stopped and resumed from its checkpoint has the bits of one that was not."""

import dataclasses

import jax
import numpy as np
import pytest
from clips import moving_blobs
from test_alpha import clip as alpha_clip
from test_device import CONFIG as ON_DEVICE
from test_device import FRAMES as DEVICE_FRAMES
from test_device import GROWING as GROWING_ON_DEVICE
from test_follow_camera import FRAMES as SHAKEN
from test_follow_camera import WITH_OBJECT
from test_growth import CONFIG as GROWING
from test_growth import FRAMES as GROWING_FRAMES

from foldgauss.io.models.checkpoint import load_checkpoint, save_checkpoint
from foldgauss.video import FitConfig, Growth, fit_steps

BLOBS = moving_blobs()
PLAIN = FitConfig(num_gaussians=300, steps=60)
SHORT = dataclasses.replace(PLAIN, steps=24, degree=2)
PAPER = FitConfig.preset("paper", num_gaussians=300, degree=3, steps=450)
#: Frames, settings, the steps after which the fit stops, and the last step that is compared.
FITS = {
    "frames alone": (BLOBS, PLAIN.replace(**{"views.interpolation_fraction": 0.0}), (25,), 60),
    "interpolated frames": (BLOBS, PLAIN.replace(**{"views.interpolation_fraction": 0.5}), (25,), 60),
    "beside relocations": (BLOBS, dataclasses.replace(PLAIN, steps=120), (23, 24, 42), 120),
    "beside births and resets": (GROWING_FRAMES, GROWING, (10, 45), 60),
    "the paper's, after a reset": (moving_blobs(4, 24, 40), PAPER, (215,), 300),
    "alpha": (alpha_clip(), dataclasses.replace(PLAIN, steps=30), (12,), 30),
    "camera": (SHAKEN, SHORT, (10,), 24),
    "camera and object": (WITH_OBJECT, SHORT, (10,), 24),
    "camera, on a device": (SHAKEN, dataclasses.replace(SHORT, engine="xla"), (10,), 24),
    "on a device": (DEVICE_FRAMES, dataclasses.replace(ON_DEVICE, steps=40), (23,), 40),
    "growing on a device": (DEVICE_FRAMES, GROWING_ON_DEVICE, (23,), 34),
}
#: Each of these is another with less, or takes longer; the long runs take them.
SLOW = ("frames alone", "the paper's, after a reset", "camera", "camera, on a device", "growing on a device")
NAMES = [pytest.param(name, marks=[pytest.mark.slow] if name in SLOW else []) for name in FITS]


@pytest.mark.parametrize("name", NAMES)
def test_resuming_keeps_the_bits(name, tmp_path, monkeypatch):
    frames, config, stops, last = FITS[name]
    if config is GROWING:  # its schedule is that of these steps
        monkeypatch.setattr(Growth, "for_plan", lambda self, plan: self)
    for state, info in fit_steps(frames, config):
        if info.step in stops:
            save_checkpoint(tmp_path / str(info.step), state, config=config, source={})
        if info.step == last:
            break
    for stop in stops:
        kept = load_checkpoint(tmp_path / str(stop), config=config, source={})
        for again, told in fit_steps(frames, config, kept):
            if told.step == last:
                break
        assert (told.step, told.psnr, told.loss) == (last, info.psnr, info.loss)
        jax.tree.map(np.testing.assert_array_equal, leaves_of(again), leaves_of(state))


def leaves_of(state):
    """All arrays, from a device too."""
    return {name: np.array(getattr(state, name)) for name in state.array_fields()}
