"""`foldgauss render --plate`, and edit scripts that select by motion."""

from unittest.mock import Mock

import numpy as np
import pytest
from commands import call, run, seconds_heard, write_tone
from soft_models import soft_model

from foldgauss.cli.viewing import render as plate
from foldgauss.io import load_video_model, read_masks, read_video, save_video_model, write_frames
from foldgauss.io.edit_script import EditScriptError, parse_edit_script
from foldgauss.video import NothingMoves, by_mask, edit
from foldgauss.video.motion.moving_object import nothing_moves
from foldgauss.video.selection import selectors

pytestmark = pytest.mark.filterwarnings("default:.*of the removed area is shown by no frame")
MODEL = soft_model()
MASKS = np.zeros((MODEL.num_frames, *MODEL.size), bool)
MASKS[:, 10:30, 12:32] = True
SCRIPT = '[selections.it]\nmoving = true\n[[edits]]\nselect = "it"\ndo = "vanish"\n'


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    path = tmp_path_factory.mktemp("plate") / "m.safetensors"
    save_video_model(path, MODEL)
    return path


@pytest.fixture
def searched(monkeypatch):
    """The object is found at `MASKS`; the search itself has tests of its own."""
    monkeypatch.setattr(selectors, "find_moving_object", lambda frames: MASKS)
    monkeypatch.setattr(plate, "find_moving_object", lambda frames, **options: MASKS)


@pytest.mark.usefixtures("searched")
def test_scripts_select_what_moves(model, tmp_path):
    wanted = edit(MODEL).select(by_mask(MODEL, MASKS)).vanish().video()
    assert parse_edit_script(SCRIPT).apply(MODEL).num_gaussians == wanted.num_gaussians < MODEL.num_gaussians
    (tmp_path / "edits.toml").write_text(SCRIPT)
    out = f"{wanted.num_gaussians} Gaussians"
    call("edit", model, tmp_path / "edits.toml", "--out", tmp_path / "gone.safetensors", out=out)
    assert load_video_model(tmp_path / "gone.safetensors").num_gaussians == wanted.num_gaussians


def test_scripts_say_where_nothing_moves(model, tmp_path, monkeypatch):
    search = Mock(side_effect=nothing_moves("an object that moves against the background", "none"))
    monkeypatch.setattr(selectors, "find_moving_object", search)
    monkeypatch.setattr(plate, "find_moving_object", search)
    with pytest.raises(EditScriptError, match=r"\[selections.it\]: moving: expected an object that moves"):
        parse_edit_script(SCRIPT).apply(MODEL)
    with pytest.raises(EditScriptError, match="moving: expected true, got False"):
        parse_edit_script(SCRIPT.replace("true", "false"))
    with pytest.raises(NothingMoves):
        edit(MODEL).select(moving=True)
    told = "MODEL: expected an object that moves against the background, got none."
    cure = "Give masks of the object by --masks, or remove it by foldgauss edit"
    call("render", "--plate", model, "--out", tmp_path / "images", code=2, err=[told, cure])
    assert not list(tmp_path.iterdir())


def test_an_object_without_gaussians_is_told(monkeypatch):
    few = np.zeros_like(MASKS)
    few[2, 0, :3] = True
    monkeypatch.setattr(selectors, "find_moving_object", lambda frames: few)
    told = (
        r"script, \[selections.it\]: moving: expected an object that has Gaussians of its own, got one that covers up "
    )
    told += "to 3 of 2,560 pixels of a frame, but to which no Gaussian belongs. Lower the threshold"
    with pytest.raises(EditScriptError, match=told):
        parse_edit_script(SCRIPT).apply(MODEL)


@pytest.mark.usefixtures("searched")
def test_the_plate_and_its_masks_are_written(model, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    call(
        "render",
        "--plate",
        model,
        "--save-masks",
        "masks",
        "--out",
        "images",
        out=[
            "Motion against the background covers 15.6% to 15.6% of the image, in 7 of 7 frames.",
            "Parts that stand still are not found and stay",
            "7 frames at 25 frames per second",
        ],
    )
    np.testing.assert_array_equal(read_masks("masks"), MASKS)
    filled, frames = read_video("images").frames, np.stack(list(MODEL.frames()))
    np.testing.assert_array_equal(filled[:, :5], frames[:, :5])
    assert (filled[MASKS] != frames[MASKS]).any()
    assert run("render", "--plate", model, "--sound", write_tone(tmp_path / "tone.wav", 1.0)) == 0
    assert read_video("m.plate.mp4").frames.shape == frames.shape
    assert seconds_heard("m.plate.mp4") == pytest.approx(len(frames) / 25, abs=0.03)
    for options in ([], ["--save-masks", "masks", "--out", "p.mp4"], ["--out", "images"]):
        told = call(
            "render", "--plate", model, *options, code=2, err="exists. Choose another path, or add --overwrite."
        )
        assert "Searching" not in told.out
    assert not (tmp_path / "p.mp4").exists()
    (tmp_path / "empty").mkdir()
    assert run("render", "--plate", model, "--save-masks", "masks", "--out", "empty", "--overwrite") == 0


@pytest.mark.parametrize("form", ["folder", "image", pytest.param("whole clip", marks=pytest.mark.slow)])
def test_own_masks_are_used_and_stay(model, tmp_path, monkeypatch, form):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(plate, "find_moving_object", None)  # nothing is searched for
    given = {"folder": MASKS, "image": MASKS[:1], "whole clip": np.concatenate([MASKS, MASKS])}[form]
    write_frames(tmp_path / "masks", np.repeat(np.uint8(255 * given)[..., None], 3, -1))
    masks = "masks/00000.png" if form == "image" else "masks"
    told = call("render", "--plate", model, "--masks", masks, "--out", "images", "--save-masks", "used")
    assert "Searching" not in told.out
    assert "% of the removed area is shown by no frame" in told.err
    assert "filled with texture from its surroundings. Take more frames" in told.err
    np.testing.assert_array_equal(read_masks("used"), MASKS)
    np.testing.assert_array_equal(read_masks("masks"), given)
    for options in (["--out", "masks"], ["--save-masks", "masks"]):
        call(
            "render",
            "--plate",
            model,
            "--masks",
            "masks",
            *options,
            "--overwrite",
            code=2,
            err=f"{options[0]}: expected another path than the masks, got masks.",
        )
    np.testing.assert_array_equal(read_masks("masks"), given)
