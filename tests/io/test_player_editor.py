"""The player's editor: its pictures, scripts and models are those of `foldgauss edit`, and nothing done is lost."""

import base64
import dataclasses
import json
import re
import threading
from contextlib import contextmanager

import cv2
import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from browser import Opened, chromium
from soft_models import NUM, OBJECT, SIZE, soft_model

from foldgauss.cli.viewing.page_server import PageServer, make_token
from foldgauss.io import (
    export,
    html_page,
    import_model,
    load_video_model,
    read_video,
    save_compact,
    save_video_model,
    write_html,
)
from foldgauss.io.edit_script import parse_edit_script, read_edit_script
from foldgauss.io.page.player_page import SaveTarget, empty_page, quantize_finely
from foldgauss.render import RenderOptions
from foldgauss.video import SegmentedVideo, VideoModel
from foldgauss.video.models.renderer import VideoRenderer
from foldgauss.video.selection.tracking import to_lab

TIMES = (0.0, 0.21, 0.5, 1.0)
#: Half floats, in which pictures are added up, leave up to a level and a half; see docs/player.md.
LEVELS, WORST = 0.4, 2
PICKED = "Array.from(foldgauss.player.state.selected.keys()).filter((i) => foldgauss.player.state.selected[i])"


@pytest.fixture(scope="module")
def browser():
    with chromium() as found:
        yield found


@pytest.fixture(scope="module")
def compact(tmp_path_factory):
    """A compact file, which goes into the page as it is: so the page and Python have the same Gaussians."""
    path = tmp_path_factory.mktemp("compact") / "clip.fgz"
    return save_compact(path, quantize_finely(soft_model(options=RenderOptions())))


@pytest.fixture
def opened(browser, tmp_path):
    pages = []

    def open_page(model, **options):
        path = write_html(tmp_path / f"{len(pages)}.html", model, title="clip")
        pages.append(Opened(browser, path, viewport={"width": 900, "height": 640}, **options))
        return pages[-1].ready()

    yield open_page
    for one in pages:
        one.close()
        assert not one.said
        assert all(url.startswith(("file:", "blob:", "data:")) for url in one.asked)


def read_script(page, text, name="test.toml"):
    page.page.evaluate("([text, name]) => foldgauss.files.readScript(text, name)", [text, name])
    return page


def script_of(page):
    return page.page.evaluate("foldgauss.files.script")


def select(page, indices, how="new"):
    page.page.evaluate(
        "([indices, how]) => foldgauss.controls.tools.select(indices, how)", [list(map(int, indices)), how]
    )


def download(page, button, path):
    """The file that a button of the dialog gives."""
    if not page.page.locator("#files").is_visible():
        page.page.click("#files-open")
    with page.page.expect_download() as waited:
        page.page.click(button)
    waited.value.save_as(path)
    page.page.evaluate("document.getElementById('files').close()")
    return waited.value.suggested_filename


def assert_shows(page, video, times=TIMES):
    play = VideoRenderer(video)
    for t in times:
        far = np.abs(page.picture(t).astype(float) - play.frame(t))
        assert (far.mean() < LEVELS) & (far.max() <= WORST), (t, far.mean(), far.max())


