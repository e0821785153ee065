"""The player's edits: their pictures, scripts and models are those of `foldgauss edit`, and nothing done is lost."""

import dataclasses
import re

import numpy as np
import pytest
from editor_page import (
    EDITS,
    IT,
    PICKED,
    TIMES,
    assert_shows,
    begin_edit,
    download,
    drop,
    read_script,
    script_of,
    select,
)
from soft_models import NUM, OBJECT, soft_model

from foldgauss.io import load_video_model, save_compact
from foldgauss.io.edit_script import parse_edit_script
from foldgauss.io.page.player_page import quantize_finely
from foldgauss.render import RenderOptions
from foldgauss.video import SegmentedVideo, VideoModel
from foldgauss.video.models.renderer import VideoRenderer

#: Of each kind of edit one: of places, shapes, colors, times, copies and order.
QUICK = ("transform", "gain", "freeze", "copies")
assert set(QUICK) <= EDITS.keys()


@pytest.mark.parametrize(
    "name", [name if name in QUICK else pytest.param(name, marks=pytest.mark.slow) for name in EDITS]
)
def test_an_edit_shows_what_foldgauss_edit_gives(opened, compact, name):
    page, model = opened(compact), load_video_model(compact)
    before = page.picture(0.9)
    read_script(page, IT + EDITS[name])
    assert_shows(page, parse_edit_script(IT + EDITS[name]).apply(model))
    assert np.abs(page.picture(0.9).astype(float) - before).mean() > 0.3 or name in ("front", "back")
    own = script_of(page)  # what the page writes means the same
    assert_shows(page, parse_edit_script(own).apply(model), (0.5,))
    page.press("z")
    np.testing.assert_array_equal(page.picture(0.9), before)


@pytest.mark.parametrize(
    "how",
    [
        {"power": 1.0, "floor": 0.1},
        *(pytest.param(own, marks=pytest.mark.slow) for own in ({"compositing": "sum"}, {"degree": 0})),
    ],
)
def test_edits_are_those_of_any_model(opened, tmp_path, how):
    path = save_compact(tmp_path / "m.fgz", quantize_finely(soft_model(options=RenderOptions(), **how)))
    page = opened(path)
    text = IT + EDITS["freeze"] + "\n[[edits]]\n" + EDITS["scale by axes"] + "\n[[edits]]\n" + EDITS["copies"]
    read_script(page, text)
    assert_shows(page, parse_edit_script(text).apply(load_video_model(path)))


def test_the_edited_model_is_that_of_foldgauss_edit(opened, compact, tmp_path):
    page, model = opened(compact), load_video_model(compact)
    assert download(page, "#download-model", tmp_path / "plain.safetensors") == "clip.edited.safetensors"
    plain = load_video_model(tmp_path / "plain.safetensors")
    for name in ("loc", "log_scale", "angle_logit", "coefficients", "opacity_logit", "color_dc", "log_time_scale"):
        np.testing.assert_array_equal(getattr(plain.splats, name), getattr(model.splats, name), name)
    np.testing.assert_allclose(plain.splats.time_loc_logit, model.splats.time_loc_logit, rtol=1e-6, atol=1e-6)
    assert (plain.size, plain.fps, plain.options, plain.num_frames) == (model.size, model.fps, model.options, 7)
    text = "".join(
        IT + "".join(f"{EDITS[name]}\n[[edits]]\n" for name in ("transform", "gain", "copies, smaller", "fainter"))
    )
    text += EDITS["front"]
    read_script(page, text)
    download(page, "#download-model", tmp_path / "edited.safetensors")
    edited, wanted = load_video_model(tmp_path / "edited.safetensors"), parse_edit_script(text).apply(model)
    assert isinstance(wanted, VideoModel)
    for name in ("loc", "log_scale", "coefficients", "opacity_logit", "color_dc", "log_time_scale", "time_loc_logit"):
        np.testing.assert_allclose(getattr(edited.splats, name), getattr(wanted.splats, name), rtol=2e-6, atol=2e-6)
    for t in TIMES:
        assert np.abs(VideoRenderer(edited).image(t) - VideoRenderer(wanted).image(t)).max() < 1e-4
    assert_shows(page, edited)


