"""The programs of README and the guides run, page by page: see `guides`."""

import guides
import numpy as np
import pytest
from PIL import Image

from foldgauss.io import load_video_model
from foldgauss.io.edit_script import parse_edit_script
from foldgauss.video import EditedVideo, evaluate

#: Extras that a page needs; all are part of the extra `test`.
NEEDS = {
    "README.md": ("emcee", "matplotlib"),
    "docs/commands.md": ("matplotlib",),
    "docs/distribution.md": ("numpyro", "matplotlib", "blackjax"),
    "docs/estimator.md": ("sklearn",),
    "docs/fit.md": ("matplotlib",),
    "docs/mixture.md": ("numpyro", "sklearn"),
    "docs/results.md": ("matplotlib",),
    "docs/tutorial-points.md": ("sklearn",),
    "docs/uncertainty.md": ("emcee",),
}
#: Pages that take over 15 seconds; all others, new ones included, run by default.
SLOW = {
    "README.md",
    "docs/distribution.md",
    "docs/extending.md",
    "docs/mixture.md",
    "docs/results.md",
    "docs/scale.md",
    "docs/uncertainty.md",
}


def _has_programs(page: str) -> bool:
    return any(block.language in guides.RUN for block in guides.blocks(page))


PAGES = [
    pytest.param(page, marks=pytest.mark.slow if page in SLOW else ()) for page in guides.PAGES if _has_programs(page)
]


@pytest.mark.parametrize("page", guides.PAGES)
def test_every_block_has_a_language(page):
    guides.check_languages(page)


@pytest.mark.timeout(900)
@pytest.mark.parametrize("page", PAGES)
def test_page_runs(page, tmp_path, monkeypatch):
    for module in NEEDS.get(page, ()):
        pytest.importorskip(module, reason=f"{module} is an optional extra")
    if "matplotlib" in NEEDS.get(page, ()):
        pytest.importorskip("matplotlib").use("Agg")
    names = guides.run_page(page, tmp_path, monkeypatch)
    assert all((tmp_path / name).exists() for name in MADE.get(page, ()))
    CHECKS.get(page, lambda names, folder: None)(names, tmp_path)


def test_every_check_has_its_page():
    assert {*NEEDS, *SLOW, *MADE, *CHECKS, *guides.GIVEN} <= {*guides.PAGES}


# Expected results of the programs.

#: Files and folders, where the list is not complete.
MADE = {
    "README.md": ("holiday.safetensors", "slow.mp4", "times", "holiday.fgz", "trade", "more.mp4", "foldgauss-demo"),
    "docs/commands.md": ("middle.png", "figures.json", "trip.html"),
    "docs/quickstart.md": ("foldgauss-demo", "holiday.fgz", "slow.mp4", "short.safetensors"),
    "docs/results.md": ("trade/tradeoff.png", "few/tradeoff.json"),
    "docs/scale.md": ("slow.mp4", "waves-ply", "second.safetensors", "second.fgz", "long.safetensors"),
    "docs/tutorial-video.md": ("copies.safetensors", "copies.mp4", "ball.html"),
    "docs/uncertainty.md": ("chains.h5",),
}


def _readme(names, folder):
    assert names["x"].shape == (1000, 3)
    assert names["picture"].shape == (*guides.SIZE, 3)
    assert isinstance(names["more"], EditedVideo)
    assert len(names["rider"]) > 0
    assert names["posterior"].mean().shape == (guides.NUM_FRAMES,)


def _concepts(names, folder):
    np.testing.assert_allclose(names["at"].mean, [0.1 + 3 * 0.0625 - 9 * 0.25**3], rtol=1e-5)


def _distribution(names, folder):
    assert int(np.argmin([result.bic for result in names["fits"]])) == 2
    assert names["kl_divergence"](names["dist"], names["dist"]) == 0


def _editing(names, folder):
    assert len(names["ball"]) > 5
    assert names["gone"].num_gaussians == names["model"].num_gaussians - len(names["ball"])
    assert names["picture"].shape == (48, 80, 3)
    for video in ("night", "jump", "there_and_back", "still", "stacked", "popped", "orbit", "waving", "grown", "again"):
        picture = names[video].render(0.4)
        assert np.isfinite(picture).all()
        assert np.abs(picture - names["model"].render(0.4)).max() > 0.02
    # The script, as it stands there.
    (folder / "masks").mkdir()
    Image.fromarray(255 * names["masks"][0].astype(np.uint8)).save(folder / "masks" / "ball.png")
    script, on_plate = [block.text for block in guides.blocks("docs/editing.md") if block.language == "toml"]
    edited = parse_edit_script(script, folder=folder).apply(names["model"])
    assert edited.num_gaussians > names["model"].num_gaussians
    assert isinstance(edited, EditedVideo)
    (folder / "object").rename(folder / "searched")
    (folder / "object").mkdir()
    for k, mask in enumerate(names["masks"]):
        Image.fromarray(255 * mask.astype(np.uint8)).save(folder / "object" / f"{k}.png")
    on_plate = parse_edit_script(on_plate, folder=folder).apply(names["model"])
    assert [layer.num_gaussians for layer in on_plate.layers] == [len(names["ball"]), 600]
    assert np.abs(on_plate.render(0.4) - load_video_model(folder / "plate.safetensors").render(0.4)).max() > 0.02