IT = f'[selections.it]\nindices = "0-11"\nnum_gaussians = {NUM}\n\n[[edits]]\nselect = "it"\n'
EDITS = {
    "move": 'do = "move"\noffset = [0.1, -0.05]\n',
    "scale": 'do = "scale"\nfactor = 1.6\nabout = [-0.15, 0.0]\n',
    "scale by axes": 'do = "scale"\nfactor = [1.8, 0.6]\nabout = [-0.15, 0.0]\n',
    "rotate": 'do = "rotate"\ndegrees = 70\nabout = [-0.1, 0.1]\n',
    "transform": 'do = "transform"\nmatrix = [[-1.2, 0.5], [0.1, 0.9]]\noffset = [0.1, 0.02]\nabout = [-0.1, 0.1]\n',
    "vanish": 'do = "vanish"\n',
    "fainter": 'do = "opacity"\nfactor = 0.4\n',
    "denser": 'do = "opacity"\nfactor = 2.5\n',
    "hue": 'do = "recolor"\nhue = 0.6\n',
    "gain": 'do = "recolor"\ngain = [0.4, 1.5, 0.8]\noffset = 0.1\n',
    "color": 'do = "recolor"\ncolor = [0.2, 0.4, 0.9]\n',
    "matrix": 'do = "recolor"\nmatrix = [[0, 1, 0], [0, 0, 1], [1, 0, 0]]\n',
    "later": 'do = "retime"\nshift = 0.15\n',
    "backwards": 'do = "retime"\nstretch = -0.7\nabout = 0.5\n',
    "freeze": 'do = "freeze"\nat = 2.5\n',
    "front": 'do = "to_front"\n',
    "back": 'do = "to_back"\n',
    "copies": 'do = "multiply"\noffsets = [[0.2, 0.1], [0.4, 0.0]]\ndelays = [0.1, 0.2]\n',
    "copies, smaller": 'do = "multiply"\noffsets = [[0.2, 0.1]]\nscale = 0.5\ndegrees = 90\nabout = [-0.15, 0]\n'
    "originals = true\n",
    "several": """do = "to_front"

        [[edits]]
        do = "multiply"
        offsets = [[0.3, 0.1]]

        [[edits]]
        do = "recolor"
        hue = 0.3

        [[edits]]
        do = "freeze"
        at = 4

        [[edits]]
        do = "move"
        offset = [0, -0.1]

        [[edits]]
        do = "retime"
        shift = 0.1

        [selections.rest]
        indices = "12-20,33"

        [[edits]]
        select = "rest"
        do = "opacity"
        factor = 0.3
        """,
}


@pytest.mark.parametrize("name", EDITS)
def test_an_edit_shows_what_foldgauss_edit_gives(opened, compact, name):
    page, model = opened(compact), load_video_model(compact)
    before = page.picture(0.9)
    read_script(page, IT + EDITS[name])
    assert_shows(page, parse_edit_script(IT + EDITS[name]).apply(model))
    assert np.abs(page.picture(0.9).astype(float) - before).mean() > 0.3 or name in ("front", "back")
    own = script_of(page)  # what the page writes means the same
    assert_shows(page, parse_edit_script(own).apply(model), (0.5,))
    page.page.keyboard.press("z")
    np.testing.assert_array_equal(page.picture(0.9), before)


@pytest.mark.parametrize("how", [{"power": 1.0, "floor": 0.1}, {"compositing": "sum"}, {"degree": 0}])
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
    text = "".join(IT + "".join(f"{EDITS[name]}\n[[edits]]\n" for name in ("transform", "gain", "copies", "fainter")))
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
    read_script(page, IT + 'do = "retime"\nshift = 0.9\n')
    page.page.click("#files-open")
    page.page.click("#download-model")
    assert "beyond the clip" in page.page.locator("#toast").inner_text()


def test_undo_and_redo_go_through_all_steps(opened, compact):
    page = opened(compact)
    page.page.keyboard.press("e")
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
    page.page.locator("#stage").click()
    page.page.evaluate("document.activeElement.blur()")
    np.testing.assert_array_equal(pictures[-1], pictures[0])
    steps = page.stats["undoable"]
    for k in range(len(pictures) - 2, -1, -1):
        page.page.keyboard.press("Control+z")
        np.testing.assert_array_equal(page.picture(0.4), pictures[k], str(k))
    assert page.page.locator("#undo").is_disabled()
    for k in range(1, len(pictures)):
        page.page.keyboard.press("Control+Shift+z")
        np.testing.assert_array_equal(page.picture(0.4), pictures[k], str(k))
    assert (page.stats["undoable"], page.stats["redoable"]) == (steps, 0)


def test_the_edit_is_there_again_when_the_page_is(opened, compact):
    page = opened(compact)
    read_script(page, IT + EDITS["move"])
    page.page.keyboard.press("e")
    select(page, [20, 21])
    before, text = page.picture(0.4), script_of(page)
    assert "20-21" in text
    page.page.reload()
    page.ready()
    page.page.keyboard.press("e")
    np.testing.assert_array_equal(page.picture(0.4), before)
    assert script_of(page) == text
    page.page.keyboard.press("z")
    page.page.keyboard.press("z")
    assert page.stats["steps"] == []
    page.page.keyboard.press("Shift+z")
    assert len(page.stats["steps"]) == 2
    page.page.evaluate("foldgauss.files.discard()")
    page.page.reload()
    page.ready()
    assert page.stats["steps"] == []


