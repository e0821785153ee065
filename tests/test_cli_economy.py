"""`foldgauss fit --economy` and `--smallest-at-psnr` as a user meets them."""

import json

import numpy as np
import pytest
from commands import run

from foldgauss.io import load_video_model, write_video


@pytest.fixture(scope="module")
def clip(tmp_path_factory):
    """Eight frames of a disc that moves over one color, as PNG."""
    folder = tmp_path_factory.mktemp("clip") / "disc"
    y, x = np.mgrid[0:40, 0:64]
    disc = np.stack([np.hypot(x - 12 - 5 * k, y - 20) < 8 for k in range(8)])[..., None]
    write_video(folder, np.where(disc, (230, 80, 40), (60, 90, 120)).astype(np.uint8), 12)
    return folder


def test_what_pays_and_what_it_tells(clip, tmp_path, capsys):
    out = tmp_path / "model.safetensors"
    assert run("fit", clip, "--out", out, "--gaussians", 150, "--steps", 200, "--economy") == 0
    assert "pruned by description length" in capsys.readouterr().out
    assert run("info", out) == 0
    told = capsys.readouterr().out
    assert "degrees" in told
    assert "throughout the clip" in told
    model = load_video_model(out)
    assert model.num_parameters < 17 * model.num_gaussians


def test_the_smallest_at_a_psnr(clip, tmp_path, capsys):
    out, figures = tmp_path / "model.safetensors", tmp_path / "figures.json"
    assert run("fit", clip, "--out", out, "--gaussians", 150, "--steps", 300, "--smallest-at-psnr", 30) == 0
    shown = capsys.readouterr()
    assert "the smallest at 30 dB" in shown.out
    assert "smallest_at_psnr" in shown.out
    assert "warning" not in shown.err
    assert run("evaluate", out, clip, "--json", figures) == 0
    assert json.loads(figures.read_text())["mean_psnr"] >= 30


def test_a_psnr_out_of_reach_is_told(clip, tmp_path, capsys):
    out = tmp_path / "model.safetensors"
    assert run("fit", clip, "--out", out, "--gaussians", 20, "--steps", 20, "--smallest-at-psnr", 70) == 0
    assert "warning: --smallest-at-psnr: 70 dB was not reached, got" in " ".join(capsys.readouterr().err.split())
    assert load_video_model(out).num_gaussians >= 1


@pytest.mark.parametrize(
    ("options", "told"),
    [
        (("--smallest-at-psnr", 0), "--smallest-at-psnr: expected a number in (0, 100], got 0.0"),
        (("--economy", "--target-psnr", 30), "--target-psnr: expected None with an economy"),
        (("--economy", "--compositing", "sum"), "--compositing: expected 'over' with an economy, got 'sum'"),
    ],
)
def test_what_does_not_go_together(clip, tmp_path, capsys, options, told):
    out = tmp_path / "model.safetensors"
    assert run("fit", clip, "--out", out, *options) == 2
    assert told in " ".join(capsys.readouterr().err.split())
    assert not out.exists()