def _estimator(names, folder):
    assert names["mixture"].converged_
    assert names["mixture"].score(names["x"]) > 0.5
    np.testing.assert_array_equal(np.concatenate(names["labels"]), names["mixture"].predict(names["x"]))
    assert names["regressor"].score(names["times"], names["heights"]) > 0.85
    assert ((names["low"] < names["heights"]) & (names["heights"] < names["high"])).mean() > 0.85


def _fit(names, folder):
    assert names["picture"].shape == (90, 160, 3)
    assert names["small"].num_frames == 24
    assert names["bear"].masks.shape == (4, 480, 480)
    assert load_video_model(folder / "trip.safetensors").degree == 5


def _format(names, folder):
    assert {path.name for path in folder.iterdir()} == {"holiday.fgz", "holiday.mp4", "holiday.safetensors"}


def _formats(names, folder):
    np.testing.assert_allclose(names["again"].splats.loc, names["model"].splats.loc, atol=1e-6)
    np.testing.assert_array_equal(names["loaded"].splats.coefficients, names["model"].splats.coefficients)
    assert len(names["gaussians"].mean) > 10
    assert names["vertices"].shape[1:] == (3, 3)
    made = {"edited.webm", "frames", "loop.gif", "mesh", "middle.ply", "pictures", "video.ply", "waves.safetensors"}
    made |= {"scenes", "theirs.safetensors", "holiday.safetensors", "point_cloud.ply"}
    assert {path.name for path in folder.iterdir()} == made


def _mixture(names, folder):
    assert names["x"].shape == (1000, 3)
    assert names["curve"].shape == (50, 2)
    np.testing.assert_allclose(names["same"].weights, names["mixture"].weights, rtol=1e-5)
    mass = names["image"].sum() / names["pixels_per_unit"]((90, 160)) ** 2
    np.testing.assert_allclose(mass, names["mixture"].marginal([-1]).pdf(np.float32([0.5])), rtol=1e-2)
    assert (names["choice"].estimator.n_components, names["choice"].estimator.degree) == (2, 2)
    np.testing.assert_allclose(names["mcmc"].get_samples()["weights"].mean(0), [0.3, 0.7], atol=0.06)


def _quickstart(names, folder):
    assert names["picture"].shape == (*guides.SIZE, 3)


def _rendering(names, folder):
    image, target = names["image"], names["target"]
    assert image.shape == (90, 160, 3)
    assert names["features"].shape == (90, 160, 7)
    # Equal but for a splat at the very cutoff, and the perspective's own rounding.
    for found, expected, tolerance in [
        (names["exact"], image, 1 / 255),
        (names["pair"][0], image, 1e-6),
        (names["same"], image, 0.02),
        (names["mirrored"], names["same"][:, ::-1], 1e-3),
        (names["trace"].image, np.moveaxis(image, -1, 0), 1e-6),
        (1 - names["trace"].transmittance, names["alpha"], 1e-6),
        (names["white"], np.asarray(image) + 1 - np.asarray(names["alpha"])[..., None], 1e-6),
    ]:
        np.testing.assert_allclose(found, expected, atol=tolerance)
    assert np.mean((names["better"] - target) ** 2) < 0.5 * np.mean((image - target) ** 2)
    np.testing.assert_allclose(names["camera"].intrinsics((90, 160)), names["K"], rtol=1e-5)
    seen = np.asarray(names["opaque"]) > 0.1
    assert 1 < np.asarray(names["depth"])[seen].min() < 4 < np.asarray(names["depth"])[seen].max() < 7
    for other in ("added", "sharp", "soft", "aside", "from_above"):
        assert np.isfinite(names[other]).all()
        assert np.abs(names[other] - image).max() > 0.05


def _slow_motion(names, folder):
    assert len(names["slow"]) == 4 * (guides.NUM_FRAMES - 1) + 1
    assert len(names["large"]) == 2 * guides.NUM_FRAMES - 1
    assert names["large"][0].shape == (96, 160, 3)


def _player(names, folder):
    assert "<title>Waves</title>" in names["page"]
    assert (folder / "waves.html").read_text(encoding="utf-8").count('id="frame-') == len(names["clip"])


