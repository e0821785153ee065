"""Edit scripts that select by motion."""

from unittest.mock import Mock

import numpy as np
import pytest
from commands import call
from soft_models import soft_model

from foldgauss.io import load_video_model, save_video_model
from foldgauss.io.edit_script import EditScriptError, parse_edit_script
from foldgauss.video import NothingMoves, by_mask, edit
from foldgauss.video.motion.moving_object import nothing_moves
from foldgauss.video.selection import selectors

MODEL = soft_model()
MASKS = np.zeros((MODEL.num_frames, *MODEL.size), bool)
MASKS[:, 10:30, 12:32] = True
SCRIPT = '[selections.it]\nmoving = true\n[[edits]]\nselect = "it"\ndo = "vanish"\n'


def test_scripts_select_what_moves(tmp_path, monkeypatch):
    monkeypatch.setattr(selectors, "find_moving_object", lambda frames: MASKS)  # the search has tests of its own
    model = save_video_model(tmp_path / "m.safetensors", MODEL)
    wanted = edit(MODEL).select(by_mask(MODEL, MASKS)).vanish().video()
    assert parse_edit_script(SCRIPT).apply(MODEL).num_gaussians == wanted.num_gaussians < MODEL.num_gaussians
    (tmp_path / "edits.toml").write_text(SCRIPT)
    out = f"{wanted.num_gaussians} Gaussians"
    call("edit", model, tmp_path / "edits.toml", "--out", tmp_path / "gone.safetensors", out=out)
    assert load_video_model(tmp_path / "gone.safetensors").num_gaussians == wanted.num_gaussians


def test_scripts_say_where_nothing_moves(monkeypatch):
    search = Mock(side_effect=nothing_moves("an object that moves against the background", "none"))
    monkeypatch.setattr(selectors, "find_moving_object", search)
    with pytest.raises(EditScriptError, match=r"\[selections.it\]: moving: expected an object that moves"):
        parse_edit_script(SCRIPT).apply(MODEL)
    with pytest.raises(EditScriptError, match="moving: expected true, got False"):
        parse_edit_script(SCRIPT.replace("true", "false"))
    with pytest.raises(NothingMoves):
        edit(MODEL).select(moving=True)


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
