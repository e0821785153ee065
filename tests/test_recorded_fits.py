"""Fits keep their bits, and model files of earlier versions keep loading."""

import dataclasses
import hashlib
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import recorded_fits

from foldgauss.io import load_selection, load_video_model, read_vegas_ply
from foldgauss.video import Economy, FitConfig, LearningRates
from foldgauss.video.fitting.config import rename_options, rename_settings

DATA = Path(__file__).parent / "data" / "v0.1"
RECORDED = json.loads((DATA / "fits.json").read_text())
PICTURES = json.loads((DATA / "expected.json").read_text())
#: dB by which fits on other processors or with other versions differ at most: rounding, amplified over the steps.
ELSEWHERE_DB = 0.5


@pytest.fixture(scope="module")
def now():
    """Recorded in a process of its own, compiled as for users: see conftest.py."""
    settings = {"JAX_DISABLE_MOST_OPTIMIZATIONS", "XLA_FLAGS"}
    environment = {name: value for name, value in os.environ.items() if name not in settings}
    command = [sys.executable, recorded_fits.__file__]
    return json.loads(subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stdout)


@pytest.mark.parametrize("name", RECORDED["digests"])
def test_fit_has_the_recorded_bits(now, name):
    """Equal to the bit on the recorded kind of machine with the recorded versions; elsewhere, as good.

    What is compressed depends on the kernels that BLAS chooses for the processor, too.
    """
    same_machine = now["machine"] == RECORDED["machine"]
    if same_machine and (name != "compact" or now["blas"] == RECORDED["blas"]):
        assert now["digests"][name] == RECORDED["digests"][name]
    else:
        assert abs(now["psnr"][name] - RECORDED["psnr"][name]) < ELSEWHERE_DB


@pytest.mark.parametrize("name", PICTURES)
def test_model_file_of_an_earlier_version_renders_as_recorded(name):
    frames = np.stack(list(load_video_model(DATA / name).frames()))
    recorded = PICTURES[name]
    assert len(frames) == recorded["num_frames"]
    # Other processors round differently: by a level here and there, not in the mean.
    np.testing.assert_allclose(frames.mean((1, 2, 3)), recorded["mean"], atol=0.02)
    same_machine = recorded_fits.machine() == RECORDED["machine"]
    digest = hashlib.blake2b(frames.tobytes(), digest_size=16).hexdigest()
    assert digest == recorded["digest"] or not same_machine


def test_selection_and_ply_of_an_earlier_version_load():
    model = load_video_model(DATA / "plain.safetensors")
    selection = load_selection(DATA / "selection.safetensors", model)
    assert 0 < np.count_nonzero(selection.mask) < model.num_gaussians
    assert read_vegas_ply(DATA / "vegas.ply").num_gaussians == model.num_gaussians


#: Defaults that were others in v0.1; it knew no learning rates in units of each Gaussian's size.
EARLIER = FitConfig(
    rates=LearningRates(
        loc=6.9e-4,
        coefficients=4e-3,
        log_scale=0.06,
        angle_logit=0.06,
        opacity_logit=0.15,
        color_dc=0.06,
        time_loc_logit=0.04,
        log_time_scale=0.1,
        frame_times=3e-3,
    ),
    final_rate=0.07,
    quarter_fraction=0.2,
    half_fraction=0.4,
    interpolation_fraction=0.0,
)
#: Settings that v0.1 did not have.
LATER = (
    "border_weight",
    "scale_rates_by_size",
    "cooldown_fraction",
    "error_fraction",
    "relocated_fraction",
    "interpolation_end",
    "follow_camera",
    "scale_cutoff",
)


def test_settings_in_records_of_an_earlier_version_are_read():
    recorded = json.loads((DATA / "settings.json").read_text())
    changes = {"economy": Economy(), "scale_rates_by_duration": False, "interpolation_fraction": 0.25}
    for name, config in {"default": EARLIER, "economy": dataclasses.replace(EARLIER, **changes)}.items():
        expected = json.loads(json.dumps(dataclasses.asdict(config)))
        for later in LATER:
            del expected[later]
        del expected["rates"]["paths"]
        assert rename_settings(recorded[name]) == expected
    assert rename_settings(["own_time"]) == ["own_time"]
    assert rename_options("fit a.mp4 --ssim-share 0.1 --steps 5") == "fit a.mp4 --ssim-fraction 0.1 --steps 5"