def drop(page, path):
    """Drop a file on the page."""
    data = base64.b64encode(path.read_bytes()).decode()
    page.page.evaluate(
        """([data, name]) => {
          const bytes = Uint8Array.from(atob(data), (one) => one.charCodeAt(0)), transfer = new DataTransfer();
          transfer.items.add(new File([bytes], name));
          for (const kind of ["dragover", "drop"])
            document.dispatchEvent(new DragEvent(kind, { dataTransfer: transfer, bubbles: true, cancelable: true }));
        }""",
        [data, path.name],
    )


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
    told = page.page.locator("#toast").inner_text()
    assert told.startswith("own.toml: ")
    assert message in told
    assert page.stats["undoable"] == 0


def test_selections_of_scripts_are_combined(opened, compact):
    text = '[selections.a]\nindices = "0-9"\n[selections."b c"]\nindices = "5-14" # and\n'
    text += '[selections.d]\nany = ["a", "b c"]\nwithout = [\n  "e",\n]\n'.replace('"e"', '"b c"')
    text += '[selections.current]\nany = ["d"]\nall = ["a"]\n'
    page = read_script(opened(compact), text)
    assert page.page.evaluate(PICKED) == list(range(5))


def test_segments_are_edited_by_one_script(opened):
    parts = [(6 * k, soft_model(seed=k, options=RenderOptions(), num_frames=7)) for k in range(2)]
    video = SegmentedVideo.from_models(parts)
    page = opened(video)
    page.until("foldgauss.stats.decoded.length === 2")
    page.page.evaluate("foldgauss.seek(0.2)")
    select(page, range(12))
    page.page.evaluate("foldgauss.seek(0.9)")
    select(page, range(12, 20))
    page.page.keyboard.press("e")
    page.page.locator("#move-x").fill("10")
    assert page.page.locator("#freeze").is_disabled()
    page.page.keyboard.press("Escape")
    text = script_of(page)
    edited = VideoRenderer(parse_edit_script(text).apply(video))
    plain = VideoRenderer(video)
    for t in (0.2, 0.9):
        far = np.abs(page.picture(t).astype(float) - edited.frame(t)).mean()
        assert far < 0.5 < np.abs(page.picture(t).astype(float) - plain.frame(t)).mean()


def test_json_of_steps_is_all_that_the_browser_keeps(opened, compact):
    page = opened(compact)
    read_script(page, IT + EDITS["hue"])
    page.page.evaluate("foldgauss.files.storage.flush()")
    kept = page.page.evaluate("Object.entries(localStorage)")
    ((name, text),) = kept
    assert name.startswith("foldgauss-edit-")
    assert json.loads(text) == {"steps": [{"script": page.stats["steps"]}], "done": 1}
    assert page.stats["steps"][1] == {"do": "recolor", "hue": 0.6}
    assert OBJECT.sum() == 12
    assert SIZE == (40, 64)


# ------------------------------------------------------------------------------------------- tools and handles


def screen_at(page, x, y):
    """A point of model space on the screen, CSS pixels."""
    box = page.page.locator("#stage").bounding_box()
    left, top, _ = page.page.evaluate(
        "([x, y]) => { const { view } = foldgauss.player; return view.toScreen(x, y, view.panes(1)[0]); }", [x, y]
    )
    return box["x"] + left, box["y"] + top


def drag(page, points, *, modifiers=()):
    for key in modifiers:
        page.page.keyboard.down(key)
    page.page.mouse.move(*screen_at(page, *points[0]))
    page.page.mouse.down()
    for point in points[1:]:
        page.page.mouse.move(*screen_at(page, *point), steps=3)
    page.page.mouse.up()
    for key in modifiers:
        page.page.keyboard.up(key)


def picked(page):
    return set(page.page.evaluate(PICKED))


