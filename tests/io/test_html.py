"""The player's page: whole in itself, closed to the network, and its pictures those of the CPU engine."""

import base64
import dataclasses
import hashlib
import json
import re
import shutil
import subprocess
from html.parser import HTMLParser

import cv2
import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from browser import Opened
from editor_page import PICKED, drop, pull, screen_at
from made_clips import moving as waves
from soft_models import NUM, OBJECT, SIZE, on_paths, soft_model

from foldgauss.envelope import TimeLikelihood
from foldgauss.io import html_page, load_video_model, save_compact, save_video_model, write_html
from foldgauss.io.models.video_model import read_origin
from foldgauss.io.page import player_page
from foldgauss.io.page.player_page import quantize_finely
from foldgauss.render import RenderOptions
from foldgauss.video import FitConfig, FoldedSplats, FrameTimes, SegmentedVideo, VideoModel, edit, fit, layers
from foldgauss.video.compression.quantize import dequantize
from foldgauss.video.models.frame_times import make_time_logits
from foldgauss.video.models.renderer import VideoRenderer

#: What the brush is made of.
MODULES = ("gaussians", "paths", "timeline")


class _Elements(HTMLParser):
    """Tags with their attributes, and the text of scripts, styles and the title."""

    def __init__(self, text):
        super().__init__()
        self.tags, self.texts = [], []
        self.feed(text)

    def handle_starttag(self, tag, attributes):
        self.tags.append((tag, dict(attributes)))

        self.texts.append((tag, dict(attributes), []))

    def handle_endtag(self, tag):
        self.texts.append(("", {}, []))  # of what comes after

    def handle_data(self, data):
        if self.texts:
            self.texts[-1][2].append(data)

    def text(self, tag, **wanted):
        """What is in the one element with these attributes."""
        (found,) = [text for own, attributes, text in self.texts if own == tag and attributes | wanted == attributes]
        return "".join(found)


def data_of(page, name="model"):
    return base64.b64decode(_Elements(page).text("script", id=name))


# ---------------------------------------------------------------------------------------------------- the page


def test_the_page_can_reach_no_network():
    page = html_page(soft_model(), original=waves(7, *SIZE))
    elements = _Elements(page)
    assert not re.search(r"(\bhttps?:|\bwss?:|//[a-z0-9-]+\.[a-z]{2,}/)", page)
    policy = next(one["content"] for tag, one in elements.tags if one.get("http-equiv") == "Content-Security-Policy")
    rules = dict(rule.split(" ", 1) for rule in policy.split("; "))
    assert rules["default-src"] == rules["base-uri"] == rules["form-action"] == "'none'"
    assert "connect-src" not in rules  # so that default-src holds

    def digest(text):
        return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"

    assert rules["script-src"] == digest(elements.text("script", id="player"))
    assert rules["style-src"] == digest(elements.text("style"))
    icon = ("link", {"rel": "icon", "href": "data:,"})  # an empty one, or browsers ask the server for it
    for tag, attributes in elements.tags:
        if (tag, dict(attributes)) == icon:
            continue
        assert not [name for name in attributes if name.startswith("on") or name in ("style", "src")], (tag, attributes)
        assert attributes.get("href", "#").startswith("#")
        assert tag not in ("link", "iframe", "object", "embed", "img")


def test_the_model_comes_back_from_the_page(tmp_path):
    model = soft_model(options=RenderOptions())
    (tmp_path / "out.fgz").write_bytes(data_of(html_page(model)))
    again = load_video_model(tmp_path / "out.fgz")
    assert again.num_gaussians == NUM
    np.testing.assert_allclose(again.splats.opacity_logit, model.splats.opacity_logit, atol=0.02)  # in their order
    own, found = VideoRenderer(model), VideoRenderer(again)
    for t in (0.0, 0.37, 1.0):
        assert np.abs(found.image(t) - own.image(t)).mean() < 0.5 / 255


def test_a_compact_file_goes_in_as_it_is(tmp_path):
    path = save_compact(tmp_path / "m.fgz", quantize_finely(soft_model()), metadata={"clip": "my clip"})
    page = html_page(path)
    assert data_of(page) == path.read_bytes()
    assert "<title>my clip</title>" in page