def test_a_model_that_no_file_holds_is_told(opened, compact):
    page = opened(compact)
    for edit in ("shift = 0.9", "shift = -0.02", "stretch = 0.9"):
        read_script(page, IT + f'do = "retime"\n{edit}\n')
        page.page.click("#files-open")
        page.page.click("#download-model")
        told = page.toast
        assert re.search(r"^\d+ Gaussians were moved in time, .* which no model file holds", told)
        assert "foldgauss edit MODEL SCRIPT --out edited.mp4" in told
        page.press("Escape")


@pytest.mark.slow
def test_what_no_image_has_is_left_out_of_the_model(opened, tmp_path):
    """Gaussians of the middle of the clip, moved behind its end."""
    model = soft_model(options=RenderOptions())
    short = {
        name: np.where(OBJECT, np.float32(value), getattr(model.splats, name))
        for name, value in (("time_loc_logit", 0), ("log_time_scale", -3))
    }
    model = dataclasses.replace(model, splats=dataclasses.replace(model.splats, **short))
    page = opened(save_compact(tmp_path / "m.fgz", quantize_finely(model)))
    read_script(page, IT + 'do = "retime"\nshift = 0.9\n')
    download(page, "#download-model", tmp_path / "edited.safetensors")
    model = load_video_model(tmp_path / "edited.safetensors")
    assert model.num_gaussians == NUM - OBJECT.sum()
    assert_shows(page, model)


@pytest.mark.slow
def test_messages_stand_above_the_dialog(opened, compact):
    page = opened(compact)
    for name in ("files", "help"):
        page.page.click(f"#{name}-open")
        read_script(page, "no script")  # its message comes above the dialog that is open
        box = page.page.locator("#toast").bounding_box()
        middle = [box["x"] + box["width"] / 2, box["y"] + box["height"] / 2]
        assert page.page.evaluate("(at) => document.elementFromPoint(...at).id", middle) == "toast"
        page.press("Escape")
        page.settle()
        assert page.page.locator("#toast").is_visible()  # it stays when the dialog is closed


def test_a_change_of_color_is_shown_without_the_tint(opened, compact):
    page = opened(compact)
    plain = page.picture(0.4)
    tinted = begin_edit(page, range(12)).picture()
    assert np.abs(tinted.astype(float) - plain).mean() > 0.5
    for name, value in (("gain", "1.01"), ("opacity", "0.99")):
        page.page.locator(f"#{name}").fill(value)
        assert np.abs(page.picture().astype(float) - plain).max() <= 4
    page.page.locator("#move-x").fill("0.01")
    assert np.abs(page.picture().astype(float) - tinted).max() <= 6


def test_undo_and_redo_go_through_all_steps(opened, compact):
    page = opened(compact)
    page.press("e")
    pictures = [page.picture(0.4)]
    for action in (
        lambda: select(page, range(12)),
        lambda: page.page.locator("#move-x").fill("12"),
        lambda: page.page.locator("#gain").fill("2"),
        lambda: select(page, range(5), "subtract"),
        lambda: page.page.click("#duplicate"),
        lambda: page.page.click("#to-front"),
        lambda: page.page.evaluate("foldgauss.controls.panel.act({ do: 'freeze', at: 6 })"),
        lambda: read_script(page, IT + EDITS["vanish"]),
        lambda: page.page.evaluate("foldgauss.files.discard()"),
    ):
        action()
        pictures.append(page.picture(0.4))
        assert page.stats["undoable"] == len(pictures) - 1
        assert np.abs(pictures[-1].astype(float) - pictures[-2]).mean() > 0.005
    page.page.evaluate("document.activeElement.blur()")
    np.testing.assert_array_equal(pictures[-1], pictures[0])
    steps = page.stats["undoable"]
    for k in range(len(pictures) - 2, -1, -1):
        page.press("Control+z")
        np.testing.assert_array_equal(page.picture(0.4), pictures[k], str(k))
    assert page.page.locator("#undo").is_disabled()
    for k in range(1, len(pictures)):
        page.press("Control+Shift+z")
        np.testing.assert_array_equal(page.picture(0.4), pictures[k], str(k))
    assert (page.stats["undoable"], page.stats["redoable"]) == (steps, 0)