def in_box(model, left, top, right, bottom, t=0.5):
    mean = np.asarray(eqx.filter_jit(lambda own: own.splats.at(jnp.float32(t)).mean)(model))
    inside = (mean[:, 0] > left) & (mean[:, 0] < right) & (mean[:, 1] > top) & (mean[:, 1] < bottom)
    return set(np.flatnonzero(inside).tolist())


def test_outlines_select_and_combine_by_keys(opened, compact):
    page, model = opened(compact), load_video_model(compact)
    page.page.evaluate("foldgauss.seek(0.5)")
    all_of_it, left = in_box(model, -0.3, -0.25, 0.15, 0.3), in_box(model, -0.3, -0.25, -0.1, 0.3)
    page.page.keyboard.press("r")
    drag(page, [(-0.3, -0.25), (0.15, 0.3)])
    found = picked(page)
    assert len(found) > 5
    assert found <= all_of_it  # without those that nobody sees
    drag(page, [(-0.3, -0.25), (-0.1, 0.3)], modifiers=["Alt"])
    assert picked(page) == found - left
    drag(page, [(-0.3, -0.25), (0.15, 0.3)], modifiers=["Shift"])
    assert picked(page) == found
    drag(page, [(-0.3, -0.25), (-0.1, 0.3)], modifiers=["Shift", "Alt"])
    assert picked(page) == found & left
    page.page.keyboard.press("a")
    drag(page, [(-0.3, -0.25), (0.15, -0.25), (0.15, 0.3), (-0.3, 0.3)])
    assert picked(page) == found
    page.page.keyboard.press("p")
    page.page.click("[data-how=subtract]")
    for corner in [(-0.3, -0.25), (-0.1, -0.25), (-0.1, 0.3), (-0.3, 0.3), (-0.3, -0.25)]:
        page.page.mouse.click(*screen_at(page, *corner))
    assert picked(page) == found - left
    page.page.keyboard.press("Control+i")
    assert picked(page) == set(range(NUM)) - (found - left)
    page.page.keyboard.press("Control+a")
    assert len(picked(page)) == NUM
    page.page.keyboard.press("Control+Shift+a")
    assert not picked(page)


def test_an_outline_is_drawn_while_it_grows(opened, compact):
    page = opened(compact)
    page.page.keyboard.press("p")
    for corner in [(-0.2, -0.1), (0.1, -0.1), (0.1, 0.1)]:
        page.page.mouse.click(*screen_at(page, *corner))
    outline = page.page.locator("#outline path").last
    assert outline.get_attribute("d").count("L") >= 2
    page.page.keyboard.press("Backspace")
    page.page.keyboard.press("Escape")
    assert outline.get_attribute("d") == ""
    assert page.stats["editing"]


def test_a_color_selects_what_looks_like_it(opened, compact):
    page, model = opened(compact), load_video_model(compact)
    page.page.keyboard.press("i")
    page.page.locator("#tolerance-value").fill("12")
    page.page.evaluate("foldgauss.controls.tools.picker.colorAt = () => [0.2, 0.5, 0.3]")
    page.page.mouse.click(*screen_at(page, 0, 0))
    color = np.clip(0.5 + 0.28209479 * np.asarray(model.splats.color_dc), 0, 1)
    assert picked(page) == set(
        np.flatnonzero(np.linalg.norm(to_lab(color) - to_lab(np.array([0.2, 0.5, 0.3])), axis=-1) <= 12)
    )


def test_the_eyedropper_sees_the_color_that_is_shown(opened, compact):
    page = opened(compact)
    shown = page.picture(0.5)
    for x, y in ((-0.15, 0.0), (0.1, 0.1), (0.3, -0.1)):
        column, row = int((x + 0.5) * SIZE[1]), int((y + 0.5 * SIZE[0] / SIZE[1]) * SIZE[1])
        x, y = (column + 0.5) / SIZE[1] - 0.5, (row + 0.5 - SIZE[0] / 2) / SIZE[1]
        color = page.page.evaluate(
            "([x, y]) => foldgauss.controls.tools.picker.colorAt(foldgauss.player.state, foldgauss.player.ownTime, x, y)",
            [x, y],
        )
        np.testing.assert_allclose(np.array(color) * 255, shown[row, column], atol=4)


