"""Files of the player: opening any model, saving to the disk, recording; and small screens."""

import dataclasses
import re
import secrets
from contextlib import contextmanager

import cv2
import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from browser import Opened
from commands import running
from editor_page import (
    EDITS,
    IT,
    LEVELS,
    WORST,
    assert_shows,
    begin_edit,
    download,
    drop,
    read_script,
    script_of,
)
from soft_models import NUM, SIZE, soft_model

from foldgauss.cli.viewing.page_server import PageServer
from foldgauss.io import (
    html_page,
    load_video_model,
    read_vegas_ply,
    read_video,
    save_video_model,
    write_3dgs_ply,
    write_gaussians_ply,
    write_vegas_ply,
)
from foldgauss.io.edit_script import parse_edit_script, read_edit_script
from foldgauss.io.page.player_page import SaveTarget
from foldgauss.render import Camera, Gaussians3D, RenderOptions, project, render
from foldgauss.video.models.renderer import VideoRenderer


def test_the_empty_page_opens_any_model(opened, compact, tmp_path):
    bare = opened(None, fresh=True)
    assert bare.page.locator("#notice-open").is_visible()
    assert not bare.page.locator("#transport").is_visible()  # there is nothing to play
    model = soft_model(options=RenderOptions(), seed=3)
    save_video_model(tmp_path / "plain.safetensors", model)
    write_vegas_ply(tmp_path / "vegas.ply", model)
    for path in (tmp_path / "plain.safetensors", compact, tmp_path / "vegas.ply"):
        bare.page.evaluate("window.foldgauss.seek = null")
        drop(bare, path)
        bare.until(f"foldgauss.seek && document.title === '{path.stem}'")
        wanted = read_vegas_ply(path) if path.suffix == ".ply" else load_video_model(path)
        assert_shows(bare, wanted)
        assert bare.stats["total"] == NUM
    read_script(bare, IT + EDITS["rotate"])
    assert_shows(bare, parse_edit_script(IT + EDITS["rotate"]).apply(wanted))


@pytest.mark.slow
def test_a_vegas_file_without_a_size_is_asked_for_it(opened, tmp_path):
    bare = opened(None, fresh=True)
    model = soft_model(options=RenderOptions())
    path = write_vegas_ply(tmp_path / "theirs.ply", model)
    path.write_bytes(re.sub(rb"comment foldgauss [^\n]*\n", b"", path.read_bytes()))
    drop(bare, path)
    bare.page.locator("#facts-needed").wait_for()
    for name, value in (("width", SIZE[1]), ("height", SIZE[0]), ("fps", 12)):
        bare.page.locator(f"#needed-{name}").fill(str(value))
    bare.page.click("#facts-needed [value=open]")
    bare.until("foldgauss.seek")
    assert_shows(bare, read_vegas_ply(path, size=SIZE, fps=12))
    assert bare.page.locator("#whole").inner_text() == "/ 0:00.50"


@pytest.mark.parametrize(
    "how", [{}, pytest.param({"axes": "y-up", "depth_step": 2e-3, "sh_degree": 0}, marks=pytest.mark.slow)]
)
def test_a_3dgs_frame_looks_like_the_frame_it_was_exported_from(opened, tmp_path, how):
    bare, model = opened(None, fresh=True), soft_model(options=RenderOptions(low_pass=0.5))
    drop(bare, write_3dgs_ply(tmp_path / "frame.ply", model, 0.4, **how))
    bare.until("foldgauss.seek")
    wanted = VideoRenderer(model).frame(0.4).astype(float)
    far = np.abs(bare.picture() - wanted)
    assert (far.mean() < LEVELS) & (far.max() <= WORST)
    assert bare.page.locator("#toast").is_hidden()
    assert "still image" in bare.page.locator("#facts").inner_text()
    begin_edit(bare, range(5))
    assert bare.page.locator("#shift").is_disabled()  # a still image has no time
    bare.page.locator("#gain").fill("3")
    download(bare, "#download-model", tmp_path / "still.safetensors")
    still = load_video_model(tmp_path / "still.safetensors")
    assert (still.size, still.num_frames) == (SIZE, 1)
    assert_shows(bare, still, (0.0,))
    assert np.abs(bare.picture() - wanted).max() > 20


