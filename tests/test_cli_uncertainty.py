"""`foldgauss uncertainty`: what it leaves, what it refuses, and that a killed run loses nothing."""

import csv
import os
import shutil

import cv2
import numpy as np
import pytest
from commands import call, full_disk, run
from tiny_clips import NUM_FRAMES, TWICE, write_both

from foldgauss.cli.measuring import uncertainty as command
from foldgauss.io import write_frames

for name in ("emcee", "h5py", "h5netcdf", "matplotlib"):
    pytest.importorskip(name, reason="an optional extra")

PICTURES = {"correlation.png", "increments.png", "times.png"}
FILES = {"chains.h5", "frame_times.csv", "posterior.nc", "summary.md"} | PICTURES
#: Enough for two looks at convergence.
SHORT = ["--steps", "700", "--ensembles", "2"]


@pytest.fixture(scope="module")
def work(tmp_path_factory):
    folder = tmp_path_factory.mktemp("uncertainty")
    write_both(folder)
    return folder


@pytest.fixture(scope="module")
def done(work):
    """A run to the end of its steps."""
    target = work / "results" / "short"
    assert run("uncertainty", work / "model.safetensors", work / "clip", "--out", target, *SHORT) == 0
    return target


@pytest.fixture
def no_pictures(monkeypatch):
    """Empty files in place of the pictures, which take seconds: `test_everything_is_there` looks at them."""
    monkeypatch.setattr(command, "write_figure", lambda path, draw, size: path.touch())


def arguments(work, target, *options):
    return ["uncertainty", work / "model.safetensors", work / "clip", "--out", target, *options]


def table_of(folder):
    with open(folder / "frame_times.csv", newline="") as file:
        return list(csv.DictReader(file))


def draws_of(folder):
    import h5py

    with h5py.File(folder / "chains.h5") as file:
        return [file[name]["chain"][: file[name].attrs["iteration"]] for name in sorted(file)]


def test_everything_is_there(done):
    assert {path.name for path in done.iterdir()} == FILES
    rows = table_of(done)
    assert [int(row["frame"]) for row in rows] == list(range(NUM_FRAMES))
    assert float(rows[TWICE + 1]["mean"]) - float(rows[TWICE]["mean"]) < 0.01 / (NUM_FRAMES - 1) * 5
    for row in rows[5:9]:
        assert float(row["low_90"]) < float(row["low_50"]) < float(row["high_50"]) < float(row["high_90"])
        assert float(row["std"]) == pytest.approx(float(row["exact_std"]), rel=0.4)
        assert float(row["r_hat"]) < 1.2
        assert row["identified"] == "1"
    assert rows[0]["r_hat"] == rows[0]["tau"] == "nan"  # fixed
    told = (done / "summary.md").read_text()
    first_and_last = "The first frame at 0 and the last at 1."
    for text in (f"| {TWICE}, {TWICE + 1} | duplicated |", "The splats, held", first_and_last):
        assert text in told
    for name in PICTURES:
        assert cv2.imread(str(done / name)).std() > 5


def test_arviz_reads_the_draws(done):
    from foldgauss._runtime.optional_imports import import_optional

    data = import_optional("arviz", "uncertainty").from_netcdf(str(done / "posterior.nc"))
    t = data.posterior["t"]
    assert set(t["ensemble"].values) == {0, 1}
    assert t.sizes["chain"] > 20  # one for each walker
    assert t.sizes["frame"] == NUM_FRAMES
    assert {"w"} < set(data.posterior)
    rows = table_of(done)
    np.testing.assert_allclose(t.mean(("chain", "draw")), [float(row["mean"]) for row in rows], atol=2e-4)
    assert data.posterior.attrs.get("message", data.attrs.get("message"))


def test_a_finished_run_says_so_and_others_are_kept(work, done, no_pictures):
    before = (done / "chains.h5").read_bytes()
    call(*arguments(work, done, *SHORT), out="was complete: nothing was sampled")
    assert (done / "chains.h5").read_bytes() == before
    for other in (["--seed", "1"], ["--concentration", "2"], ["--noise", "independent"]):
        table = (done / "frame_times.csv").read_bytes()
        call(*arguments(work, done, *SHORT, *other), code=2, err=["--out: expected", "--overwrite"])
        assert (done / "frame_times.csv").read_bytes() == table
        assert (done / "chains.h5").read_bytes() == before
    assert {path.name for path in done.iterdir()} == FILES


def test_tables_for_a_full_disk_are_kept(work, done, tmp_path, monkeypatch, no_pictures):
    target = shutil.copytree(done, tmp_path / "short")
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    with full_disk(lambda path: path.parent == target and path.name != "chains.h5"):
        told = call(*arguments(work, target, *SHORT), code=1)
    (kept,) = tmp_path.glob("foldgauss-*/short")
    assert f"It is kept in {kept}" in " ".join(told.err.split())
    assert table_of(kept) == table_of(done)


def test_more_steps_go_on_and_overwriting_starts_anew(work, tmp_path, no_pictures):
    target = tmp_path / "results"
    few = ["--steps", "60", "--ensembles", "2"]
    call(*arguments(work, target, *few), err="Not converged after 60 steps")
    first = draws_of(target)
    assert run(*arguments(work, target, *few, "--steps", "100")) == 0
    for one, other in zip(first, draws_of(target), strict=True):
        assert len(one) == 6
        assert len(other) == 10
        np.testing.assert_array_equal(one, other[:6])
    assert run(*arguments(work, target, *few, "--seed", "5", "--overwrite")) == 0
    assert not np.array_equal(draws_of(target)[0], first[0])
    (target / "chains.h5").unlink()
    call(*arguments(work, target, *few), code=2, err="no chains.h5 of a run of uncertainty")


def test_a_clip_of_something_else(work, tmp_path):
    noise = np.random.default_rng(0).integers(0, 255, (12, 40, 64, 3)).astype(np.uint8)
    clip, out = write_frames(tmp_path / "clip", noise), tmp_path / "out"
    told = "VIDEO: expected frames of which the model explains 20%"
    call("uncertainty", work / "model.safetensors", clip, "--out", out, code=2, err=told)
    assert os.listdir(out) == []