def test_a_selection_grows_and_shrinks(opened, compact):
    page = opened(compact)
    page.page.evaluate("foldgauss.seek(0.5)")
    page.page.keyboard.press("e")
    page.page.evaluate("Object.defineProperty(foldgauss.controls.tools, 'distance', { value: 0.12 })")
    select(page, [0])
    sizes = [1]
    for _ in range(3):
        page.page.click("#grow")
        sizes.append(page.stats["picked"])
    assert sizes == sorted(sizes)
    assert sizes[-1] > sizes[1] > 1
    grown = picked(page)
    page.page.click("#shrink")
    assert picked(page) < grown


def test_handles_and_numbers_are_one_edit(opened, compact):
    page, model = opened(compact), load_video_model(compact)
    page.page.evaluate("foldgauss.seek(0.5)")
    page.page.keyboard.press("e")
    select(page, range(12))
    page.page.keyboard.press("v")
    page.settle()
    frame = page.page.locator("#handle-move").bounding_box()
    middle = frame["x"] + frame["width"] / 2, frame["y"] + frame["height"] / 2
    unit = page.page.evaluate(
        "(() => { const { view } = foldgauss.player; return view.toScreen(0, 0, view.panes(1)[0])[2] })()"
    )
    page.page.mouse.move(*middle)
    page.page.mouse.down()
    page.page.mouse.move(middle[0] + 0.1 * unit, middle[1] - 0.05 * unit, steps=5)
    page.page.mouse.up()
    (_, move) = page.stats["steps"]
    np.testing.assert_allclose(move["offset"], [0.1, -0.05], atol=1e-3)
    assert float(page.page.locator("#move-x").input_value()) == pytest.approx(6.4, abs=0.1)
    page.page.locator("#move-x").fill("3.2")
    assert page.stats["steps"][1]["offset"][0] == pytest.approx(0.05)
    assert len(page.stats["steps"]) == 2
    page.page.evaluate("document.activeElement.blur()")
    page.page.keyboard.press("Alt+Shift+ArrowRight")
    assert page.stats["steps"][1]["offset"][0] == pytest.approx(0.05 + 10 / 64)
    for handle, key in (("#handle-scale", "factor"), ("#handle-rotate", "degrees")):
        page.settle()
        box = page.page.locator(handle).bounding_box()
        at = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
        page.page.mouse.move(*at)
        page.page.mouse.down()
        page.page.mouse.move(at[0] + 60, at[1] + 40, steps=4)
        page.page.mouse.up()
        assert key in page.stats["steps"][-1]
        assert len(page.stats["steps"][-1]["about"]) == 2
    assert page.stats["steps"][2]["factor"] > 1.1
    assert 5 < page.stats["steps"][3]["degrees"] < 90
    page.page.keyboard.press("Escape")
    assert_shows(page, parse_edit_script(script_of(page)).apply(model), (0.5, 0.8))


def test_fields_make_the_edits_that_they_name(opened, compact):
    page = opened(compact)
    page.page.evaluate("foldgauss.seek(0.5)")
    page.page.keyboard.press("e")
    select(page, range(12))
    for name, value, step in (
        ("scale", "150", {"do": "scale", "factor": 1.5}),
        ("rotate", "30", {"do": "rotate", "degrees": 30}),
        ("hue-value", "120", {"do": "recolor", "hue": 0.333333}),
        ("gain", "1.5", {"do": "recolor", "gain": 1.5}),
        ("opacity-value", "0.5", {"do": "opacity", "factor": 0.5}),
        ("shift", "3", {"do": "retime", "shift": 0.5}),
        ("stretch", "2", {"do": "retime", "stretch": 0.5, "about": 0.5}),
    ):
        page.page.locator(f"#{name}").fill(value)
        last = page.stats["steps"][-1]
        assert {key: own for key, own in last.items() if key in step} == step
        assert page.page.locator(f"#{name}").input_value() == value
    page.page.locator("#copies").fill("2")
    page.page.locator("#delay").fill("1.5")
    page.page.click("#duplicate")
    expected = {"do": "multiply", "offsets": [[0.3125, 0], [0.625, 0]], "delays": [0.25, 0.5]}
    assert page.stats["steps"][-1] == expected
    page.page.locator("#copies").fill("1")
    assert page.stats["steps"][-1]["offsets"] == [[0.3125, 0]]
    page.page.click("#to-back")
    page.page.click("#freeze")
    page.page.click("#vanish")
    assert [step.get("do") for step in page.stats["steps"][-3:]] == ["to_back", "freeze", "vanish"]
    assert page.page.locator("#edits").is_disabled()


