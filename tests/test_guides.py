"""The guides' examples run, in order, as one program each."""

import re
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from foldgauss.io.edit_script import parse_edit_script
from foldgauss.video import EditedVideo

DOCS = Path(__file__).parents[1] / "docs"


def _run(name: str) -> dict:
    """The names that the guide's program leaves."""
    blocks = re.findall(r"```python\n(.*?)```", (DOCS / name).read_text(), re.S)
    names = {}
    exec(compile("\n".join(blocks), name, "exec"), names)
    return names


@pytest.mark.slow
def test_distribution():
    pytest.importorskip("numpyro", reason="numpyro is an optional extra")
    pytest.importorskip("matplotlib", reason="matplotlib is an optional extra").use("Agg")
    names = _run("distribution.md")
    assert names["select_degree"](names["x"], 4, "bic").degree == 2
    assert names["kl_divergence"](names["dist"], names["dist"]) == 0


@pytest.mark.slow
def test_estimator():
    pytest.importorskip("sklearn", reason="scikit-learn is an optional extra")
    names = _run("estimator.md")
    assert names["mixture"].converged_
    assert names["mixture"].score(names["x"]) > 0.5


@pytest.mark.slow
def test_mixture():
    pytest.importorskip("numpyro", reason="numpyro is an optional extra")
    names = _run("mixture.md")
    assert names["x"].shape == (1000, 3)
    assert names["curve"].shape == (50, 2)
    np.testing.assert_allclose(names["same"].weights, names["mixture"].weights, rtol=1e-5)
    mass = names["image"].sum() / names["pixels_per_unit"]((90, 160)) ** 2
    np.testing.assert_allclose(mass, names["mixture"].marginal([-1]).pdf(np.float32([0.5])), rtol=1e-2)


def test_economy():
    names = _run("economy.md")
    assert names["degrees"][1] == names["degrees"][1:].max()
    assert names["throughout"] > 0


@pytest.mark.slow
def test_results():
    names = _run("results.md")
    assert names["control"].num_floats <= names["model"].num_floats
    assert names["gain"] > 0


def test_tradeoff():
    names = _run("tradeoff.md")
    assert names["chosen"] == [0, 1, 2, 3]
    assert names["bend"] == 1


@pytest.mark.slow
def test_rendering():
    names = _run("rendering.md")
    image, target = names["image"], names["target"]
    assert image.shape == (90, 160, 3)
    assert names["features"].shape == (90, 160, 7)
    # Equal but for a splat at the very cutoff, and the perspective's own rounding.
    np.testing.assert_allclose(names["exact"], image, atol=1 / 255)
    np.testing.assert_allclose(names["pair"][0], image, atol=1e-6)
    np.testing.assert_allclose(names["same"], image, atol=0.02)
    np.testing.assert_allclose(names["mirrored"], names["same"][:, ::-1], atol=1e-3)
    np.testing.assert_allclose(names["trace"].image, np.moveaxis(image, -1, 0), atol=1e-6)
    np.testing.assert_allclose(1 - names["trace"].light, names["light_taken"], atol=1e-6)
    assert np.mean((names["better"] - target) ** 2) < 0.5 * np.mean((image - target) ** 2)
    for other in ("added", "sharp", "soft", "aside", "from_above"):
        assert np.isfinite(names[other]).all()
        assert np.abs(names[other] - image).max() > 0.05


@pytest.mark.slow
def test_editing(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    names = _run("editing.md")
    assert len(names["ball"]) > 5
    assert names["gone"].num_gaussians == names["model"].num_gaussians - len(names["ball"])
    assert names["picture"].shape == (48, 80, 3)
    for video in ("night", "jump", "there_and_back", "still", "stacked", "popped", "orbit", "waving", "grown", "again"):
        picture = names[video].render(0.4)
        assert np.isfinite(picture).all()
        assert np.abs(picture - names["model"].render(0.4)).max() > 0.02
    # The script, as it stands there.
    (tmp_path / "masks").mkdir()
    Image.fromarray(255 * names["masks"][0].astype(np.uint8)).save(tmp_path / "masks" / "ball.png")
    script = re.search(r"```toml\n(.*?)```", (DOCS / "editing.md").read_text(), re.S)[1]
    edited = parse_edit_script(script, folder=tmp_path).apply(names["model"])
    assert edited.num_gaussians > names["model"].num_gaussians
    assert isinstance(edited, EditedVideo)


@pytest.mark.slow
def test_format(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    names = _run("format.md")
    assert names["made"].loss_db == pytest.approx(names["lost"], abs=1e-6)
    assert names["lost"] <= 0.2
    assert {path.name for path in tmp_path.iterdir()} == {"waves.fgz"}


@pytest.mark.slow
def test_formats(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    names = _run("formats.md")
    np.testing.assert_allclose(names["again"].splats.loc, names["model"].splats.loc, atol=1e-6)
    np.testing.assert_array_equal(names["loaded"].splats.coefficients, names["model"].splats.coefficients)
    assert len(names["gaussians"].mean) > 10
    assert names["vertices"].shape[1:] == (3, 3)
    made = {"edited.webm", "frames", "loop.gif", "mesh", "middle.ply", "pictures", "video.ply", "waves.safetensors"}
    assert {path.name for path in tmp_path.iterdir()} == made


@pytest.mark.slow
def test_uncertainty(tmp_path, monkeypatch):
    pytest.importorskip("emcee", reason="emcee is an optional extra")
    monkeypatch.chdir(tmp_path)
    names = _run("uncertainty.md")
    assert {path.name for path in tmp_path.iterdir()} == {"chains.h5"}
    assert names["posterior"].converged
    assert [(one.frames, one.kind) for one in names["found"]] == [((4, 5), "duplicated"), ((11, 12), "dropped")]
    assert names["some"].free.tolist() == [4, 5, 6]
    assert names["row"].name == "even"
