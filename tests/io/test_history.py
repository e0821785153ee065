"""The history on disk: each step once, whatever happened to the fit, and readable while it runs."""

import json
import math

import cv2
import numpy as np
import pytest

from foldgauss.io._atomic import OutputError
from foldgauss.io.history import HistoryFile, read_history, write_curves
from foldgauss.video.fitting.loop import FitInfo


def info(step, loss=0.25, **changes):
    plain = FitInfo(step, step / 10, loss, 20.0 + step, 400, 350, 0.5 * step, 3.0, None)
    return plain._replace(**changes)


def write(path, steps, resumed_at=None, loss=0.25):
    with HistoryFile(path, resumed_at) as history:
        for step in steps:
            history(None, info(step, loss))


def steps(path):
    return [line.step for line in read_history(path)]


def test_lines_are_there_at_once_and_read_back(tmp_path):
    path = tmp_path / "h.jsonl"
    with HistoryFile(path) as history:
        assert not path.exists()  # a fit that never starts leaves nothing
        history(None, info(1, loss=math.pi))
        line = json.loads(path.read_text())
        assert line["loss"] == pytest.approx(math.pi, rel=1e-6)
        assert (line["step"], line["psnr"], line["num_gaussians"], line["num_alive"]) == (1, 21.0, 400, 350)
        history(None, info(2, loss=math.nan, seconds_left=math.inf, stopped_by="steps"))
        first, last = read_history(path)
    assert first._replace(loss=0.0) == info(1, loss=0.0)
    assert "NaN" not in path.read_text()  # JSON has none
    assert "Infinity" not in path.read_text()
    assert math.isnan(last.loss)
    assert (last.seconds_left, last.stopped_by) == (math.inf, "steps")


def test_a_new_history_replaces_the_old_one_at_its_first_step(tmp_path):
    path = tmp_path / "h.jsonl"
    write(path, range(1, 5))
    with HistoryFile(path) as history:
        assert steps(path) == [1, 2, 3, 4]
        history(None, info(1))
    assert steps(path) == [1]


@pytest.mark.parametrize("torn", ["", '{"step": 6, "prog', '{"st'])
def test_resumed_history_has_each_step_once(tmp_path, torn):
    """Written up to step 5 (and half a line), kept at step 3."""
    path = tmp_path / "h.jsonl"
    write(path, range(1, 6))
    with open(path, "a") as file:
        file.write(torn)
    assert steps(path) == [1, 2, 3, 4, 5]
    write(path, range(4, 8), resumed_at=3, loss=0.5)
    assert steps(path) == [1, 2, 3, 4, 5, 6, 7]
    assert [line.loss for line in read_history(path)] == [0.25] * 3 + [0.5] * 4  # those steps as they were taken last
    write(path, [7], resumed_at=7)  # a fit that needs no more steps tells its last one again
    assert steps(path) == [1, 2, 3, 4, 5, 6, 7]


def test_a_history_may_begin_with_the_resumed_step(tmp_path):
    write(tmp_path / "h.jsonl", [4, 5], resumed_at=3)
    assert steps(tmp_path / "h.jsonl") == [4, 5]


@pytest.mark.parametrize("text", ["notes", "notes\n", '{"step": 1}\nnotes\n', '{"a": 1}\n', '{"step": "x"}\n', "[]\n"])
def test_what_is_no_history_is_left_alone(tmp_path, text):
    path = tmp_path / "h.jsonl"
    path.write_text(text)
    with pytest.raises(ValueError, match=r"history: expected one JSON object with a step per line, got .*line [12]"):
        HistoryFile(path, resumed_at=1)
    assert path.read_text() == text


def test_a_place_that_cannot_be_written(tmp_path):
    with HistoryFile(tmp_path / "no" / "h.jsonl") as history, pytest.raises(OutputError, match="writable"):
        history(None, info(1))


def test_curves(tmp_path):
    pytest.importorskip("matplotlib", reason="matplotlib is an optional extra")
    rng = np.random.default_rng(0)
    history = [info(k, loss=0.3 / k * rng.uniform(0.5, 1.5)) for k in range(1, 300)]
    write_curves(tmp_path / "1.png", history)
    write_curves(tmp_path / "2.png", history[:1])
    assert sorted(path.name for path in tmp_path.iterdir()) == ["1.png", "2.png"]
    assert all(cv2.imread(str(path)).std() > 5 for path in tmp_path.iterdir())