def test_gaussians_beyond_proportion_get_even_steps():
    model = soft_model(options=RenderOptions())
    thin = np.array(model.splats.log_scale)
    thin[5] = -40.0, -45.0
    model = eqx.tree_at(lambda m: m.splats.log_scale, model, thin)
    again = dequantize(quantize_finely(model))
    np.testing.assert_allclose(VideoRenderer(again).image(0.4), VideoRenderer(model).image(0.4), atol=0.02)


def test_the_original_goes_in_as_pictures():
    clip = waves(7, *SIZE)
    page = html_page(soft_model(), original=clip, quality=95)
    for k in range(7):
        data = np.frombuffer(data_of(page, f"frame-{k}"), np.uint8)
        assert np.abs(cv2.imdecode(data, cv2.IMREAD_COLOR)[..., ::-1].astype(float) - clip[k]).mean() < 4
    coarse = html_page(soft_model(), original=clip, quality=5)
    assert len(coarse) < len(page)
    alpha = np.concatenate([clip // 2, np.full((7, *SIZE, 1), 128, np.uint8)], -1)
    assert "frame-6" in html_page(soft_model(), original=alpha)


def _late(model):
    return edit(model).select(OBJECT).move((0.1, 0.0), times=(0.5, 1.0)).video()


@pytest.mark.parametrize(
    ("what", "message"),
    [
        (lambda m: html_page(_late(m)), "edits that no folded model represents.*foldgauss render"),
        (
            lambda m: html_page(SegmentedVideo.from_models([(0, m), (5, _late(m))])),
            "segment 1: .*edits that no folded model represents",
        ),
        (
            lambda m: html_page(segmented(), original=waves(7, *SIZE)),
            "original: expected frames uint8 .19, 40, 64, 3.",
        ),
        (lambda m: html_page(edit(m)), r"model: expected a VideoModel or an EditedVideo.*\.video\(\)"),
        (lambda m: html_page(m, quality=0), "quality: expected a whole number from 1 to 100, got 0"),
        (lambda m: html_page(m, original=waves(7, 41, 64)), "original: expected frames uint8 .7, 40, 64, 3."),
        (lambda m: html_page(m, original=waves(6, *SIZE)), "original: expected"),
        (lambda m: html_page(m, original=waves(7, *SIZE) / 255), "original: .*float64"),
        (lambda m: write_html("page.htm", m), r"path: expected a name ending in \.html"),
        (lambda m: write_html(m, "page.html"), r"path: expected a path.*\(path, model\)"),
    ],
)
def test_what_no_page_can_hold_is_told(tmp_path, monkeypatch, what, message):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ValueError, match=f"(?s){message}"):
        what(soft_model())
    assert not list(tmp_path.iterdir())


def test_a_page_is_written_whole_or_not_at_all(tmp_path, monkeypatch):
    path = write_html(tmp_path / "clip.html", soft_model(), title="a clip")
    before = path.read_text(encoding="utf-8")
    assert before == html_page(soft_model(), title="a clip")
    write_html(path, soft_model(seed=1))
    assert path.read_text(encoding="utf-8") != before
    monkeypatch.setattr(player_page, "LARGE", 1000)
    with pytest.warns(UserWarning, match="slow to open. Compress"):
        write_html(path, soft_model())
    with pytest.warns(UserWarning, match="or leave the original out"):
        write_html(path, soft_model(), original=waves(7, *SIZE))


def test_notebooks_show_the_player(monkeypatch):
    model = soft_model()
    (frame,) = [one for tag, one in _Elements(model._repr_html_()).tags if tag == "iframe"]
    assert frame["srcdoc"] == html_page(model, title="foldgauss")
    assert 390 <= int(frame["height"]) <= 710
    assert "allow-same-origin" not in frame["sandbox"]
    baked = layers(model, model)
    assert "<iframe" in baked._repr_html_()
    assert _late(model)._repr_html_() is None
    monkeypatch.setattr(player_page, "LARGEST_IN_NOTEBOOK", 1000)
    assert model._repr_html_() is None


# ------------------------------------------------------------------------------------------------- in a browser


#: Large, for what is done on the picture by hand.
LARGE = {"viewport": {"width": 480, "height": 760}}


@pytest.fixture(scope="module")
def fitted():
    return fit(waves(7), FitConfig(num_gaussians=300, steps=60), fps=12).model


MODELS = {
    "moved": lambda fitted: edit(fitted).move((0.1, 0.05)).scale(0.7, about=(0, 0)).rotate(0.4, about=(0, 0)).video(),
    "layers": lambda fitted: layers(edit(fitted).scale(0.4, about=(0, 0)).video(), fitted),
    "sum": lambda fitted: soft_model(compositing="sum", options=RenderOptions()),
    "power 2, exact": lambda fitted: soft_model(power=2.0),
    "power 1, floor, no path": lambda fitted: soft_model(power=1.0, floor=0.1, degree=0, options=RenderOptions()),
    "degree 4, round": lambda fitted: soft_model(degree=4, options=RenderOptions(support_radius=1.5)),
    "scale cutoff": lambda fitted: dataclasses.replace(soft_model(options=RenderOptions()), scale_cutoff=0.03),
    "cut": lambda fitted: dataclasses.replace(
        soft_model(options=RenderOptions()), frame_times=FrameTimes(make_time_logits(7, (3,)))
    ),
    "tall": lambda fitted: soft_model(size=(64, 36), options=RenderOptions()),
    "one frame": lambda fitted: soft_model(num_frames=1, options=RenderOptions()),
}


#: A setting each of conditioning, compositing and the clip; the long runs take the rest.
QUICK = ("sum", "power 1, floor, no path", "cut")


@pytest.mark.parametrize("name", [pytest.param(k, marks=[] if k in QUICK else pytest.mark.slow) for k in MODELS])
def test_pictures_are_those_of_the_engine(opened, fitted, name):
    model = MODELS[name](fitted)
    page, play = opened(model), VideoRenderer(model)
    times = np.asarray(model.frame_times.times())
    between = [float(0.6 * times[k] + 0.4 * times[k + 1]) for k in (0, 2)] if len(times) > 1 else [0.3]
    for t in (0.0, *between, 0.456, 1.0):
        wanted = play.frame(t)
        far = np.abs(page.picture(t).astype(float) - wanted).mean()
        assert far < 0.5, (t, far)
        assert wanted.std() > 3  # there is something to see
    height, width = (3 * side // 2 for side in model.size)
    larger = VideoRenderer(model, (height, width + 10)).frame(0.456)
    assert np.abs(page.picture(0.456, (height, width + 10)).astype(float) - larger).mean() < 0.5


def test_positions_are_the_learned_times(opened):
    """A frame on is the next frame's own time, and half a frame on is half way to it."""
    logits = np.log([1.0, 2.0, 1.0, 3.0, 1.5, 1.0]).astype(np.float32)
    model = dataclasses.replace(soft_model(), frame_times=FrameTimes(logits))
    page, times = opened(model), np.asarray(model.frame_times.times())
    page.press(".")
    assert page.stats["time"] == pytest.approx(float(times[1]), abs=1e-3)  # logits are rounded to 2^-10
    page.press(*5 * ["Shift+ArrowRight"])
    assert page.stats["position"] == pytest.approx(1.5)
    assert page.stats["time"] == pytest.approx(float(times[1] + times[2]) / 2, abs=1e-3)
    page.press(",")
    assert page.stats["position"] == 1
    page.press("End")
    assert (page.stats["position"], page.stats["time"]) == (6, 1.0)


def test_keys_do_what_the_help_says(opened):
    page = opened(soft_model(), original=waves(7, *SIZE))
    keyboard = page.page.keyboard
    for key, name, value in (
        ("Space", "playing", True),
        ("Space", "playing", False),
        ("l", "loop", False),
        ("[", "speed", 0.5),
        ("[", "speed", 0.25),
        (">", "speed", 0.5),
        ("b", "editing", True),
        ("Escape", "editing", False),
        ("p", "tool", "polygon"),
        ("e", "editing", False),
        ("3", "mode", "slider"),
        ("5", "mode", "difference"),
        ("1", "mode", "model"),
        ("+", "zoom", 1.25),
        ("0", "zoom", 1),
        ("Home", "position", 0),
    ):
        keyboard.press(key)
        assert page.stats[name] == value, key
    keyboard.press("?")
    assert page.page.locator("#help").is_visible()
    keyboard.press("Space")
    assert not page.stats["playing"]
    keyboard.press("Escape")
    assert not page.page.locator("#help").is_visible()


def test_it_plays_and_stops_at_the_end(opened):
    page = opened(soft_model(), reduced_motion="no-preference")
    assert page.stats["playing"]
    page.press("l")
    assert page.until("!foldgauss.stats.playing").stats["position"] == 6
    assert not opened(soft_model(), reduced_motion="reduce").stats["playing"]


def test_what_is_brushed_can_vanish_and_come_back(opened):
    model = soft_model(options=RenderOptions())
    page = opened(model, **LARGE)
    before = page.picture(0.5)
    page.press("b")
    seen = eqx.filter_jit(lambda own: own.splats.at(jnp.float32(0.5)).mean)(model)
    pull(page, screen_at(page, *map(float, np.median(np.asarray(seen)[OBJECT], axis=0))), (40, 20))
    picked = page.page.evaluate(PICKED)
    assert page.stats["picked"] == len(picked) >= 4
    assert OBJECT[picked].mean() > 0.7
    assert np.abs(page.picture().astype(float) - before).mean() > 0.2  # tinted
    page.page.click("#vanish")
    gone = page.picture()
    left = np.ones(NUM, bool)
    left[picked] = False
    wanted = VideoRenderer(edit(model).select(~left).vanish().video()).frame(0.5)
    assert np.abs(gone.astype(float) - wanted).mean() < 0.5
    page.press("z")
    assert page.stats["picked"] == len(picked)
    page.press("z", "e")
    assert page.stats["picked"] == 0
    np.testing.assert_array_equal(page.picture(), before)


def test_what_is_brushed_is_followed_through_the_clip(opened):
    """An object of two Gaussians, the second of which takes over from the first, on a background that stays."""
    splats = FoldedSplats(
        loc=np.float32([[-0.1, 0.0], [-0.08, 0.0], [0.0, 0.0]]),
        log_scale=np.float32([[-2.5, -2.5], [-2.5, -2.5], [0.0, 0.0]]),
        angle_logit=np.zeros(3, np.float32),
        time_loc_logit=np.float32([-1.5, 1.5, 0.0]),
        log_time_scale=np.float32([-1.6, -1.6, 3.0]),
        coefficients=np.zeros((3, 1, 2), np.float32),
        opacity_logit=np.float32([3.0, 3.0, 4.0]),
        color_dc=np.float32([[1.5, -1.0, -1.0], [1.4, -1.0, -1.0], [-1.0, -1.0, 1.0]]),
        envelope=TimeLikelihood(1.0),
    )
    page = opened(VideoModel(splats, FrameTimes.uniform(9), SIZE, 25.0, RenderOptions()))
    page.seek(0)
    page.press("b")
    found = "foldgauss.controls.tools.picker.inCircle(foldgauss.player.state, 0, -0.1, 0, 0.03)"
    page.page.evaluate(f"foldgauss.controls.tools.select({found}, 'new')")
    assert page.page.evaluate(PICKED) == [0]
    page.page.click("#follow")
    page.page.locator("#toast").wait_for()
    assert page.page.evaluate(PICKED) == [0, 1]


@pytest.mark.slow
def test_the_original_is_shown_beside_it(opened):
    model, clip = soft_model(), np.zeros((7, *SIZE, 3), np.uint8)
    clip[..., 1] = 200
    page = opened(model, original=clip, viewport={"width": 900, "height": 640})

    def shot():
        page.settle()
        return cv2.imdecode(np.frombuffer(page.page.locator("#canvas").screenshot(), np.uint8), cv2.IMREAD_COLOR)

    def green(picture):
        return float((np.abs(picture.astype(int) - (0, 200, 0)).max(-1) < 12).mean())

    shares = {}
    for key, mode in enumerate(("model", "original", "slider", "side"), start=1):
        page.press(str(key))
        for _ in range(40):
            shares[mode] = green(shot())
            if mode == "model" or shares[mode] > 0.05:
                break
        assert page.stats["mode"] == mode
    assert shares["model"] < 0.02
    assert shares["original"] > 0.6
    assert 0.3 < shares["slider"] / shares["original"] < 0.6
    assert shares["side"] > 0.1
    page.press("3")
    page.page.locator("#divider").focus()
    before = green(shot())
    page.press(*10 * ["ArrowLeft"])
    assert green(shot()) < before - 0.05


def test_buttons_have_names_and_themes_change(opened):
    page = opened(soft_model(), color_scheme="light", **LARGE).page
    nameless = """[...document.querySelectorAll("button, select, input")]
        .filter((own) => !(own.ariaLabel || own.textContent.trim() || own.labels?.length)).map((own) => own.id)"""
    assert page.evaluate(nameless) == []
    assert page.evaluate("document.documentElement.dataset.theme") == "light"
    page.click("#theme")
    assert page.evaluate("document.documentElement.dataset.theme") == "dark"


@pytest.mark.slow
def test_a_lost_context_comes_back(opened):
    page = opened(soft_model(), fresh=True)
    before = page.picture(0.4)
    page.page.evaluate("void (lost = foldgauss.player.renderer.gl.getExtension('WEBGL_lose_context')).loseContext()")
    page.page.get_by_text("graphics context was lost").wait_for()
    page.page.evaluate("lost.restoreContext()")
    page.page.locator("#notice").wait_for(state="hidden")
    np.testing.assert_array_equal(page.picture(), before)


@pytest.mark.slow
def test_without_webgl_the_page_says_so(browser, tmp_path):
    path = write_html(tmp_path / "page.html", soft_model())
    context = browser.new_context()
    context.set_default_timeout(120_000)
    context.add_init_script("HTMLCanvasElement.prototype.getContext = () => null")
    page = context.new_page()
    page.goto(path.as_uri())
    page.get_by_text("has no WebGL 2").wait_for()
    context.close()


@pytest.mark.slow
def test_the_player_works_in_a_notebooks_frame(browser, tmp_path):
    """In a frame of no origin, which may keep nothing."""
    path = tmp_path / "book.html"
    path.write_text(f"<!doctype html><body>{soft_model()._repr_html_()}</body>")
    page = Opened(browser, path)
    frame = page.page.frames[1]
    frame.locator("#notice").wait_for(state="hidden")
    assert frame.evaluate("foldgauss.stats.total") == NUM
    page.close()
    assert not page.said


# ------------------------------------------------------------------------------------------ a clip in segments

#: Spans 0:7, 4:10 and 7:12, whose fades meet: between frames 6 and 7 three are seen; 12:16 and 16:19 after cuts.
FIRSTS, LENGTHS, WHOLE = (0, 4, 7, 12, 16), (7, 6, 5, 4, 3), 19


def segmented(**how):
    parts = [soft_model(seed=k, num_frames=num, options=RenderOptions(), **how) for k, num in enumerate(LENGTHS)]
    logits = np.log([1.0, 2.0, 1.0, 3.0, 1.5]).astype(np.float32)
    parts[1] = dataclasses.replace(parts[1], frame_times=FrameTimes(logits))  # of its own, learned times
    parts[3] = dataclasses.replace(parts[3], frame_times=FrameTimes(make_time_logits(4, (2,))))  # a cut within it
    return SegmentedVideo.from_models(list(zip(FIRSTS, parts, strict=True)))


def test_a_page_of_segments_has_a_model_of_each(tmp_path):
    video = segmented()
    page = html_page(video, title="a long clip")
    spans = json.loads(_Elements(page).text("script", id="segments"))
    assert [(span["first"], span["num_frames"]) for span in spans] == list(zip(FIRSTS, LENGTHS, strict=True))
    assert [span["num_gaussians"] for span in spans] == [NUM] * 5
    for number, segment in enumerate(video.segments):
        (tmp_path / "out.fgz").write_bytes(data_of(page, f"model-{number}"))
        again = VideoRenderer(load_video_model(tmp_path / "out.fgz")).frame(0.4)
        assert np.abs(again - VideoRenderer(segment.model).frame(0.4).astype(float)).mean() < 0.5
    path = save_video_model(tmp_path / "long.safetensors", video, metadata={"clip": "a long clip"})
    assert html_page(path) == page
    assert "<title>a long clip</title>" in page
    plain = html_page(soft_model())
    assert 'id="segments"' not in plain
    assert data_of(plain)


def test_segments_that_no_page_holds_are_told(monkeypatch):
    assert SegmentedVideo.from_models([(0, soft_model()), (5, _late(soft_model()))])._repr_html_() is None
    video, made = segmented(), []
    (frame,) = [one for tag, one in _Elements(video._repr_html_()).tags if tag == "iframe"]
    assert frame["srcdoc"] == html_page(video, title="foldgauss")
    monkeypatch.setattr(player_page, "pack_compact", lambda model, metadata: made.append(model) or bytes(1000))
    monkeypatch.setattr(player_page, "LARGEST_IN_NOTEBOOK", 1000)
    assert video._repr_html_() is None
    assert not made  # its parameters alone are too many


@pytest.mark.parametrize("compositing", ["over", pytest.param("sum", marks=pytest.mark.slow)])
def test_pictures_of_segments_are_those_of_the_engine(opened, compositing):
    """Inside, in fades, of three at once, at cuts of both kinds, between frames, to and fro over the seams."""
    video = segmented(compositing=compositing)
    page, play = opened(video), VideoRenderer(video)
    many = {len(video.weights(position)) for position in (2, 4, 6.5)}
    assert many == {1, 2, 3}
    positions = [0, 2.3, 3.4, 4, 5.25, 6.5, 6.8, 7, 9, 9.6, 10, 11.4, 11.5, 13.4, 13.6, 15, 15.6, 18]
    if compositing == "sum":
        positions = [3.4, 6.5, 11.6]
    for position in (*positions, 1, 17, 5, 6.5, 11.4, 0.5):
        t = position / (WHOLE - 1)
        wanted = play.frame(t)
        assert np.abs(page.picture(t).astype(float) - wanted).mean() < 0.5, position
    twice = """() => {
      const one = foldgauss.pixels(64, 40), other = foldgauss.pixels(64, 40);
      return one.every((value, k) => value === other[k]);
    }"""
    page.seek(6.5 / 18)
    assert page.page.evaluate(twice)
    larger = VideoRenderer(video, (60, 100)).frame(5 / 18)
    assert np.abs(page.picture(5 / 18, (60, 100)).astype(float) - larger).mean() < 0.5


@pytest.mark.slow
def test_a_variable_frame_rate_is_kept(opened, tmp_path):
    """Frames are shown at the clip's own times, of a model and of one in segments; a model saved has them, too."""
    for name, video in (("model.safetensors", soft_model()), ("segments.safetensors", segmented())):
        num = video.num_frames
        seconds = np.cumsum([0, *np.where(np.arange(num - 1) % 3, 0.04, 0.4), 0.7]).tolist()
        path = save_video_model(tmp_path / name, video, metadata={"frame_seconds": seconds})
        page = opened(path, fresh=True)
        timeline = page.page.evaluate("foldgauss.player.timeline.seconds")
        assert timeline == pytest.approx(seconds)
        last = seconds[-2]
        assert page.page.locator("#whole").inner_text() == f"/ 0:{last:05.2f}"
        positions = [0, 0.5, 1, 1.25, num - 1, num - 0.5, num, num + 1, -0.5]
        ask = "(all) => all.map((one) => foldgauss.player.timeline.{}(one))"
        shown = page.page.evaluate(ask.format("secondOf"), positions)
        mean = 1 / video.fps
        assert shown == pytest.approx(
            [0, 0.2, 0.4, 0.41, last, last + 0.35, last + 0.7, last + 0.7 + mean, -0.5 * mean]
        )
        assert page.page.evaluate(ask.format("positionAt"), shown) == pytest.approx(positions)
        advanced = page.page.evaluate(
            """() => {
              const { player } = foldgauss, { advance } = Object.getPrototypeOf(player);
              player.seekPosition(0);
              player.before = 1000;
              advance.call(player, 1200);
              return player.position;
            }"""
        )
        assert advanced == pytest.approx(0.5)
    page = opened(tmp_path / "model.safetensors", fresh=True)
    with page.page.expect_download() as saved:
        page.page.evaluate("foldgauss.files.downloadModel()")
    saved.value.save_as(tmp_path / "saved.safetensors")
    own, other = (read_origin(tmp_path / name)["frame_seconds"] for name in ("model.safetensors", "saved.safetensors"))
    assert own == other
    drop(page, tmp_path / "saved.safetensors")
    page.until("foldgauss.player.timeline.seconds?.length === " + str(len(own)))


def test_controls_work_on_the_whole_clip(opened):
    clip = np.zeros((WHOLE, *SIZE, 3), np.uint8)
    clip[..., 1] = 12 * np.arange(WHOLE)[:, None, None]
    page = opened(segmented(), original=clip)
    keyboard, text = page.page.keyboard, page.page.locator
    page.until("foldgauss.stats.decoded.length === 5")
    assert "19 frames in 5 segments" in text("#facts").inner_text()
    assert text("#whole").inner_text() == "/ 0:00.72"
    assert f"{NUM} of {5 * NUM} Gaussians" in text("#stats").inner_text()
    keyboard.press("End")
    assert (page.stats["position"], page.stats["time"]) == (18, 1)
    for _ in range(7):
        keyboard.press(",")
    assert (page.stats["position"], page.stats["segment"]) == (11, 2)
    assert page.stats["time"] == pytest.approx(11 / 18)
    keyboard.press(".")
    assert page.stats["segment"] == 3  # at the cut
    assert text("#now").inner_text() == "0:00.48"
    page.page.locator("#scrub").fill("5")
    assert (page.stats["position"], page.stats["segment"]) == (5, 0)
    page.settle()
    assert f"{2 * NUM} of {5 * NUM} Gaussians" in text("#stats").inner_text()  # two are seen
    keyboard.press("2")
    page.page.locator("#scrub").fill("14.2")
    page.until("foldgauss.player.originals.images.has(14)")
    page.settle()
    shot = cv2.imdecode(np.frombuffer(page.page.locator("#canvas").screenshot(), np.uint8), cv2.IMREAD_COLOR)
    assert abs(int(shot[shot.shape[0] // 2, shot.shape[1] // 2, 1]) - 12 * 14) <= 4


#: Segments come when the test lets them.
_HELD_BACK = """() => {
  const { decoder, held } = foldgauss.player.segments, decode = decoder.decode.bind(decoder);
  window.bring = {};
  decoder.decode = (number) => new Promise((resolve) => (bring[number] = () => resolve(decode(number, () => {}))));
  for (const number of [...held.keys()]) if (number) held.delete(number);
}"""


@pytest.mark.slow
def test_play_waits_for_a_segment_that_is_not_decoded(opened):
    video = segmented()
    page, play = opened(video), VideoRenderer(video)
    page.until("foldgauss.stats.decoded.length === 5")
    page.page.evaluate(_HELD_BACK)
    page.seek(2 / 18)
    before = page.picture()
    page.page.evaluate("void (sought = foldgauss.seek(12 / 18))")
    assert (page.stats["missing"], page.stats["segment"]) == (3, 0)
    page.page.get_by_text("Decoding segment 4").wait_for()
    with pytest.raises(Exception, match="still being decoded"):
        page.picture()
    page.page.evaluate("foldgauss.player.play()")
    page.settle()
    assert (page.stats["position"], page.stats["playing"]) == (12, True)  # it waits there
    again = page.page.evaluate("foldgauss.player.seen.map((part) => [part.number, part.time])")
    assert again == [[0, pytest.approx(2 / 6)]]  # what was seen stays
    page.page.evaluate("foldgauss.player.pause()")
    page.page.evaluate("bring[3]()")
    page.page.evaluate("sought")
    page.page.locator("#toast").wait_for(state="hidden")
    assert np.abs(page.picture().astype(float) - play.frame(12 / 18)).mean() < 0.5
    assert np.abs(page.picture().astype(float) - before).mean() > 2
    page.page.evaluate("void (sought = foldgauss.seek(5.5 / 18))")
    page.page.evaluate("bring[1]()")
    page.page.evaluate("sought")
    assert np.abs(page.picture().astype(float) - play.frame(5.5 / 18)).mean() < 0.5


@pytest.mark.slow
def test_a_segment_that_cannot_be_decoded_is_told(browser, tmp_path):
    path = write_html(tmp_path / "page.html", segmented())
    text = path.read_text(encoding="utf-8")
    good = base64.b64encode(data_of(text, "model-3")).decode()
    path.write_text(text.replace(good, good[:60] + good[60:-40][::-1] + good[-40:]), encoding="utf-8")
    page = Opened(browser, path).ready()
    page.page.locator("#notice").wait_for()
    told = page.page.locator("#notice-text").inner_text()
    assert told
    with pytest.raises(Exception, match=re.escape(told[:30])):
        page.seek(13 / 18)
    page.press("Space")
    page.settle()
    page.close()
    assert not page.said


@pytest.mark.skipif(shutil.which("node") is None, reason="needs node, which runs the brush's own conditioning")
@pytest.mark.parametrize(
    "how",
    [
        *(pytest.param(how, marks=pytest.mark.slow) for how in ({}, {"degree": 0})),
        {"degree": 4, "power": 1.0, "floor": 0.1},
        "paths",
    ],
)
def test_the_brush_conditions_as_the_distribution_does(tmp_path, how):
    """The fold equation stands once in Python; the brush has it again, and is held to that."""
    path = tmp_path / "m.fgz"
    model = soft_model(options=RenderOptions(), **({} if how == "paths" else how))
    path.write_bytes(data_of(html_page(on_paths(model) if how == "paths" else model)))
    for source in (player_page._DECODER, *(player_page._SOURCES / f"{name}.js" for name in MODULES)):
        (tmp_path / source.name).write_bytes(source.read_bytes())
    (tmp_path / "package.json").write_text('{"type": "module"}')
    (tmp_path / "run.js").write_text(
        """
        import { readFileSync } from "node:fs";
        import { decode } from "./compact.js";
        import { alive, condition, prepare } from "./gaussians.js";
        const file = readFileSync("m.fgz");
        const model = prepare(decode(file.buffer.slice(file.byteOffset, file.byteOffset + file.length)));
        const found = Array.from(alive(model, 0.3, new Uint32Array(model.num)));
        console.log(JSON.stringify(found.map((i) => condition(model, i, 0.3, 0))));
        """
    )
    ran = subprocess.run(["node", "run.js"], cwd=tmp_path, check=True, timeout=60, capture_output=True, text=True)
    found = json.loads(ran.stdout)
    splats = eqx.filter_jit(lambda own: own.at(jnp.float32(0.3)))(load_video_model(path).splats)
    which = np.array([one["i"] for one in found])
    np.testing.assert_array_equal(which, np.flatnonzero(splats.opacity))
    np.testing.assert_allclose([(one["x"], one["y"]) for one in found], splats.mean[which], atol=1e-5)
    np.testing.assert_allclose([one["opacity"] for one in found], splats.opacity[which], rtol=1e-5)
    turned = np.array([[[one["cos"], -one["sin"]], [one["sin"], one["cos"]]] for one in found])
    covariance = (turned * [[[one["first"], one["second"]]] for one in found]) @ turned.transpose(0, 2, 1)
    expected = np.asarray(splats.factor @ splats.factor.transpose(0, 2, 1))[which]
    np.testing.assert_allclose(covariance, expected, rtol=1e-4, atol=1e-8)