@pytest.mark.slow
def test_a_3dgs_scene_is_seen_along_z(opened, tmp_path):
    rng, num = np.random.default_rng(0), 300
    mean = rng.normal(size=(num, 3)) * [4, 2, 3] + [10, -5, 7]
    mean[:2, 2] = -40, 4  # the first is behind the camera
    quaternion, scale = rng.normal(size=(num, 4)), np.exp(rng.normal(-1, 0.6, (num, 3)))
    leaves = (mean, quaternion, scale, rng.uniform(0.1, 1, num), rng.uniform(size=(num, 3)))
    scene = Gaussians3D.from_quaternions(*(jnp.asarray(own, jnp.float32) for own in leaves))
    bare = opened(None, fresh=True)
    drop(bare, write_gaussians_ply(tmp_path / "scene.ply", scene))
    bare.until("foldgauss.seek")
    assert "as a still image along its z-axis" in bare.toast
    bulk = np.sort(mean, axis=0)[[2, -3]]  # of 300, 1% at either end
    box = bulk[1] - bulk[0]
    side = max(box[:2])
    size = bare.stats["height"], bare.stats["width"]
    assert size == (round(1280 * box[1] / side), round(1280 * box[0] / side))
    at = [*bulk.mean(axis=0)[:2], bulk[0, 2]]
    placed = dataclasses.replace(scene, mean=jnp.float32((mean - at) / side), factor=scene.factor / side)
    splats = project(placed, Camera.front(size[0] / size[1]), size)
    assert not splats.opacity.all()
    wanted = 255 * np.clip(render(splats, size, options=RenderOptions()), 0, 1)
    far = np.abs(bare.picture() - wanted)
    assert wanted.mean() > 30
    assert (far.mean() < 0.4) & (far.max() <= 1)  # rounding to whole levels alone is 0.25


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
            "neither a video of VeGaS",
        ),
        (
            "b.ply",
            b"ply\nformat ascii 1.0\nelement chunk 1\nproperty float min_x\nelement vertex 1\n"
            b"property uint packed_position\nend_header\n1\n1\n",
            "a compressed 3DGS scene. Save it in SuperSplat",
        ),
        (
            "c.ply",
            b"ply\nformat binary_little_endian 1.0\nelement vertex 9\nproperty float x\nend_header\n1",
            "cut short",
        ),
        ("a.toml", b"", "Open the model first"),
    ],
)
def test_files_that_cannot_be_opened_are_told(opened, tmp_path, name, content, message):
    bare = opened(None)
    (tmp_path / name).write_bytes(content)
    drop(bare, tmp_path / name)
    assert message in bare.toast
    assert bare.page.locator("#notice-open").is_visible()


def test_damaged_models_are_told(opened, compact, tmp_path):
    bare = opened(None)
    good = save_video_model(tmp_path / "m.safetensors", soft_model()).read_bytes()
    scene = write_3dgs_ply(tmp_path / "m.ply", soft_model(), 0.4).read_bytes()
    endless = eqx.tree_at(lambda model: model.splats.envelope.power, soft_model(), np.float32(np.inf))
    for name, content in (
        ("cut.safetensors", good[:-100]),
        ("nan.safetensors", good[:-8] + np.float32([np.nan, 1]).tobytes()),
        ("power.safetensors", save_video_model(tmp_path / "p.safetensors", endless).read_bytes()),
        ("cut.fgz", compact.read_bytes()[:-50]),
        ("nan.ply", scene[:-4] + np.float32(np.nan).tobytes()),
    ):
        (tmp_path / name).write_bytes(content)
        bare.page.evaluate("document.getElementById('toast').hidden = true")
        drop(bare, tmp_path / name)
        assert "damaged" in bare.toast


def serving(model, script, token):
    """The server of `foldgauss view`, in a thread."""
    page = html_page(model, save_to=SaveTarget(script.name, token))
    return running(PageServer(page.encode(), 0, script=script, token=token))


def test_view_saves_to_disk_and_takes_it_up_again(browser, compact, tmp_path):
    script, token, page = tmp_path / "holiday.edit.toml", secrets.token_urlsafe(32), Opened(browser)

    @contextmanager
    def shown():
        with serving(compact, script, token) as server:
            yield page.go(server.url).ready()
            page.check(server.url)

    with shown():
        read_script(page, IT + EDITS["move"])
        page.press("Control+s")
        page.page.get_by_text("Saved as holiday.edit.toml").wait_for()
        assert script.read_text() == script_of(page)
        wanted = page.picture(0.4)
        # Files are named after the model's, not by the clip's title.
        assert download(page, "#download-script", tmp_path / "own.toml") == "holiday.edit.toml"
        assert download(page, "#download-model", tmp_path / "own") == "holiday.edited.safetensors"
    with shown():  # at another port, whose browser storage is another
        np.testing.assert_array_equal(page.picture(0.4), wanted)
        assert_shows(page, read_edit_script(script).apply(load_video_model(compact)))
    script.write_text("[selections.it]\nbox = [0, 0, 9, 9]\nframe = 0\n")
    with shown():
        assert "box: expected indices" in page.toast
        page.press("s")
        assert page.page.locator("#save-disk").is_disabled()
        assert "left alone" in page.page.locator("#save-about").inner_text()
    page.close()


