"""Headless Chromium for the player's tests; skipped, with the reason, where there is none."""

import base64
import os
import re
import shutil
import warnings
from contextlib import contextmanager

import numpy as np
import pytest

from foldgauss.io import html_page, write_html
from foldgauss.io.page.player_page import empty_page
from foldgauss.video import VideoModel

#: SwiftShader computes what WebGL draws, and nothing else: Debian's Chromium would paint its windows by it too, which
#: takes four times as long.
_ARGUMENTS = ["--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"]
_ARGUMENTS += ["--disable-gpu-rasterization", "--disable-gpu-compositing"]
_PIXELS = """async ([time, width, height]) => {
  if (time !== null) await foldgauss.seek(time);
  const { stats } = foldgauss, [columns, rows] = width ? [width, height] : [stats.width, stats.height];
  const bytes = foldgauss.pixels(columns, rows), parts = [];
  for (let i = 0; i < bytes.length; i += 8192) parts.push(String.fromCharCode(...bytes.subarray(i, i + 8192)));
  return [rows, columns, btoa(parts.join(""))];
}"""
#: Small, so that it is quickly drawn.
_VIEW = {
    "viewport": {"width": 480, "height": 520},
    "device_scale_factor": 0.5,
    "reduced_motion": "reduce",
    "color_scheme": "dark",
}
#: The page as it was opened: without its edit, what the browser keeps, and what was chosen.
_RESET = """async () => {
  const toast = document.getElementById("toast"), { player, controls, files } = foldgauss;
  for (const dialog of document.querySelectorAll("dialog[open]")) dialog.close();
  if (player) {
    player.pause();
    player.editing.history.restore({ steps: [], done: 0 });
    Object.assign(player, { loop: true, speed: 1, mode: "model", split: 0.5 });
    player.view.reset();
    for (const input of document.querySelectorAll("input:not([type=file])")) input.value = input.defaultValue;
    Object.assign(controls.tools, { how: "new", radius: 28, tolerance: 15 });
    controls.tools.choose("brush");
    controls.panel.toggle(false);
    controls.describe();
    document.activeElement.blur();
    await foldgauss.seek(0);
  }
  toast.hidden = true;
}"""
_OPEN = """async (data) => {
  const bytes = Uint8Array.from(atob(data), (one) => one.charCodeAt(0));
  await foldgauss.files.openModel(bytes.buffer, "clip.fgz");
}"""
_FORGET = """() => {
  const storage = window.foldgauss?.files?.storage;
  clearTimeout(storage?.pending);
  if (storage) storage.pending = undefined;
  localStorage.clear();
}"""


@contextmanager
def chromium():
    """A browser of Playwright's, WebGL on the CPU."""
    api = pytest.importorskip("playwright.sync_api", reason="needs Playwright, of the extra 'test'")
    path = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    if path is None:
        pytest.skip("needs Chromium, which draws the player's page: apt install chromium")
    root = ["--no-sandbox"] if hasattr(os, "geteuid") and os.geteuid() == 0 else []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", (ResourceWarning, DeprecationWarning))
        with api.sync_playwright() as playwright:
            browser = playwright.chromium.launch(executable_path=path, args=[*_ARGUMENTS, *root], timeout=120_000)
            yield browser
            browser.close()