def test_the_keyboard_alone_selects_and_edits(opened, compact):
    page = opened(compact)
    page.page.keyboard.press("r")
    page.page.locator("#canvas").focus()
    press = page.page.keyboard.press
    for _ in range(20):
        press("ArrowLeft")
    press("Enter")
    for _ in range(30):
        press("ArrowRight")
        press("ArrowDown")
    press("Enter")
    assert page.stats["picked"] > 2
    press("d")
    press("Delete")
    assert [step.get("do") for step in page.stats["steps"]] == [None, "multiply", "vanish"]


def test_fingers_brush_and_pinch(opened, compact):
    page = opened(compact, has_touch=True)
    page.page.keyboard.press("b")
    box = page.page.locator("#canvas").bounding_box()
    touch = page.context.new_cdp_session(page.page)
    middle = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2

    def send(kind, *points):
        touch.send(
            "Input.dispatchTouchEvent",
            {"type": kind, "touchPoints": [{"x": x, "y": y, "id": k} for k, (x, y) in enumerate(points)]},
        )

    send("touchStart", middle)
    send("touchMove", (middle[0] - 80, middle[1] + 10))
    send("touchEnd")
    count = page.stats["picked"]
    assert count > 0
    send("touchStart", middle, (middle[0] + 50, middle[1]))
    send("touchMove", (middle[0] - 50, middle[1]), (middle[0] + 100, middle[1]))
    send("touchEnd")
    assert page.stats["zoom"] > 2
    assert page.stats["picked"] == count  # a pinch is no stroke


# ----------------------------------------------------------------------------------------- files and recording


@pytest.fixture
def bare(browser, tmp_path):
    """The page without a model."""
    path = tmp_path / "index.html"
    path.write_text(empty_page(), encoding="utf-8")
    page = Opened(browser, path, viewport={"width": 900, "height": 640})
    page.page.locator("#notice-open").wait_for()
    yield page
    page.close()
    assert not page.said
    assert all(url.startswith(("file:", "blob:", "data:")) for url in page.asked)


def thinned():
    """A model whose file leaves out parameters: static and opaque Gaussians, shared colours, several degrees."""
    model = soft_model(options=RenderOptions())
    leaves = {
        name: np.array(getattr(model.splats, name)) for name in ("time_loc_logit", "log_time_scale", "opacity_logit")
    }
    leaves["time_loc_logit"][::2], leaves["log_time_scale"][::2] = 0, np.log(np.float32(1024))
    leaves["opacity_logit"][::3] = 8
    color, coefficients = np.array(model.splats.color_dc), np.array(model.splats.coefficients)
    color[:] = color[np.arange(NUM) % 4]
    coefficients[::2] = 0
    splats = dataclasses.replace(model.splats, **leaves, color_dc=color, coefficients=coefficients)
    return dataclasses.replace(model, splats=splats)


def test_the_empty_page_opens_any_model(bare, compact, tmp_path):
    model = soft_model(options=RenderOptions(), seed=3)
    save_video_model(tmp_path / "plain.safetensors", model)
    save_video_model(tmp_path / "thin.safetensors", thinned())
    export(model, "ply", tmp_path / "vegas.ply")
    for path in (tmp_path / "plain.safetensors", compact, tmp_path / "thin.safetensors", tmp_path / "vegas.ply"):
        bare.page.evaluate("window.foldgauss.seek = null")
        drop(bare, path)
        bare.until(f"foldgauss.seek && document.title === '{path.stem}'")
        wanted = import_model(path) if path.suffix == ".ply" else load_video_model(path)
        assert_shows(bare, wanted)
        assert bare.stats["total"] == NUM
    read_script(bare, IT + EDITS["rotate"])
    assert_shows(bare, parse_edit_script(IT + EDITS["rotate"]).apply(wanted))


