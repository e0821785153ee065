"""The player's tools: selections, handles and numbers by mouse, keys and fingers."""

import numpy as np
import pytest
from browser import Opened
from editor_page import (
    EDITS,
    IT,
    assert_shows,
    begin_edit,
    drag,
    in_box,
    picked,
    pull,
    read_script,
    screen_at,
    script_of,
    select,
)
from soft_models import NUM, NUM_FRAMES, SIZE, soft_model

from foldgauss.io import html_page, load_video_model, save_compact, write_html
from foldgauss.io.edit_script import parse_edit_script
from foldgauss.io.page.player_page import quantize_finely
from foldgauss.render import RenderOptions
from foldgauss.video import EditedVideo, Layer, SegmentedVideo, by_mask
from foldgauss.video.selection import selectors
from foldgauss.video.selection.tracking import to_lab


@pytest.mark.slow
def test_outlines_select_and_combine_by_keys(opened, compact):
    page, model = opened(compact).seek(0.5), load_video_model(compact)
    whole, part = (-0.3, -0.25, 0.15, 0.3), (-0.3, -0.25, -0.1, 0.3)
    left = in_box(model, *part)
    page.press("r")
    drag(page, [whole[:2], whole[2:]])
    found = picked(page)
    assert len(found) > 5
    assert found <= in_box(model, *whole)  # without those that nobody sees
    for box, modifiers, expected in (
        (part, ["Alt"], found - left),
        (whole, ["Shift"], found),
        (part, ["Shift", "Alt"], found & left),
    ):
        drag(page, [box[:2], box[2:]], modifiers=modifiers)
        assert picked(page) == expected
    page.press("a")
    drag(page, [(-0.3, -0.25), (0.15, -0.25), (0.15, 0.3), (-0.3, 0.3)])
    assert picked(page) == found
    page.press("p")
    page.page.click("[data-how=subtract]")
    for corner in [(-0.3, -0.25), (-0.1, -0.25), (-0.1, 0.3), (-0.3, 0.3), (-0.3, -0.25)]:
        page.page.mouse.click(*screen_at(page, *corner))
    assert picked(page) == found - left
    for key, expected in (
        ("Control+i", set(range(NUM)) - (found - left)),
        ("Control+a", set(range(NUM))),
        ("Control+Shift+a", set()),
    ):
        page.press(key)
        assert picked(page) == expected


@pytest.mark.slow
def test_an_outline_is_drawn_while_it_grows(opened, compact):
    page = opened(compact).press("p")
    for corner in [(-0.2, -0.1), (0.1, -0.1), (0.1, 0.1)]:
        page.page.mouse.click(*screen_at(page, *corner))
    outline = page.page.locator("#outline path").last
    assert outline.get_attribute("d").count("L") >= 2
    page.press("Backspace", "Escape")
    assert outline.get_attribute("d") == ""
    assert page.stats["editing"]


def test_a_color_selects_what_looks_like_it(opened, compact):
    page, model = opened(compact, fresh=True), load_video_model(compact)
    page.press("i")
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
        page.press("e")
        page.page.click("text=Select the moving object")
        expected = [set(np.flatnonzero(by_mask(one, masks).mask).tolist()) for one in parts]
        assert all(5 < len(found) < NUM - 5 for found in expected)
        for time, found in zip((0.2, 0.8), (expected[0], expected[-1]), strict=True):
            page.page.evaluate("(t) => foldgauss.seek(t)", time)
            assert picked(page) == found
        page.press("z")
        assert not picked(page)
        page.check()
        page.close()
    plain = Opened(browser).go(tmp_path / "clip.html")
    path.write_text(html_page(compact))
    plain.go(path).ready().page.keyboard.press("e")
    assert not plain.page.locator("#select-objects button").count()
    plain.close()


def test_layers_have_buttons(browser, compact, tmp_path):
    model = load_video_model(compact)
    names = {"front": model, "<b>back": model}
    video = EditedVideo(tuple(Layer(one, name=name) for name, one in names.items()))
    save_compact(tmp_path / "two.fgz", {name: quantize_finely(one) for name, one in names.items()})
    for number, shown in enumerate((video, tmp_path / "two.fgz")):
        path = write_html(tmp_path / f"{number}.html", shown, linked=bool(number))
        page = Opened(browser, path).ready() if not number else None
        if page is None:
            assert (tmp_path / "1.page.fgz").exists()  # of one model, which the page decodes
            continue
        page.press("e")
        assert page.page.locator("#select-objects button").all_text_contents() == ["Select front", "Select <b>back"]
        page.page.locator("#select-objects button").last.click()
        page.page.evaluate("(t) => foldgauss.seek(t)", 0.5)
        assert min(picked(page)) >= NUM
        page.check()
        page.close()