class Opened:
    """A page in its own context; what its console said and what it asked of the network are kept."""

    def __init__(self, browser, path=None, **options):
        self.said, self.asked = [], []
        self.context = browser.new_context(**{"has_touch": True} | _VIEW | options)
        self.page = self.context.new_page()
        self.page.set_default_timeout(120_000)
        # Reading pixels, as tests do, is slow; Chromium may say so.
        self.page.on("console", lambda own: None if "due to ReadPixels" in own.text else self.said.append(own.text))
        self.page.on("pageerror", lambda error: self.said.append(str(error)))
        self.page.on("request", lambda request: self.asked.append(request.url))
        if path is not None:
            self.go(path)

    def go(self, path):
        """Open the address of a server, or a file."""
        self.page.goto(path if isinstance(path, str) else path.as_uri())
        return self

    def ready(self):
        self.page.evaluate("foldgauss.ready")
        return self

    def settle(self):
        """Wait for what is drawn next."""
        self.page.evaluate("new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)))")
        return self

    def until(self, condition):
        """Wait until an expression holds; here, as the page's policy does not let Playwright's own waiting run."""
        self.page.evaluate(
            f"""async () => {{
              const begun = performance.now();
              while (!({condition})) {{
                await new Promise((next) => setTimeout(next, 20));
                if (performance.now() - begun > 120_000) throw new Error("not yet: " + JSON.stringify(foldgauss.stats));
              }}
            }}"""
        )
        return self

    def press(self, *keys):
        for key in keys:
            self.page.keyboard.press(key)
        return self

    def seek(self, time):
        self.page.evaluate("(time) => foldgauss.seek(time)", time)
        return self

    @property
    def toast(self):
        """The message that is shown, or will be."""
        self.page.locator("#toast").wait_for()
        return self.page.locator("#toast").inner_text()

    @property
    def stats(self):
        return self.page.evaluate("foldgauss.stats")

    def picture(self, t=None, size=None):
        """The picture at time t (default: now), as the page draws it: uint8 (height, width, 3)."""
        height, width = (0, 0) if size is None else size
        height, width, data = self.page.evaluate(_PIXELS, [None if t is None else float(t), width, height])
        return np.frombuffer(base64.b64decode(data), np.uint8).reshape(height, width, 4)[..., :3]

    def check(self, *own):
        """Nothing was said, and nothing asked for, but of the page and the addresses that begin with one of `own`."""
        said, asked = self.said[:], self.asked[:]
        self.said.clear()
        self.asked.clear()
        assert not said, said
        assert all(url.startswith(("file:", "blob:", "data:", *own)) for url in asked), asked

    def close(self):
        self.context.close()


class Pages:
    """Opens models in a page that tests share, as if it were new: starting a browser and a page takes most of the time.

    What a test replaces in the page itself, such as functions, it asks to be `fresh` for: the next one's is, too.
    """

    def __init__(self, browser, folder):
        self.browser, self.folder, self.written, self.view = browser, folder, [], _VIEW
        self.shared = self.shown = None

    def open(self, model, *, original=None, fresh=False, **view):
        """Show a model, or with None the page that has none; `view`: viewport, reduced_motion, color_scheme."""
        page, view = self.shared or Opened(self.browser), _VIEW | view
        if view["viewport"] != self.view["viewport"]:
            page.page.set_viewport_size(view["viewport"])
        if view != self.view:
            page.page.emulate_media(reduced_motion=view["reduced_motion"], color_scheme=view["color_scheme"])
        self.shared, self.view, shown, before = page, view, (model, original), self.shown
        self.shown = None if fresh else shown
        if page.page.url != "about:blank":
            page.page.evaluate(_FORGET)
        goes_on = not fresh and before is not None
        is_same = goes_on and before[0] is model and before[1] is original
        if is_same or (goes_on and before[0] is not None and original is None and isinstance(model, VideoModel)):
            page.page.evaluate(_RESET)
            if not is_same:  # its data in the page that there is: a third of the time
                page.page.evaluate(_OPEN, re.search('id="model">([^<]*)<', html_page(model))[1])
            page.page.evaluate(_FORGET)
        else:
            page.go(self.write(model, original)).ready()
        return page.settle()

    def write(self, model, original):
        """The file of a page; of a model that was written before that one."""
        for own, other, path in self.written:
            if own is model and other is original:
                return path
        path = self.folder / f"{len(self.written)}.html"
        if model is None:
            path.write_text(empty_page(), encoding="utf-8")
        else:
            write_html(path, model, original=original, title="clip")
        self.written.append((model, original, path))
        return path