def test_a_vegas_file_without_a_size_is_asked_for_it(bare, tmp_path):
    model = soft_model(options=RenderOptions())
    path = export(model, "ply", tmp_path / "theirs.ply")
    path.write_bytes(re.sub(rb"comment foldgauss [^\n]*\n", b"", path.read_bytes()))
    drop(bare, path)
    bare.page.locator("#facts-needed").wait_for()
    for name, value in (("width", SIZE[1]), ("height", SIZE[0]), ("fps", 12)):
        bare.page.locator(f"#needed-{name}").fill(str(value))
    bare.page.click("#facts-needed [value=open]")
    bare.until("foldgauss.seek")
    assert_shows(bare, import_model(path, size=SIZE, fps=12))
    assert bare.page.locator("#whole").inner_text() == "/ 0:00.50"


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.png", b"\x89PNG\r\n\x1a\n" + bytes(30), "This is a picture. Expected a model"),
        ("a.mp4", bytes(4) + b"ftypisom" + bytes(30), "This is a video. Expected a model: .safetensors"),
        ("a.bin", b"hello, world", "This is something else. Expected a model"),
        ("a.fgz", b"", "The file is empty"),
        ("a.safetensors", (2).to_bytes(8, "little") + b"{}", "a safetensors file of another program"),
        ("b.safetensors", (200).to_bytes(8, "little") + b"{}", "damaged or cut short"),
        (
            "a.ply",
            b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\n1\n",
            "is no video of VeGaS",
        ),
        (
            "b.ply",
            b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float f_dc_0\nend_header\n1\n",
            "a still 3DGS scene",
        ),
        (
            "c.ply",
            b"ply\nformat binary_little_endian 1.0\nelement vertex 9\nproperty float x\nend_header\n1",
            "cut short",
        ),
        ("a.toml", b"", "Open the model first"),
    ],
)
def test_files_that_cannot_be_opened_are_told(bare, tmp_path, name, content, message):
    (tmp_path / name).write_bytes(content)
    drop(bare, tmp_path / name)
    bare.page.locator("#toast").wait_for()
    assert message in bare.page.locator("#toast").inner_text()
    assert bare.page.locator("#notice-open").is_visible()


def test_damaged_models_are_told(bare, compact, tmp_path):
    good = save_video_model(tmp_path / "m.safetensors", soft_model()).read_bytes()
    for name, content in (
        ("cut.safetensors", good[:-100]),
        ("nan.safetensors", good[:-8] + np.float32([np.nan, 1]).tobytes()),
        ("cut.fgz", compact.read_bytes()[:-50]),
    ):
        (tmp_path / name).write_bytes(content)
        bare.page.evaluate("document.getElementById('toast').hidden = true")
        drop(bare, tmp_path / name)
        bare.page.locator("#toast").wait_for()
        assert "damaged" in bare.page.locator("#toast").inner_text()


def test_view_saves_to_disk_and_takes_it_up_again(browser, compact, tmp_path):
    script, token = tmp_path / "clip.edit.toml", make_token()

    def served():
        saved = script.read_bytes() if script.exists() else None
        page = html_page(compact, save_to=SaveTarget(script.name, token, saved))
        return PageServer(page.encode(), 0, script=script, token=token)

    @contextmanager
    def shown():
        with served() as server:
            thread = threading.Thread(target=server.serve_forever)
            thread.start()
            page = Opened(browser, server.url, viewport={"width": 900, "height": 640}).ready()
            try:
                yield page
            finally:
                page.close()
                server.shutdown()
                thread.join()
        assert not page.said
        assert all(url.startswith((server.url, "blob:", "data:")) for url in page.asked)

    with shown() as page:
        read_script(page, IT + EDITS["move"])
        page.page.keyboard.press("Control+s")
        page.page.get_by_text("Saved as clip.edit.toml").wait_for()
        assert script.read_text() == script_of(page)
        wanted = page.picture(0.4)
    with shown() as page:  # at another port, whose browser storage is another
        np.testing.assert_array_equal(page.picture(0.4), wanted)
        assert_shows(page, read_edit_script(script).apply(load_video_model(compact)))
    script.write_text("[selections.it]\nbox = [0, 0, 9, 9]\nframe = 0\n")
    with shown() as page:
        assert "box: expected indices" in page.page.locator("#toast").inner_text()
        page.page.keyboard.press("s")
        assert page.page.locator("#save-disk").is_disabled()
        assert "left alone" in page.page.locator("#save-about").inner_text()