def test_a_selection_grows_and_shrinks(opened, compact):
    page = begin_edit(opened(compact, fresh=True), [0], at=0.5)
    page.page.evaluate("Object.defineProperty(foldgauss.controls.tools, 'distance', { value: 0.12 })")
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
    begin_edit(page, range(12), at=0.5).press("v")
    unit = screen_at(page, 1, 0)[0] - screen_at(page, 0, 0)[0]

    def pull_handle(name, right, down):
        box = page.settle().page.locator(name).bounding_box()
        pull(page, (box["x"] + box["width"] / 2, box["y"] + box["height"] / 2), (right * unit, down * unit))

    pull_handle("#handle-move", 0.1, -0.05)
    (_, move) = page.stats["steps"]
    np.testing.assert_allclose(move["offset"], [0.1, -0.05], atol=1e-3)
    assert float(page.page.locator("#move-x").input_value()) == pytest.approx(6.4, abs=0.1)
    page.page.locator("#move-x").fill("3.2")
    assert page.stats["steps"][1]["offset"][0] == pytest.approx(0.05)
    assert len(page.stats["steps"]) == 2
    page.page.evaluate("document.activeElement.blur()")
    page.press("Alt+Shift+ArrowRight")
    assert page.stats["steps"][1]["offset"][0] == pytest.approx(0.05 + 10 / 64)
    for name in ("#handle-scale", "#handle-rotate"):
        pull_handle(name, 0.07, 0.05)
        assert len(page.stats["steps"][-1]["about"]) == 2
    assert page.stats["steps"][2]["factor"] > 1.1
    assert 5 < page.stats["steps"][3]["degrees"] < 90
    page.press("Escape")
    assert_shows(page, parse_edit_script(script_of(page)).apply(model), (0.5, 0.8))


def test_fields_make_the_edits_that_they_name(opened, compact):
    page = begin_edit(opened(compact), range(12), at=0.5)
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
    page, model = begin_edit(opened(compact)), load_video_model(compact)
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
    page.press("Escape")
    assert_shows(page, parse_edit_script(script_of(page)).apply(model), (0.5,))
    page.press("e")
    page.page.evaluate("document.activeElement.blur()")
    for key, order in (("Control+z", reversed(seen[:-1])), ("Control+Shift+z", seen[1:])):
        for expected in order:
            page.press(key)
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
    page = begin_edit(opened(compact))
    read_script(page, IT + EDITS["scale"] + "\n[[edits]]\n" + EDITS["gain"] + "\n[[edits]]\n" + EDITS["hue"])
    assert fields(page) == ["0", "160", "0", "216", "", "1", "0", "1"]  # a gain for each channel is no brightness
    read_script(page, IT + EDITS["transform"] + "\n[[edits]]\n" + EDITS["later"])
    assert fields(page) == ["", "", "", "", "1", "1", "0.9", "1"]


def test_keys_work_while_a_number_has_the_focus(opened, compact):
    page = begin_edit(opened(compact), range(12))
    field = page.page.locator("#gain-value")
    field.fill("")
    field.press_sequentially("1.5e0")
    page.press("ArrowLeft", "Backspace", "Delete")
    assert (field.input_value(), page.stats["steps"][-1]) == ("1.5", {"do": "recolor", "gain": 1.5})
    for key, value, undoable in (("Control+z", "1", 1), ("Control+Shift+z", "1.5", 2)):
        page.press(key)
        assert (field.input_value(), page.stats["undoable"]) == (value, undoable)
    page.press("Control+y", "r")
    assert page.stats["tool"] == "rectangle"
    assert page.page.evaluate("document.activeElement.id") == "gain-value"
    page.press("Control+a", "2")
    assert (field.input_value(), page.stats["mode"], page.stats["picked"]) == ("2", "model", 12)
    page.press("Control+i")
    assert page.stats["picked"] == NUM - 12
    page.press("Space")
    assert page.stats["playing"]


def test_the_count_tells_copies_apart(opened, compact):
    page = begin_edit(opened(compact), range(12))
    shown = page.page.locator("#picked")
    assert shown.inner_text() == "12 selected"
    page.page.locator("#copies").fill("2")
    page.page.click("#duplicate")
    assert shown.inner_text() == "24, copies of 12"
    select(page, range(36))  # each with its copies behind it
    assert shown.inner_text() == "36, copies of 12"


def test_the_keyboard_alone_selects_and_edits(opened, compact):
    page = opened(compact).press("r")
    page.page.locator("#canvas").focus()
    page.press(*20 * ["ArrowLeft"], "Enter", *30 * ["ArrowRight", "ArrowDown"], "Enter")
    assert page.stats["picked"] > 2
    page.press("d", "Delete")
    assert [step.get("do") for step in page.stats["steps"]] == [None, "multiply", "vanish"]


def test_fingers_brush_and_pinch(opened, compact):
    page = opened(compact).press("b")
    box = page.page.locator("#canvas").bounding_box()
    touch = page.context.new_cdp_session(page.page)
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2

    def swipe(*moves):
        for kind, points in zip(("touchStart", "touchMove", "touchEnd"), (*moves, []), strict=True):
            points = [{"x": right, "y": down, "id": k} for k, (right, down) in enumerate(points)]
            touch.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})

    swipe([(x, y)], [(x - 80, y + 10)])
    count = page.stats["picked"]
    assert count > 0
    swipe([(x, y), (x + 50, y)], [(x - 50, y), (x + 100, y)])
    assert page.stats["zoom"] > 2
    assert page.stats["picked"] == count  # a pinch is no stroke
