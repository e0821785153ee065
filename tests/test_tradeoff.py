"""Speed against accuracy: fronts, knees, plans, and `foldgauss tradeoff` as a user meets it."""

import json
import math
import os
import signal
import sys
from pathlib import Path
from unittest.mock import Mock

import cv2
import numpy as np
import pytest
from commands import call, full_disk, run

from foldgauss.analysis.plot import Panel, plot_tradeoff
from foldgauss.cli.measuring import tradeoff as command
from foldgauss.io import load_video_model, read_video, write_video
from foldgauss.io.models.video_model import read_metadata
from foldgauss.jobs import runner
from foldgauss.video import FitDiverged, evaluate, tradeoff
from foldgauss.video.tradeoff import (
    AXES,
    check_axes,
    knee,
    pareto_front,
)

SIZE, FRAMES = (24, 32), 6
QUICK = ["--steps", "12"]
#: Of the same number of frames: what is compiled for one serves all.
SAME = ["--frames", "1:6", *QUICK]


@pytest.fixture(scope="module")
def clip(tmp_path_factory):
    """Six frames of a blob that moves."""
    y, x = np.mgrid[0 : SIZE[0], 0 : SIZE[1]]
    blob = np.exp(-((x - np.linspace(6, 22, FRAMES)[:, None, None]) ** 2 + (y - 12) ** 2) / 20)
    path = tmp_path_factory.mktemp("clip") / "clip.mp4"
    return write_video(path, np.stack([255 * blob, 128 + 0 * blob, 255 - 200 * blob], -1).astype(np.uint8), 12.0)


@pytest.fixture(autouse=True, scope="module")
def quickly_looked():
    """Playback and the pace are timed in a hurry: nothing here depends on how well."""
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(tradeoff, "_ROUNDS", 2)
        yield


@pytest.fixture(scope="module")
def done(clip, tmp_path_factory):
    """All axes, to the end."""
    target = tmp_path_factory.mktemp("done") / "results"
    assert run("tradeoff", clip, "--out", target, *SAME) == 0
    return target


def record_of(folder):
    return json.loads((folder / "tradeoff.json").read_text())


def name_of(row):
    return f"{row['axis']} {row['value']}".rstrip()


# ------------------------------------------------------------------------------------------------ functions


@pytest.mark.parametrize(
    ("cost", "quality", "expected"),
    [
        ([1, 2, 3], [30, 29, 33], [0, 2]),
        ([3, 2, 1], [33, 29, 30], [2, 0]),
        ([1, 1, 1], [30, 31, 29], [1]),
        ([1, 2, 3, 4], [30, 30.004, 30.008, 30.012], [0, 3]),
        ([1, 1, 2, 2], [30.0, 30.005, 30.3, 31], [0, 3]),
        ([1, math.nan, 3], [math.inf, 30, 31], [2]),
        ([], [], []),
    ],
)
def test_pareto_front(cost, quality, expected):
    assert pareto_front(cost, quality) == expected


def test_pareto_front_is_not_dominated():
    rng = np.random.default_rng(0)
    for _ in range(50):
        cost, quality = rng.integers(1, 9, 30), rng.integers(20, 40, 30)
        chosen = pareto_front(cost, quality)
        for k in range(30):
            beaten = ((cost <= cost[k]) & (quality >= quality[k]) & ((cost < cost[k]) | (quality > quality[k]))).any()
            equal = [(cost[j], quality[j]) for j in chosen]
            assert beaten != ((cost[k], quality[k]) in equal)


@pytest.mark.parametrize(
    ("cost", "quality", "expected"),
    [
        ([1, 2, 16], [30, 36, 38], 1),
        ([1, 2, 4, 8, 16], [30, 35, 37, 38, 38.5], 1),
        ([1, 2, 4], [30, 33, 36], None),  # on the chord
        ([1, 2, 4], [30, 31, 36], None),  # below it
        ([1, 4], [30, 36], None),
        ([1], [30], None),
    ],
)
def test_knee(cost, quality, expected):
    assert knee(cost, quality) == expected
    # Units tell nothing: seconds or minutes, dB above whatever.
    assert knee([60 * c for c in cost], [q - 20 for q in quality]) == expected
    assert knee([c**2 for c in cost], [2 * q for q in quality]) == expected


