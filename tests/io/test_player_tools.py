"""The player's tools: selections, handles and numbers by mouse, keys and fingers."""

import numpy as np
import pytest
from browser import Opened
from editor_page import EDITS, IT, assert_shows, drag, in_box, picked, read_script, screen_at, script_of, select
from soft_models import NUM, NUM_FRAMES, SIZE, soft_model

from foldgauss.io import html_page, load_video_model
from foldgauss.io.edit_script import parse_edit_script
from foldgauss.render import RenderOptions
from foldgauss.video import NothingMoves, SegmentedVideo, by_mask
from foldgauss.video.selection import selectors
from foldgauss.video.selection.tracking import to_lab


@pytest.mark.slow
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
    page, model = opened(compact, fresh=True), load_video_model(compact)
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
            "(at) => foldgauss.controls.tools.picker.colorAt(foldgauss.player.state, foldgauss.player.ownTime, ...at)",
            [x, y],
        )
        np.testing.assert_allclose(np.array(color) * 255, shown[row, column], atol=4)


@pytest.mark.slow
def test_a_button_selects_what_moves(browser, compact, tmp_path, monkeypatch):
    masks = np.zeros((NUM_FRAMES, *SIZE), bool)
    masks[:, :, : SIZE[1] // 2] = True
    monkeypatch.setattr(selectors, "find_moving_object", lambda frames: masks)
    path, other = tmp_path / "clip.html", soft_model(options=RenderOptions(), seed=3)
    video = SegmentedVideo.from_models([(0, load_video_model(compact)), (NUM_FRAMES, other)])
    for model, parts in ((compact, [load_video_model(compact)]), (video, [load_video_model(compact), other])):
        path.write_text(html_page(model, moving=True))
        page = Opened(browser, path).ready()
        page.page.keyboard.press("e")
        page.page.click("#select-moving")
        expected = [set(np.flatnonzero(by_mask(one, masks).mask).tolist()) for one in parts]
        assert all(5 < len(found) < NUM - 5 for found in expected)
        for time, found in zip((0.2, 0.8), (expected[0], expected[-1]), strict=True):
            page.page.evaluate("(t) => foldgauss.seek(t)", time)
            assert picked(page) == found
        page.page.keyboard.press("z")
        assert not picked(page)
        page.check()
        page.close()
    plain = Opened(browser).go(tmp_path / "clip.html")
    path.write_text(html_page(compact))
    plain.go(path).ready().page.keyboard.press("e")
    assert plain.page.locator("#select-moving").is_hidden()
    plain.close()
    masks[:, :, 1:] = False  # a column of pixels
    with pytest.raises(
        NothingMoves, match="moving: expected an object that has Gaussians of its own, got one that covers up to 40 of"
    ):
        html_page(compact, moving=True)


def test_a_selection_grows_and_shrinks(opened, compact):
    page = opened(compact, fresh=True)
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


@pytest.mark.slow
def test_handles_and_numbers_are_one_edit(opened, compact):
    page, model = opened(compact, viewport={"width": 480, "height": 760}), load_video_model(compact)
    page.page.evaluate("foldgauss.seek(0.5)")
    page.page.keyboard.press("e")
    select(page, range(12))
    page.page.keyboard.press("v")
    page.settle()
    frame = page.page.locator("#handle-move").bounding_box()
    middle = frame["x"] + frame["width"] / 2, frame["y"] + frame["height"] / 2
    (left, _), (right, _) = screen_at(page, 0, 0), screen_at(page, 1, 0)
    unit = right - left
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
        page.page.mouse.move(at[0] + 0.07 * unit, at[1] + 0.05 * unit, steps=4)
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
    assert page.page.locator("#to-back").is_disabled()  # nothing is selected any more


FIELDS = "move-x", "scale", "rotate", "hue-value", "gain-value", "opacity-value", "shift", "stretch"


def fields(page):
    return [page.page.locator(f"#{name}").input_value() for name in FIELDS]


@pytest.mark.slow
def test_numbers_show_what_the_edits_of_the_selection_add_up_to(opened, compact):
    page, model = opened(compact), load_video_model(compact)
    page.page.keyboard.press("e")
    begun = ["0", "100", "0", "", "1", "1", "0", "1"]
    assert fields(page) == begun
    select(page, range(12))
    seen = [fields(page)]
    colors = [("gain", "2"), ("hue", "200"), ("move-x", "8"), ("gain-value", "1.2"), ("scale", "150"), ("move-x", "5")]
    places = [("scale", "50"), ("rotate", "40"), ("shift", "2"), ("rotate", "-5"), ("shift", "3"), ("stretch", "-2")]
    for name, value in colors + places:
        page.page.locator(f"#{name}").fill(value)
        seen.append(fields(page))
    assert seen[6] == ["5", "150", "0", "200", "1.2", "1", "0", "1"]
    assert seen[-1] == ["5", "50", "-5", "200", "1.2", "1", "3", "-2"]
    assert page.page.locator("#hue").input_value() == "200"
    gains = [step["gain"] for step in page.stats["steps"] if "gain" in step]
    assert gains == [2, 0.6]
    page.page.keyboard.press("Escape")
    assert_shows(page, parse_edit_script(script_of(page)).apply(model), (0.5,))
    page.page.keyboard.press("e")
    page.page.evaluate("document.activeElement.blur()")
    for key, order in (("Control+z", reversed(seen[:-1])), ("Control+Shift+z", seen[1:])):
        for expected in order:
            page.page.keyboard.press(key)
            assert fields(page) == expected
    select(page, range(12, 20))  # another selection has had no edit
    assert fields(page) == begun
    select(page, range(8, 16))  # some have, some have not
    assert fields(page) == [""] * 5 + ["1", "", ""]
    page.page.locator("#gain-value").fill("3")  # a change by that much
    assert (page.stats["steps"][-1], fields(page)[4]) == ({"do": "recolor", "gain": 3}, "3")
    page.page.locator("#opacity-value").fill("0.5")
    assert fields(page)[3:6] == ["", "", "0.5"]
    select(page, range(8, 12))
    assert fields(page) == [*seen[-1][:4], "3.6", "0.5", *seen[-1][6:]]
    page.page.click("#duplicate")  # to the right by 20 pixels
    assert fields(page)[:5] == ["25", *seen[-1][1:4], "3.6"]


def test_the_numbers_of_a_script_are_those_of_its_edits(opened, compact):
    page = opened(compact)
    page.page.keyboard.press("e")
    read_script(page, IT + EDITS["scale"] + "\n[[edits]]\n" + EDITS["gain"] + "\n[[edits]]\n" + EDITS["hue"])
    assert fields(page) == ["0", "160", "0", "216", "", "1", "0", "1"]  # a gain for each channel is no brightness
    read_script(page, IT + EDITS["transform"] + "\n[[edits]]\n" + EDITS["later"])
    assert fields(page) == ["", "", "", "", "1", "1", "0.9", "1"]


def test_keys_work_while_a_number_has_the_focus(opened, compact):
    page = opened(compact)
    page.page.keyboard.press("e")
    select(page, range(12))
    field, press = page.page.locator("#gain-value"), page.page.keyboard.press
    field.fill("")
    field.press_sequentially("1.5e0")
    press("ArrowLeft")
    press("Backspace")
    press("Delete")
    assert (field.input_value(), page.stats["steps"][-1]) == ("1.5", {"do": "recolor", "gain": 1.5})
    press("Control+z")
    assert (field.input_value(), page.stats["undoable"]) == ("1", 1)
    press("Control+Shift+z")
    assert (field.input_value(), page.stats["undoable"]) == ("1.5", 2)
    press("Control+y")
    press("r")
    assert page.stats["tool"] == "rectangle"
    assert page.page.evaluate("document.activeElement.id") == "gain-value"
    press("Control+a")
    press("2")
    assert (field.input_value(), page.stats["mode"], page.stats["picked"]) == ("2", "model", 12)
    press("Control+i")
    assert page.stats["picked"] == NUM - 12
    press("Space")
    assert page.stats["playing"]


def test_the_count_tells_copies_apart(opened, compact):
    page = opened(compact)
    page.page.keyboard.press("e")
    shown = page.page.locator("#picked")
    select(page, range(12))
    assert shown.inner_text() == "12 selected"
    page.page.locator("#copies").fill("2")
    page.page.click("#duplicate")
    assert shown.inner_text() == "24, copies of 12"
    select(page, range(36))  # each with its copies behind it
    assert shown.inner_text() == "36, copies of 12"


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
    page = opened(compact)
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
