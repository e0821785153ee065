"""What commands say of inputs that they do not read, and where outputs go."""

import dataclasses
import pickle

import numpy as np
import pytest
from commands import call, full_disk, run

from foldgauss._runtime.checks import invalid
from foldgauss._runtime.settings import setting_of
from foldgauss.cli.app.application import load_commands
from foldgauss.io import load_video_model, write_frames, write_video
from foldgauss.io.datasets import waves
from foldgauss.io.models.video_model import read_metadata
from foldgauss.video import FitConfig


def test_errors_carry_their_parameter_which_commands_name_as_typed():
    error = invalid("num_gaussians", expected="1", got="0", cure="Add one.")
    for one in (error, pickle.loads(pickle.dumps(error))):
        assert (one.parameter, one.problem) == ("num_gaussians", "expected 1, got 0. Add one.")
        assert str(one) == "num_gaussians: expected 1, got 0. Add one."
    fit = load_commands("fit")["fit"]
    for field in dataclasses.fields(FitConfig):
        if option := setting_of(field).option.split("/")[0]:
            assert fit._name_as_typed(field.name) == option
    known = {"video": "VIDEO", "loss.ssim_fraction": "--ssim-fraction", "--steps": "--steps", "path": None}
    assert {name: fit._name_as_typed(name) for name in known} == known


FIT = ["--steps", "3", "--gaussians", "60", "--quiet"]


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


def test_a_range_beyond_the_clip_ends_with_it(work, tmp_path):
    target = tmp_path / "m.safetensors"
    call(
        "fit",
        work / "clip.mp4",
        "--frames",
        "4:100",
        "--out",
        target,
        *FIT,
        err="frames 4:100 were asked for, and the clip ends at 6: 4:6 are used.",
    )
    assert (load_video_model(target).num_frames, read_metadata(target)["frames"]) == (2, [4, 6])


def test_masks_of_the_whole_clip_fit_a_model_of_some_frames(work, model, tmp_path):
    size = load_video_model(model).size
    write_frames(tmp_path / "masks", [np.full((*size, 3), 255, np.uint8)] * 6)
    (tmp_path / "s.toml").write_text(
        '[selections]\nall = {mask = "masks"}\n[[edits]]\ndo = "move"\noffset = [0.1, 0.0]\n'
    )
    assert run("edit", model, tmp_path / "s.toml", "--out", tmp_path / "e.safetensors") == 0


def test_a_page_is_told_of_where_there_is_no_terminal(model, tmp_path, monkeypatch):
    monkeypatch.setattr("foldgauss.cli.shared.console.FIRST_LINE_SECONDS", 0.0)
    call("view", model, "--out", tmp_path / "new" / "p.html", err="Writing the page")


#: Commands that write after long work, by what they write; CLIP, MODEL and SCRIPT are inputs, OUT is the output.
WRITING = {
    "m.safetensors": ["fit", "CLIP", *FIT, "--out", "OUT"],
    "joined.safetensors": ["fit", "CLIP", *FIT, "--segment-seconds", "0.3", "--out", "OUT"],
    "v.mp4": ["render", "MODEL", "--out", "OUT"],
    "frames": ["render", "MODEL", "--out", "OUT"],
    "one.png": ["render", "MODEL", "--frame", "1", "--out", "OUT"],
    "stable.webp": ["render", "MODEL", "--stabilize", "smooth", "--out", "OUT"],
    "edited.safetensors": ["edit", "MODEL", "SCRIPT", "--out", "OUT"],
    "edited.mp4": ["edit", "MODEL", "SCRIPT", "--out", "OUT"],
    "m.fgz": ["compress", "MODEL", "--out", "OUT"],
    "p.html": ["view", "MODEL", "--out", "OUT"],
    "m.ply": ["export", "MODEL", "--format", "ply", "--out", "OUT"],
    "scenes": ["export", "MODEL", "--format", "ply3dgs", "--out", "OUT"],
    "mesh": ["export", "MODEL", "--format", "obj", "--out", "OUT"],
    "s.json": ["evaluate", "MODEL", "CLIP", "--json", "OUT"],
}


@pytest.fixture
def full(tmp_path, monkeypatch):
    """A folder on a full disk, and another for temporary files."""
    (tmp_path / "full").mkdir()
    (tmp_path / "temporary").mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "temporary"))
    monkeypatch.chdir(tmp_path)
    with full_disk(lambda path: path.parent == tmp_path / "full"):
        yield tmp_path / "full"


@pytest.mark.parametrize("name", WRITING)
def test_a_result_for_a_full_disk_is_kept(name, work, full):
    script = full.parent / "s.toml"
    script.write_text('[[edits]]\ndo = "recolor"\ngain = 0.5\n')
    model = work / "a" / "b" / "m.safetensors"
    inputs = {"CLIP": work / "clip.mp4", "MODEL": model, "SCRIPT": script, "OUT": full / name}
    last = call(*(inputs.get(word, word) for word in WRITING[name]), code=1).err.strip().splitlines()[-1]
    (kept,) = full.parent.glob(f"temporary/*/{name}")
    assert last.startswith("error: ")
    assert f"It is kept in {kept}" in last
    assert not (full / name).exists()