def test_axes_by_name():
    assert check_axes(["power", "time"]) == ("time", "power")
    for wrong in (["speed"], [], ["time", "time"]):
        with pytest.raises(ValueError, match="axes: expected some of time, gaussians"):
            check_axes(wrong)


def test_plot():
    pyplot = pytest.importorskip("matplotlib.pyplot", reason="matplotlib is an optional extra")
    pyplot.switch_backend("Agg")
    cost, quality = [1.0, 2.0, 16.0, 5.0], [30.0, 36.0, 38.0, 31.0]
    names = [("time", "1"), ("base", ""), ("time", "9"), ("degree", "0")]
    (ax,) = plot_tradeoff([Panel("seconds", cost, [0, 1, 2], 1)], quality, names)
    line = next(line for line in ax.lines if line.get_linestyle() == "-")
    np.testing.assert_allclose(line.get_xydata(), [(1, 30), (2, 36), (16, 38)])
    assert {text.get_text() for text in ax.texts} == {"time 1", "knee: base", "time 9"}
    assert {text.get_text() for text in ax.figure.legends[0].texts} == {"time", "base", "degree"}
    pyplot.close(ax.figure)


# ------------------------------------------------------------------------------------------------ the command


def test_everything_is_there(done, clip):
    record = record_of(done)
    rows = {name_of(row): row for row in record["points"]}
    assert {path.name for path in done.iterdir()} == {"models", "tradeoff.json", "tradeoff.png"}
    assert {row["axis"] for row in rows.values()} == {"base", *AXES}
    assert record["left_out"] == {}
    assert {"cpu", "cores", "load_average", "jax"} <= set(record["machine"])
    assert min(cv2.imread(str(done / "tradeoff.png")).shape[:2]) > 500
    # What is told is so: the model beside it is the base, and more steps are better.
    base = load_video_model(done / "models" / "base.safetensors")
    scores = evaluate(base, read_video(clip, frames=(1, 6)).frames)
    assert rows["base"]["psnr"] == pytest.approx(scores.mean_psnr, abs=1e-3)
    assert rows["base"]["bytes"] == (done / "models" / "base.safetensors").stat().st_size
    assert rows["time 3 steps"]["psnr"] < rows["base"]["psnr"] < rows["time 24 steps"]["psnr"]
    assert rows["degree 0"]["floats"] == base.num_parameters - 6 * base.num_gaussians
    assert rows["cutoff radius 2, played"]["psnr"] != rows["base"]["psnr"]
    assert rows["cutoff radius 2, played"]["seconds"] == rows["base"]["seconds"]
    assert rows["cutoff radius 2, played"]["settings"] == {"options.support_radius": 2.0}
    assert rows["quality 30"]["settings"] == {"quality": 30}
    assert rows["quality 30"]["bytes"] < rows["quality 90"]["bytes"] < rows["base"]["bytes"]
    assert rows["quality 30"]["gaussians"] < rows["quality 90"]["gaussians"]


def test_a_table_without_room_leaves_the_fits(clip, tmp_path, monkeypatch):
    arguments = ["tradeoff", clip, "--out", tmp_path / "results", "--axes", "compositing", *SAME]
    with full_disk(lambda path: path == tmp_path / "results" / "tradeoff.png"):
        call(*arguments, code=1, err="No space left")
    monkeypatch.delattr(runner, "fit_steps")
    assert run(*arguments) == 0


def test_stopped_by_hand(clip, tmp_path, monkeypatch):
    steps = runner.fit_steps

    def stopping(frames, config, state=None, **options):
        for step in steps(frames, config, state, **options):
            if config.steps == 3:
                os.kill(os.getpid(), signal.SIGINT)
            yield step

    target = tmp_path / "results"
    monkeypatch.setattr(runner, "fit_steps", stopping)
    call(
        "tradeoff",
        clip,
        "--out",
        target,
        "--axes",
        "time",
        *SAME,
        code=1,
        err=["stopped by SIGINT; 1 of 4 points are done", "Give the same command again to continue."],
    )
    assert record_of(target)["points"] == []


