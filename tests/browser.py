"""Headless Chromium for the player's tests; skipped, with the reason, where there is none."""

import base64
import os
import shutil
import warnings
from contextlib import contextmanager

import numpy as np
import pytest

_ARGUMENTS = ["--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"]
_PIXELS = """([width, height]) => {
  const bytes = foldgauss.pixels(width, height), parts = [];
  for (let i = 0; i < bytes.length; i += 8192) parts.push(String.fromCharCode(...bytes.subarray(i, i + 8192)));
  return btoa(parts.join(""));
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

    def __init__(self, browser, path, **options):
        options = {"viewport": {"width": 900, "height": 640}, "reduced_motion": "reduce"} | options
        self.said, self.asked = [], []
        self.context = browser.new_context(**options)
        self.page = self.context.new_page()
        self.page.set_default_timeout(120_000)
        self.page.on("console", lambda message: self.said.append(message.text))
        self.page.on("pageerror", lambda error: self.said.append(str(error)))
        self.page.on("request", lambda request: self.asked.append(request.url))
        self.page.goto(path if isinstance(path, str) else path.as_uri())  # the address of a server, or a file

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

    @property
    def stats(self):
        return self.page.evaluate("foldgauss.stats")

    def picture(self, t=None, size=None):
        """The picture at time t (default: now), as the page draws it: uint8 (height, width, 3)."""
        if t is not None:
            self.page.evaluate("t => foldgauss.seek(t)", float(t))
        stats = self.stats
        height, width = (stats["height"], stats["width"]) if size is None else size
        data = base64.b64decode(self.page.evaluate(_PIXELS, [width, height]))
        return np.frombuffer(data, np.uint8).reshape(height, width, 4)[..., :3]

    def close(self):
        self.context.close()