def _uncertainty(names, folder):
    assert names["posterior"].converged
    assert [(one.frames, one.kind) for one in names["found"]] == [((4, 5), "duplicated"), ((11, 12), "dropped")]
    assert names["some"].free.tolist() == [4, 5, 6]
    assert names["row"].name == "even"


def _compress(names, folder):
    assert names["made"].model.num_gaussians == names["made"].quantized.num_gaussians
    sizes = {path.name: path.stat().st_size for path in folder.iterdir()}
    assert sizes["holiday.fgz"] < sizes["holiday.safetensors"]


def _extending(names, folder):
    assert np.abs(names["gradient"].fold.parameters.layers[0].weight).max() > 0
    assert np.isfinite(names["jump"].log_prob(names["x"])).all()
    assert names["wide"] > 2 * names["narrow"]
    assert names["frame"].shape == (48, 80, 3)
    assert np.abs(names["slope"].fold.sine).max() > 0
    assert names["left_error"](names["better"]) < 0.8 * names["left_error"](names["model"])
    before = names["model"].render(0.8)
    for video in ("swirled", "later"):
        assert np.abs(names[video].render(0.8) - before).max() > 0.02
    np.testing.assert_allclose(names["later"].render(0.0), names["model"].render(0.0), atol=1e-5)


def _scale(names, folder):
    assert names["joined"].mean_psnr > 15
    assert names["spans"] == [(0, 12), (9, 20)]
    assert names["part"].num_frames == 11
    first = names["video"].segments[0].num_gaussians
    assert all(part.any() for part in np.split(names["left"].selection.mask, [first]))
    assert np.abs(names["darker"].render(0.5) - names["video"].render(0.5)).max() > 0.1


def _tutorial_points(names, folder):
    assert names["best"] == 2
    assert names["mixture"].score(names["points"]) > 0.5
    assert names["curve"].shape == (50, 1)


def _tutorial_video(names, folder):
    assert evaluate(names["model"], names["frames"]).mean_psnr > 25
    ball, model = names["ball"], names["model"]
    assert 5 < len(ball) < model.num_gaussians / 2
    assert names["gone"].num_gaussians == model.num_gaussians - len(ball)
    assert load_video_model(folder / "copies.safetensors").num_gaussians > model.num_gaussians


CHECKS = {
    "README.md": _readme,
    "docs/compress.md": _compress,
    "docs/concepts.md": _concepts,
    "docs/distribution.md": _distribution,
    "docs/editing.md": _editing,
    "docs/estimator.md": _estimator,
    "docs/extending.md": _extending,
    "docs/fit.md": _fit,
    "docs/format.md": _format,
    "docs/formats.md": _formats,
    "docs/mixture.md": _mixture,
    "docs/player.md": _player,
    "docs/quickstart.md": _quickstart,
    "docs/rendering.md": _rendering,
    "docs/scale.md": _scale,
    "docs/slow-motion.md": _slow_motion,
    "docs/tutorial-points.md": _tutorial_points,
    "docs/tutorial-video.md": _tutorial_video,
    "docs/uncertainty.md": _uncertainty,
}


# The extraction itself: what it must refuse.


@pytest.mark.parametrize(
    "text",
    [
        "```\nfoldgauss fit\n```",
        "```bash\nfoldgauss fit\n```",
        "    foldgauss fit clip.mp4\n",
        "- a\n\n      $ pip install x\n",
    ],
)
def test_blocks_that_would_escape_are_refused(text, tmp_path, monkeypatch):
    (tmp_path / "page.md").write_text(f"Text\n\n{text}")
    monkeypatch.setattr(guides, "ROOT", tmp_path)
    with pytest.raises(AssertionError, match=r"page\.md:"):
        guides.check_languages("page.md")


@pytest.mark.parametrize(
    ("text", "wrong"),
    [
        ("```python\nassert 1 == 2\n```", AssertionError),
        ("- ```python\n  1 / 0\n  ```", ZeroDivisionError),
        ("```sh\nfoldgauss info nothing.safetensors\n```", AssertionError),
        ("```sh\nfoldgauss info --nonsense\n```", AssertionError),
        ("```sh\nfoldgaus info\n```", AssertionError),
        ('```sh\npip install ".[nothing]"\n```', AssertionError),
        ("```sh\npytest -m unheard\n```", AssertionError),
        ("```sh\npython -m benchmarks.figures --nonsense\n```", SystemExit),
        ("```sh\npython -m benchmarks.nothing\n```", ModuleNotFoundError),
    ],
)
def test_what_is_wrong_fails(text, wrong, tmp_path, monkeypatch):
    (tmp_path / "page.md").write_text(text)
    with pytest.raises(wrong):
        guides.run_page(str(tmp_path / "page.md"), tmp_path, monkeypatch)