def test_a_point_that_fails_is_left_out(clip, tmp_path, monkeypatch):
    steps, arguments = runner.fit_steps, ["tradeoff", clip, "--out", tmp_path / "r", "--axes", "compositing", *SAME]

    def failing(frames, config, state, **options):
        if config.compositing == "sum":
            raise FitDiverged("the loss is NaN", None)
        return steps(frames, config, state, **options)

    with monkeypatch.context() as broken:
        broken.setattr(runner, "fit_steps", failing)
        call(*arguments, err="compositing sum is left out: FitDiverged: the loss is NaN")
    record = record_of(tmp_path / "r")
    assert [name_of(row) for row in record["points"]] == ["base"]
    assert set(record["left_out"]) == {"compositing sum"}
    assert run(*arguments) == 0  # tried again
    assert len(record_of(tmp_path / "r")["points"]) == 2
    assert record_of(tmp_path / "r")["left_out"] == {}


def test_minutes_are_divided_among_the_fits(clip, tmp_path, monkeypatch):
    """And the others have the base's steps and number of Gaussians."""
    fits = Mock(wraps=command.run_jobs)
    monkeypatch.setattr(command, "run_jobs", fits)
    assert run("tradeoff", clip, "--out", tmp_path / "r", "--axes", "compositing,cutoff", "--minutes", 0.05) == 0
    (base, *others) = fits.call_args.args[0]
    assert len(others) == 4
    assert base.config.minutes == pytest.approx(0.01)
    steps = read_metadata(Path(base.target))["steps"]
    expected = {(None, steps, load_video_model(base.target).num_gaussians)}
    assert {(job.config.minutes, job.config.steps, job.config.num_gaussians) for job in others} == expected


def test_other_settings_are_refused(done, clip, tmp_path):
    before = {path: path.read_bytes() for path in done.rglob("*.*")}
    for options, told in (
        (["--frames", "1:6", "--steps", "13"], ["expected steps=12, got steps=13"]),
        ([*SAME, "--seed", "1"], ["expected seed=0, got seed=1"]),
        (QUICK, ["num_frames=5", "num_frames=6"]),
        ([*SAME, "--axes", "time"], ["axes=['time', 'gaussians'", "got axes=['time']"]),
    ):
        call("tradeoff", clip, "--out", done, *options, code=2, err=[*told, "--overwrite"])
    assert {path: path.read_bytes() for path in done.rglob("*.*")} == before
    # With it they are replaced; what is no result is not.
    target = tmp_path / "r"
    target.mkdir()
    (target / "tradeoff.json").write_text('{"points": [{"axis": "base"}], "settings": []}')
    call("tradeoff", clip, "--out", target, "--axes", "time", *QUICK, code=2, err="got something else")
    assert run("tradeoff", clip, "--out", target, "--axes", "compositing", *SAME, "--overwrite") == 0
    assert len(record_of(target)["points"]) == 2
    (target / "mine.txt").write_text("mine")
    call(
        "tradeoff",
        clip,
        "--out",
        target,
        "--axes",
        "compositing",
        *QUICK,
        "--overwrite",
        code=2,
        err="'mine.txt' in it",
    )


def test_a_record_that_was_edited_is_refused(done, clip, tmp_path):
    (tmp_path / "tradeoff.json").write_text(json.dumps(record_of(done) | {"settings": 3}))
    before = (tmp_path / "tradeoff.json").read_bytes()
    call(
        "tradeoff",
        clip,
        "--out",
        tmp_path,
        "--frames",
        "1:6",
        *QUICK,
        code=2,
        err=["--out: expected results of `foldgauss tradeoff` in", "not a mapping"],
    )
    assert (tmp_path / "tradeoff.json").read_bytes() == before


def test_without_matplotlib_only_the_plot_is_missing(done, clip, monkeypatch, tmp_path):
    for name in ("matplotlib", "matplotlib.figure"):
        monkeypatch.setitem(sys.modules, name, None)
    target = tmp_path / "r"
    told = ["no plot", "foldgauss[plot]"]
    call("tradeoff", clip, "--out", target, "--axes", "compositing", *SAME, err=told)
    assert sorted(path.name for path in target.iterdir()) == ["models", "tradeoff.json"]


# --------------------------------------------------------------------------------------- options of the others


def test_render_with_other_constants(done, tmp_path):
    for name, options in (("own", []), ("fast", ["--support-radius", 1])):
        path = tmp_path / f"{name}.png"
        assert run("render", done / "models" / "base.safetensors", "--out", path, "--times", 0.5, *options) == 0
    pictures = [cv2.imread(str(tmp_path / f"{name}.png")).astype(int) for name in ("own", "fast")]
    assert np.abs(pictures[0] - pictures[1]).max() > 5
