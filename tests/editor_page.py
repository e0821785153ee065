"""The player's editor in a browser: what its tests do with pages, and edits as scripts."""

import base64

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from soft_models import NUM, soft_model

from foldgauss.io import save_compact
from foldgauss.io.page.player_page import quantize_finely
from foldgauss.render import RenderOptions
from foldgauss.video.models.renderer import VideoRenderer

TIMES = (0.0, 0.21, 0.5, 1.0)
#: Of 255: the order of rounding differs, so that a value near a half may go either way; see docs/player.md.
LEVELS, WORST = 0.05, 1
PICKED = "Array.from(foldgauss.player.state.selected.keys()).filter((i) => foldgauss.player.state.selected[i])"


def save_soft_model(folder):
    """A compact file, which goes into the page as it is: so the page and Python have the same Gaussians."""
    return save_compact(folder / "clip.fgz", quantize_finely(soft_model(options=RenderOptions())))


def read_script(page, text, name="test.toml"):
    page.page.evaluate("([text, name]) => foldgauss.files.readScript(text, name)", [text, name])
    return page


def script_of(page):
    return page.page.evaluate("foldgauss.files.script")


def select(page, indices, how="new"):
    page.page.evaluate(
        "([indices, how]) => foldgauss.controls.tools.select(indices, how)", [list(map(int, indices)), how]
    )
    return page


def begin_edit(page, indices=(), at=None):
    """Open the editor, at a time, with these Gaussians selected."""
    if at is not None:
        page.seek(at)
    page.press("e")
    return select(page, indices) if len(indices) else page


def pull(page, start, *steps):
    """Drag with the mouse from a point of the screen, by these steps."""
    (x, y), mouse = start, page.page.mouse
    mouse.move(x, y)
    mouse.down()
    for right, down in steps:
        mouse.move(x + right, y + down, steps=5)
    mouse.up()


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
    "later and earlier": 'do = "retime"\nshift = 0.5\n\n[[edits]]\ndo = "retime"\nshift = -0.3\n',
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


def screen_at(page, x, y):
    """A point of model space on the screen, CSS pixels."""
    box = page.page.locator("#stage").bounding_box()
    left, top, _ = page.page.evaluate(
        "([x, y]) => { const { view } = foldgauss.player; return view.toScreen(x, y, view.panes(1)[0]); }", [x, y]
    )
    ratio = page.page.evaluate("devicePixelRatio")
    return box["x"] + left / ratio, box["y"] + top / ratio


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
