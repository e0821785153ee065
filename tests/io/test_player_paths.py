"""Models with shared paths in the player: their pictures, and those of edits, which move what the picture shows."""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from editor_page import (
    EDITS,
    IT,
    WORST,
    assert_shows,
    download,
    drag,
    drop,
    picked,
    read_script,
    select,
)
from soft_models import NUM, OBJECT, on_paths, soft_model

from foldgauss.io import load_video_model, save_compact, save_video_model
from foldgauss.io.edit_script import parse_edit_script
from foldgauss.io.page.player_page import quantize_finely
from foldgauss.render import RenderOptions
from foldgauss.video.models.renderer import VideoRenderer

CASES = {
    "over": {},
    "sum, other times": {"compositing": "sum", "degree": 0, "at_frames": False},
    "floor": {"degree": 2, "power": 1.0, "floor": 0.1},
    "strong": {"reach": 8.0, "thin": 4.0},
}
#: Colors are in the leaves alone.
PLACES = {name: EDITS[name] for name in EDITS if name not in ("hue", "gain", "color", "matrix", "fainter", "denser")}
PLACES["several"] = "\n[[edits]]\n".join(
    EDITS[name] for name in ("later", "transform", "backwards", "copies", "rotate")
)
QUICK = ("transform", "several")
#: Edits with which Gaussians stand still for a part of the clip, which no model file holds.
HOLDING = {"later", "later and earlier", "backwards", "copies", "several"}


def make(at_frames=True, reach=1.0, thin=0.0, **how):
    model = on_paths(soft_model(options=RenderOptions(), **how), at_frames=at_frames, reach=reach)
    scale = model.splats.log_scale + np.float32([thin / 4, -thin])
    return eqx.tree_at(lambda m: m.splats.log_scale, model, scale)


@pytest.fixture(scope="module")
def moving(tmp_path_factory):
    """The compact file of a model; every fifth Gaussian lasts."""
    model, lasting = make(), np.arange(NUM) % 5 == 0
    leaves = {"time_loc_logit": np.float32(0), "log_time_scale": np.log(np.float32(1024))}
    leaves = {name: np.where(lasting, own, getattr(model.splats, name)) for name, own in leaves.items()}
    leaves["coefficients"] = np.where(lasting[:, None, None], np.float32(0), model.splats.coefficients)
    model = dataclasses.replace(model, splats=dataclasses.replace(model.splats, **leaves))
    return save_compact(tmp_path_factory.mktemp("moving") / "clip.fgz", quantize_finely(model))


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[] if name == "sum, other times" else pytest.mark.slow) for name in CASES]
)
def test_pictures_are_those_of_the_engine(opened, tmp_path, name):
    model = make(**CASES[name])
    path = save_compact(tmp_path / "m.fgz", quantize_finely(model))
    page = opened(path)
    assert_shows(page, load_video_model(path))
    far = np.abs(page.picture(0.3).astype(float) - VideoRenderer(model).frame(0.3))  # quantized finely
    assert (far.mean() < 0.2) & (far.max() <= 3)
    still = dataclasses.replace(model.splats, path_index=None, paths=None)
    without = save_compact(tmp_path / "still.fgz", quantize_finely(dataclasses.replace(model, splats=still)))
    assert np.abs(page.picture(0.9).astype(float) - opened(without).picture(0.9)).mean() > 1


@pytest.mark.slow
def test_any_file_is_opened(opened, moving, tmp_path):
    bare = opened(None, fresh=True)
    for name in ("over", "floor"):
        model = make(**CASES[name])
        drop(bare, save_video_model(tmp_path / f"{name}.safetensors", model))
        bare.until(f"foldgauss.stats?.total === {NUM} && document.title === '{name}'").page.keyboard.press("k")
        assert_shows(bare, model)
    drop(bare, moving)
    bare.until("document.title === 'clip'").page.keyboard.press("k")
    assert_shows(bare, load_video_model(moving))