@pytest.mark.slow
def test_the_edit_is_there_again_when_the_page_is(opened, compact):
    page = opened(compact)
    begin_edit(read_script(page, IT + EDITS["move"]), [20, 21])
    before, text = page.picture(0.4), script_of(page)
    assert "20-21" in text
    page.page.reload()
    page.ready().press("e")
    np.testing.assert_array_equal(page.picture(0.4), before)
    assert script_of(page) == text
    page.press("z", "z")
    assert page.stats["steps"] == []
    page.press("Shift+z")
    assert len(page.stats["steps"]) == 2
    page.page.evaluate("foldgauss.files.discard()")
    page.page.reload()
    page.ready()
    assert page.stats["steps"] == []


def test_a_script_comes_back_by_drop_and_by_the_button(opened, compact, tmp_path):
    page = opened(compact)
    read_script(page, IT + EDITS["several"])
    select(page, [3, 4])
    wanted, text, picked = page.picture(0.3), script_of(page), page.page.evaluate(PICKED)
    assert {3, 4} <= set(picked)
    path = tmp_path / "it.toml"
    assert download(page, "#download-script", path) == "clip.edit.toml"
    assert path.read_text() == text
    for way in ("drop", "button"):
        page.page.evaluate("foldgauss.files.discard()")
        assert np.abs(page.picture(0.3).astype(float) - wanted).mean() > 0.3
        if way == "drop":
            drop(page, path)
        else:
            page.page.locator("#chooser").set_input_files(path)
        page.until("foldgauss.stats.steps.length > 0")
        np.testing.assert_array_equal(page.picture(0.3), wanted)
        assert script_of(page) == text
        assert page.page.evaluate(PICKED) == picked


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[selections.a]\nbox = [0, 0, 1, 1]\n", "line 1, [selections.a]: box: expected indices, or any, all"),
        (IT + 'do = "move"\noffset = [0.1, 0]\nframes = [2, 4]\n', "frames: expected an edit at all times"),
        (IT + 'do = "scale"\nfactor = 2\n', "about a fixed point: give about"),
        (IT + 'do = "sing"\n', "do: expected one of move"),
        (IT + 'do = "move"\noffset = "far"\n', 'line 5, [[edits]] number 1: offset: expected two numbers, got "far"'),
        (IT.replace(f"= {NUM}", "= 41") + EDITS["vanish"], "num_gaussians: expected 40, those of this model, got 41"),
        (IT.replace("0-11", "0-99") + EDITS["vanish"], "indices: expected Gaussians from 0 to 39, got 99"),
        (IT.replace('"it"', '"them"') + EDITS["vanish"], "select: expected the name of a selection"),
        (IT.replace("0-11", "") + EDITS["vanish"], "indices: expected a text of numbers and ranges"),
        ("[[layers]]\nmodel = 'm'\n", "[layers]: expected selections and edits"),
        ("[camera", "line 1: expected ]"),
        ("a = b", 'line 1: expected a key or a value, got "b"'),
        ("a = 1\na = 2", "line 2: expected each key once"),
        ("[[edits]]\n__proto__ = 1\ndo = 'vanish'", "__proto__: expected one of no keys"),
    ],
)
def test_scripts_that_the_page_cannot_do_are_told(opened, compact, text, message):
    page = opened(compact)
    read_script(page, text, "own.toml")
    told = page.toast
    assert told.startswith("own.toml: ")
    assert message in told
    assert page.stats["undoable"] == 0


BLACK = """() => {
  const { base } = foldgauss.player;
  base.leaves.color_dc.fill(-5);
}"""


