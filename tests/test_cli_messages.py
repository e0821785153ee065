"""What commands say of inputs that they do not read, and where outputs go."""

from pathlib import Path

import numpy as np
import pytest

from foldgauss.cli.app.main import main
from foldgauss.io import load_video_model, write_image, write_video
from foldgauss.io._atomic import OutputError, write_or_keep
from foldgauss.io.datasets import waves
from foldgauss.io.models.video_model import read_metadata

FIT = ["--steps", "3", "--gaussians", "60", "--quiet"]


def run(*words):
    with pytest.raises(SystemExit) as ended:
        main([str(word) for word in words])
    return ended.value.code or 0


@pytest.fixture(scope="module")
def work(tmp_path_factory):
    """A clip of 6 frames, and a model of frames 2 to 4 in a folder that was not there."""
    folder = tmp_path_factory.mktemp("work")
    write_video(folder / "clip.mp4", waves(6).frames, 10.0)
    target = folder / "a" / "b" / "m.safetensors"
    assert run("fit", folder / "clip.mp4", "--frames", "2:5", "--out", target, *FIT) == 0
    return folder


@pytest.fixture
def model(work):
    return work / "a" / "b" / "m.safetensors"


def test_a_fit_records_its_budget(model):
    about = read_metadata(model)
    assert (about["steps"], about["budget"], about["frames"]) == (3, {"steps": 3}, [2, 5])
    assert "version" in about


def test_a_range_beyond_the_clip_ends_with_it(work, tmp_path, capsys):
    target = tmp_path / "m.safetensors"
    assert run("fit", work / "clip.mp4", "--frames", "4:100", "--out", target, *FIT) == 0
    assert "frames 4:100 were asked for, and the clip ends at 6: 4:6 are used." in capsys.readouterr().err
    assert (load_video_model(target).num_frames, read_metadata(target)["frames"]) == (2, [4, 6])


def test_masks_of_the_whole_clip_fit_a_model_of_some_frames(work, model, tmp_path):
    size = load_video_model(model).size
    (tmp_path / "masks").mkdir()
    for k in range(6):
        write_image(tmp_path / "masks" / f"{k}.png", np.full((*size, 3), 255, np.uint8))
    (tmp_path / "s.toml").write_text(
        '[selections]\nall = {mask = "masks"}\n[[edits]]\nselect = "all"\ndo = "move"\noffset = [0.1, 0.0]\n'
    )
    assert run("edit", model, tmp_path / "s.toml", "--out", tmp_path / "e.safetensors") == 0


@pytest.mark.parametrize("words", [["fit"], ["evaluate", "MODEL"], ["render"]])
def test_an_address_is_named_as_given(words, model, tmp_path, capsys):
    words = [model if word == "MODEL" else word for word in words]
    assert run(*words, "https://a.org/clip.mp4", "--out" if words[0] != "evaluate" else "--json", tmp_path / "o") == 2
    assert "the address 'https://a.org/clip.mp4'. Download it first." in capsys.readouterr().err


@pytest.mark.parametrize("suffix", [".gif", ".webp"])
def test_alpha_for_an_animation_is_refused_by_its_option(suffix, model, tmp_path, capsys):
    assert run("render", model, "--background", "none", "--out", tmp_path / f"v{suffix}") == 2
    assert f"--background: expected a color for {suffix}" in capsys.readouterr().err


def test_a_ply_is_to_be_imported(tmp_path, capsys):
    (tmp_path / "x.ply").write_bytes(b"ply\nformat ascii 1.0\nend_header\n")
    assert run("view", tmp_path / "x.ply") == 1
    assert "foldgauss import" in capsys.readouterr().err


def test_a_page_is_told_of_where_there_is_no_terminal(model, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("foldgauss.cli.shared.log_lines.FIRST_LINE_SECONDS", 0.0)
    assert run("export", model, "--format", "html", "--out", tmp_path / "new" / "p.html") == 0
    assert "Writing the page" in capsys.readouterr().err


def test_a_result_without_room_is_kept_elsewhere(tmp_path, monkeypatch):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))

    def write(path):
        if path.parent.name == "full":
            raise OutputError("path: no room.")
        Path(path).write_text("result")

    with pytest.raises(OutputError, match=r"no room\. It is kept in .*m.safetensors"):
        write_or_keep(tmp_path / "full" / "m.safetensors", write)
    assert [path.read_text() for path in tmp_path.glob("*/m.safetensors")] == ["result"]