@pytest.mark.parametrize(
    "what", ["lengths", *(pytest.param(what, marks=pytest.mark.slow) for what in ("number", "not finite"))]
)
def test_damaged_paths_are_told(opened, tmp_path, what):
    model, bare = make(), opened(None, fresh=True)
    if what == "number":
        model = eqx.tree_at(lambda m: m.splats.path_index, model, np.full(NUM, 3, np.uint8))
    if what == "not finite":
        model = eqx.tree_at(lambda m: m.splats.paths.times, model, model.splats.paths.times * np.float32(np.nan))
    path = save_video_model(tmp_path / "m.safetensors", model)
    if what == "lengths":
        path.write_bytes(path.read_bytes().replace(b'\\"paths\\": [2, 7]', b'\\"paths\\": [2, 6]'))
    drop(bare, path)
    bare.until("!document.getElementById('toast').hidden")
    assert "damaged" in bare.toast


# ----------------------------------------------------------------------------------------------- edits


@pytest.mark.parametrize(
    "name", [name if name in QUICK else pytest.param(name, marks=pytest.mark.slow) for name in PLACES]
)
def test_an_edit_moves_what_is_seen(opened, moving, tmp_path, name):
    page = opened(moving)
    before = page.picture(0.9)
    read_script(page, IT + PLACES[name])
    assert_shows(page, parse_edit_script(IT + PLACES[name]).apply(load_video_model(moving)))
    assert np.abs(page.picture(0.9).astype(float) - before).mean() > 0.3 or name in ("front", "back")
    if name in HOLDING:
        return
    download(page, "#download-model", tmp_path / "own.safetensors")
    again = load_video_model(tmp_path / "own.safetensors")
    assert_shows(page, again)  # what is downloaded is what is seen
    edited = page.picture(0.9)
    page.press("z")
    np.testing.assert_array_equal(page.picture(0.9), before)
    bare = opened(None, fresh=True)
    drop(bare, tmp_path / "own.safetensors")
    bare.until("document.title === 'own'").page.keyboard.press("k")
    assert np.abs(bare.picture(0.9).astype(float) - edited).max() <= WORST


def test_tools_take_what_is_seen_there(opened, moving):
    model, page = load_video_model(moving), opened(moving)
    page.seek(0.9)
    page.page.click("#edit")
    page.page.click("[data-tool=rectangle]")
    box = (-0.3, -0.2, 0.2, 0.25)
    drag(page, [box[:2], box[2:]])
    at = eqx.filter_jit(lambda own: own.splats.at(jnp.float32(0.9)))(model)
    mean, alive = np.asarray(at.mean), np.asarray(at.opacity) > 0
    inside = ((mean > box[:2]) & (mean < box[2:])).all(1) & alive
    found = picked(page)
    assert found <= set(np.flatnonzero(inside).tolist())
    assert len(found) > 0.4 * inside.sum()
    select(page, np.flatnonzero(OBJECT))
    place = page.page.evaluate("foldgauss.controls.tools.picker.placeOf(foldgauss.player.state, 0.9)")
    own = mean[OBJECT & alive]
    np.testing.assert_allclose(place["box"], [*own.min(0), *own.max(0)], atol=1e-5)


@pytest.mark.slow
def test_copies_beyond_what_can_be_held_are_refused(opened, moving, tmp_path):
    """A model file holds 255 paths; the page itself more."""
    page = opened(moving)
    offsets = [[round(0.001 * k, 3), 0.0] for k in range(150)]
    read_script(page, IT + f'do = "multiply"\noffsets = {offsets}\n')
    assert page.page.evaluate("foldgauss.player.state.model.paths.count") == 300  # the first copy stays where it is
    page.page.evaluate("foldgauss.files.downloadModel()")
    assert "model file holds 255" in page.toast
    page.page.evaluate("foldgauss.player.state.model.paths.knots = 1e6")
    with pytest.raises(Exception, match="expected fewer copies of 300 shared paths"):
        page.page.evaluate("foldgauss.player.editing.edit({ do: 'multiply', offsets: [[0, 0]] })")