@pytest.mark.slow
def test_view_keeps_what_others_wrote_to_the_script(browser, compact, tmp_path):
    script, token = tmp_path / "clip.edit.toml", secrets.token_urlsafe(32)
    with serving(compact, script, token) as server:
        first = Opened(browser, server.url).ready()
        read_script(first, IT + EDITS["move"])
        second = first.context.new_page()
        second.goto(server.url)
        second.evaluate("foldgauss.ready")
        first.page.evaluate("foldgauss.files.save()")
        saved = script.read_text()
        second.evaluate("foldgauss.files.save()")  # it began without a script
        second.get_by_text("changed by another tab or program").wait_for()
        assert script.read_text() == saved
        second.close()
        wait = "Promise.all([foldgauss.files.save(), foldgauss.files.save()])"
        first.page.evaluate(wait)  # again, by the version that it saved
        assert "Saved as" in first.toast
        first.page.reload()
        assert [step["do"] for step in first.ready().stats["steps"] if "do" in step] == ["move"]
        script.write_text(IT + EDITS["hue"])  # by hand: it comes before what the browser kept
        first.page.reload()
        assert first.ready().stats["steps"][1] == {"do": "recolor", "hue": 0.6}
        first.page.evaluate("foldgauss.player.editing.history.undo()")
        assert first.stats["steps"][1]["do"] == "move"
        for bad in (b"[camera]\nazimuth = 3\n", b"# \xff\n"):
            script.write_bytes(bad)
            for _ in range(2):  # what the browser then keeps is no reason to replace it
                first.page.reload()
                first.ready().page.evaluate("foldgauss.files.storage.changed()")
                assert first.page.locator("#save-disk").is_disabled()
            assert script.read_bytes() == bad
        first.close()
    assert [one for one in first.said if "412" not in one] == []


def test_a_picture_is_what_is_shown(opened, compact, tmp_path):
    page = begin_edit(opened(compact), range(12), at=0.5).press("s")
    page.page.locator("#record-height").fill("80")
    assert download(page, "#picture", tmp_path / "frame.png") == "clip-3.png"
    saved = cv2.imread(str(tmp_path / "frame.png"))[..., ::-1]
    page.press("e")
    np.testing.assert_array_equal(saved, page.picture(size=(80, 128)))  # without the marks of the selection


@pytest.mark.slow
def test_a_video_is_recorded(opened, compact, tmp_path):
    page = opened(compact)
    page.press("s")
    for name, value in (("height", 80), ("speed", 0.25), ("first", 1), ("last", 5)):
        page.page.locator(f"#record-{name}").fill(str(value))
    with page.page.expect_download() as waited:
        page.page.click("#record")
    waited.value.save_as(tmp_path / "clip.webm")
    assert waited.value.suggested_filename == "clip.webm"
    page.page.evaluate("document.getElementById('files').close()")
    clip = read_video(tmp_path / "clip.webm").frames
    assert clip.shape[1:3] == (80, 128)
    wanted = [page.picture(t, (80, 128)).astype(float) for t in (1 / 6, 5 / 6)]
    far = np.array([[np.abs(frame - one).mean() for frame in clip] for one in wanted])
    assert (far.min(axis=1) < 6).all()  # what the encoder's rate allows
    assert far[0].argmin() < far[1].argmin()
    assert np.abs(wanted[0] - wanted[1]).mean() > 6
    assert page.stats["position"] == 5  # where the pictures were just taken


@pytest.mark.slow
def test_small_screens_and_both_themes_show_all(opened, compact):
    for width, height, scheme in ((1280, 800, "dark"), (360, 640, "light"), (740, 360, "dark")):
        page = opened(compact, viewport={"width": width, "height": height}, color_scheme=scheme)
        assert page.page.locator("#canvas").bounding_box()["height"] > 0.4 * height
        begin_edit(page, range(12))
        for name in ("panel", "files"):
            if name == "files":
                page.press("s")
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
              const light = ([r, g, b]) => 0.2126 * linear(r) + 0.7152 * linear(g) + 0.0722 * linear(b);
              const back = (own) => {
                const [r, g, b, a = 1] = parse(getComputedStyle(own).backgroundColor);
                return a > 0.99 || !own.parentElement ? [r, g, b] : back(own.parentElement);
              };
              return [...document.querySelectorAll("h1, h2, h3, p, label, button:enabled, output, span")]
                .filter((own) => own.offsetParent && own.textContent.trim() && !own.closest(":disabled"))
                .map((own) => {
                  const ink = light(parse(getComputedStyle(own).color)), paper = light(back(own));
                  const name = own.id || own.textContent.trim().slice(0, 20);
                  return [name, (Math.max(ink, paper) + 0.05) / (Math.min(ink, paper) + 0.05)];
                }).filter(([, ratio]) => ratio < 4.5);
            }"""
        )
        assert low == []