def test_a_picture_is_what_is_shown(opened, compact, tmp_path):
    page = opened(compact)
    page.page.evaluate("foldgauss.seek(0.5)")
    page.page.keyboard.press("e")
    select(page, range(12))
    page.page.keyboard.press("s")
    page.page.locator("#record-height").fill("80")
    assert download(page, "#picture", tmp_path / "frame.png") == "clip-3.png"
    saved = cv2.imread(str(tmp_path / "frame.png"))[..., ::-1]
    page.page.keyboard.press("e")
    np.testing.assert_array_equal(saved, page.picture(size=(80, 128)))  # without the marks of the selection


def test_a_video_is_recorded(opened, compact, tmp_path):
    page = opened(compact)
    page.page.keyboard.press("s")
    for name, value in (("height", 80), ("speed", 0.25), ("first", 1), ("last", 5)):
        page.page.locator(f"#record-{name}").fill(str(value))
    with page.page.expect_download() as waited:
        page.page.click("#record")
    waited.value.save_as(tmp_path / "clip.webm")
    assert waited.value.suggested_filename == "clip.webm"
    page.page.evaluate("document.getElementById('files').close()")
    clip = read_video(tmp_path / "clip.webm").frames
    assert clip.shape[1:3] == (80, 128)
    for frame, t in ((clip[0], 1 / 6), (clip[-1], 5 / 6)):
        assert np.abs(frame.astype(float) - page.picture(t, (80, 128))).mean() < 6
    assert np.abs(clip[0].astype(float) - clip[-1]).mean() > 6
    assert page.stats["position"] == 5  # where the pictures were just taken


def test_small_screens_and_both_themes_show_all(browser, compact, tmp_path):
    path = write_html(tmp_path / "page.html", compact)
    for width, height, scheme in ((1280, 800, "dark"), (360, 640, "light"), (740, 360, "dark")):
        page = Opened(browser, path, viewport={"width": width, "height": height}, color_scheme=scheme, has_touch=True)
        page.ready().page.keyboard.press("e")
        select(page, range(12))
        for name in ("panel", "files"):
            if name == "files":
                page.page.keyboard.press("s")
            assert page.page.evaluate("document.documentElement.scrollWidth") <= width
            outside = page.page.evaluate(
                """(name) => [...document.getElementById(name).querySelectorAll("button, input:not([type=file])")]
                .filter((own) => own.offsetParent).map((own) => [own.id, own.getBoundingClientRect()])
                .filter(([, box]) => box.left < 0 || box.right > innerWidth || box.width < 30 || box.height < 30)
                .map(([id, box]) => `${id} ${box.left} ${box.width} ${box.height}`)""",
                name,
            )
            assert outside == []
        low = page.page.evaluate(
            """() => {
              const parse = (text) => text.match(/[\\d.]+/g).map(Number), linear = (c) => (c / 255) ** 2.2;
              const light = (rgb) => 0.2126 * linear(rgb[0]) + 0.7152 * linear(rgb[1]) + 0.0722 * linear(rgb[2]);
              const back = (own) => { for (; own; own = own.parentElement) {
                const [r, g, b, a = 1] = parse(getComputedStyle(own).backgroundColor); if (a > 0.99) return [r, g, b]; } };
              return [...document.querySelectorAll("h1, h2, h3, p, label, button:enabled, output, span")]
                .filter((own) => own.offsetParent && own.textContent.trim() && !own.closest(":disabled"))
                .map((own) => {
                  const ink = light(parse(getComputedStyle(own).color)), paper = light(back(own) ?? [0, 0, 0]);
                  return [own.id || own.textContent.trim().slice(0, 20), (Math.max(ink, paper) + 0.05) / (Math.min(ink, paper) + 0.05)];
                }).filter(([, ratio]) => ratio < 4.5);
            }"""
        )
        assert low == []
        page.close()