def test_a_script_that_fails_when_applied_changes_nothing(opened, compact):
    page = opened(compact, fresh=True)
    page.page.evaluate(BLACK)
    read_script(page, IT + EDITS["hue"])
    before = page.picture(0.5)
    read_script(page, IT + EDITS["color"], "own.toml")
    assert "own.toml: color: expected an object that is not black" in page.toast
    many = "\n[[edits]]\n".join(
        f'do = "multiply"\noffsets = {[[0.1, 0.0]] * num}\noriginals = true\n' for num in (100, 999)
    )
    read_script(page, IT + many)
    assert "expected at most 1,000,000 Gaussians with the copies, got 1,212,028" in page.toast
    assert page.stats["undoable"] == 1
    np.testing.assert_array_equal(page.settle().picture(0.5), before)


@pytest.mark.slow
def test_what_the_browser_kept_is_discarded_if_it_cannot_be_applied(opened, compact):
    page = opened(compact)
    read_script(page, IT + EDITS["hue"])
    page.page.evaluate("foldgauss.files.storage.flush()")
    page.page.evaluate(
        """(offsets) => {
          const [name] = Object.keys(localStorage), kept = JSON.parse(localStorage[name]);
          const copies = { do: "multiply", offsets, originals: true };
          kept.steps.push(copies, copies); // undone: they fail when they are done again
          localStorage[name] = JSON.stringify(kept);
        }""",
        [[0.1, 0.0]] * 999,
    )
    page.page.reload()
    assert page.ready().stats["steps"] == []
    assert "The edit that the browser kept is discarded: offsets: exp" in page.toast
    assert page.page.evaluate("Object.keys(localStorage)") == []


@pytest.mark.slow
def test_an_edit_that_the_browser_cannot_keep_leaves_no_older_one(opened, compact):
    page = opened(compact)
    read_script(page, IT + EDITS["hue"])
    page.page.evaluate("foldgauss.files.storage.flush()")
    assert len(page.page.evaluate("Object.keys(localStorage)")) == 1
    page.page.evaluate(
        """() => {
          for (let more = 2 ** 22; more >= 1; more >>= 1)
            try {
              localStorage[`filler-${more}`] = " ".repeat(more);
            } catch {
              // full
            }
        }"""
    )
    read_script(page, IT + EDITS["several"])
    page.page.evaluate("foldgauss.files.storage.flush()")
    assert "does not keep this edit, nor its earlier state" in page.toast
    assert page.page.evaluate("Object.keys(localStorage).every((name) => name.startsWith('filler'))")


def test_scripts_are_toml_whatever_the_title(opened, compact):
    page = opened(compact, fresh=True)
    read_script(page, IT + EDITS["hue"])
    page.page.evaluate("foldgauss.files.title = 'a\\x7f\\x00\\x85\\n\\u2028\"\\ud800' + '\u00e9'")
    assert len(parse_edit_script(script_of(page)).tables["edits"]) == 1
    assert "\u00e9" in script_of(page)


def test_selections_of_scripts_are_combined(opened, compact):
    text = '[selections.a]\nindices = "0-9"\n[selections."b c"]\nindices = "5-14" # and\n'
    text += '[selections.d]\nany = ["a", "b c"]\nwithout = [\n  "e",\n]\n'.replace('"e"', '"b c"')
    text += '[selections.current]\nany = ["d"]\nall = ["a"]\n'
    page = read_script(opened(compact), text)
    assert page.page.evaluate(PICKED) == list(range(5))


def test_segments_are_edited_by_one_script(opened):
    parts = [(6 * k, soft_model(seed=k, options=RenderOptions(), num_frames=7)) for k in range(2)]
    video = SegmentedVideo.from_models(parts)
    page = opened(video).until("foldgauss.stats.decoded.length === 2")
    select(page.seek(0.2), range(12))
    begin_edit(page, range(12, 20), at=0.9)
    page.page.locator("#move-x").fill("10")
    assert page.page.locator("#freeze").is_disabled()
    page.press("Escape")
    edited, plain = (VideoRenderer(own) for own in (parse_edit_script(script_of(page)).apply(video), video))
    for t in (0.2, 0.9):
        far = np.abs(page.picture(t).astype(float) - edited.frame(t)).mean()
        assert far < 0.5 < np.abs(page.picture(t).astype(float) - plain.frame(t)).mean()
