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
#: Pages that take long, of functions that have quick tests of their own: by default their names are checked.
#: All others, new ones included, run.
SLOW = {
    "README.md",
    "docs/compress.md",
    "docs/concepts.md",
    "docs/distribution.md",
    "docs/editing.md",
    "docs/extending.md",
    "docs/formats.md",
    "docs/index.md",
    "docs/mixture.md",
    "docs/rendering.md",
    "docs/results.md",
    "docs/scale.md",
    "docs/tutorial-points.md",
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
    names |= {"files": {path.name: path for path in tmp_path.iterdir()}, "np": np, "guides": guides}
    names |= {"evaluate": evaluate, "load_video_model": load_video_model, "EditedVideo": EditedVideo}
    for fact in FACTS.get(page, ()):
        assert eval(fact, names), fact
    if page == "docs/editing.md":
        check_edits(names, tmp_path)


@pytest.mark.parametrize("page", sorted(SLOW))
def test_names_of_a_page_that_does_not_run_by_default_exist(page):
    guides.check_names(page)


def test_every_check_has_its_page():
    for known in (NEEDS, SLOW, FACTS, guides.GIVEN):
        assert known <= set(guides.PAGES) if isinstance(known, set) else known.keys() <= set(guides.PAGES)


def check_edits(names, folder):
    """The edits of docs/editing.md are seen, and its scripts can be applied to its model."""
    for video in ("night", "jump", "there_and_back", "still", "stacked", "popped", "orbit", "waving", "grown", "again"):
        picture = names[video].render(0.4)
        assert np.isfinite(picture).all()
        assert np.abs(picture - names["model"].render(0.4)).max() > 0.02
    # The script, as it stands there.
    Image.fromarray(255 * names["masks"][0].astype(np.uint8)).save(folder / "masks" / "ball.png")
    script, layers = [block.text for block in guides.blocks("docs/editing.md") if block.language == "toml"]
    edited = parse_edit_script(script, folder=folder).apply(names["model"])
    assert edited.num_gaussians > names["model"].num_gaussians
    assert isinstance(edited, EditedVideo)
    copied = parse_edit_script(layers.replace('"object"', '"ball"')).apply(names["video"])
    assert copied.num_gaussians == names["video"].num_gaussians + 2 * names["alone"].num_gaussians


#: What holds when the programs of a page have run: expressions of the names that they leave and of `files`, the paths
#: in their folder by name.
FACTS = {
    "README.md": [
        "x.shape == (1000, 3)",
        "picture.shape == (*guides.SIZE, 3)",
        "isinstance(more, EditedVideo)",
        "len(rider) > 0",
        "{'steady.safetensors', 'slow.mp4', 'times', 'holiday.fgz'} <= {*files}",
        "{'trade', 'more.mp4', 'foldgauss-demo'} <= {*files}",
        "posterior.mean().shape == (guides.NUM_FRAMES,)",
    ],
    "docs/commands.md": ["{'middle.png', 'figures.json', 'trip.html'} <= {*files}"],
    "docs/compress.md": [
        "made.model.num_gaussians == made.quantized.num_gaussians",
        "files['holiday.fgz'].stat().st_size < files['holiday.safetensors'].stat().st_size",
    ],
    "docs/concepts.md": ["np.allclose(at.mean, [0.1 + 3 * 0.0625 - 9 * 0.25**3], rtol=1e-5, atol=0)"],
    "docs/distribution.md": [
        "np.argmin([result.bic for result in fits]) == 2",
        "kl_divergence(dist, dist) == 0",
    ],
    "docs/editing.md": [
        "len(ball) > 5",
        "gone.num_gaussians == model.num_gaussians - len(ball)",
        "picture.shape == (48, 80, 3)",
    ],
    "docs/estimator.md": [
        "mixture.converged_",
        "mixture.score(x) > 0.5",
        "np.array_equal(np.concatenate(labels), mixture.predict(x))",
        "regressor.score(times, heights) > 0.85",
        "((low < heights) & (heights < high)).mean() > 0.85",
    ],
    "docs/extending.md": [
        "abs(gradient.fold.parameters.layers[0].weight).max() > 0",
        "np.isfinite(jump.log_prob(x)).all()",
        "wide > 2 * narrow",
        "frame.shape == (48, 80, 3)",
        "abs(slope.fold.sine).max() > 0",
        "left_error(better) < 0.8 * left_error(model)",
        "all(abs(video.render(0.8) - model.render(0.8)).max() > 0.02 for video in (swirled, later))",
        "np.allclose(later.render(0.0), model.render(0.0), rtol=0, atol=1e-5)",
    ],
    "docs/fit.md": [
        "picture.shape == (90, 160, 3)",
        "small.num_frames == 24",
        "bear.masks.shape == (4, 480, 480)",
        "load_video_model(files['trip.safetensors']).degree == 5",
    ],
    "docs/format.md": ["{*files} == {'holiday.fgz', 'holiday.mp4', 'holiday.safetensors'}"],
    "docs/formats.md": [
        "np.allclose(again.splats.loc, model.splats.loc, rtol=0, atol=1e-6)",
        "np.array_equal(loaded.splats.coefficients, model.splats.coefficients)",
        "len(gaussians.mean) > 10",
        "{*files} == {'frames', 'loop.gif', 'mesh', 'middle.ply', 'pictures', 'video.ply', 'scenes',"
        " 'waves.safetensors', 'theirs.safetensors', 'holiday.safetensors', 'point_cloud.ply'}",
    ],
    "docs/mixture.md": [
        "x.shape == (1000, 3)",
        "curve.shape == (50, 2)",
        "np.allclose(same.weights, mixture.weights, rtol=1e-5, atol=0)",
        "np.allclose(image.sum() / pixels_per_unit((90, 160)) ** 2, mixture.marginal([-1]).pdf(np.float32([0.5])),"
        " rtol=1e-2, atol=0)",
        "(best.n_components, best.degree) == (2, 2)",
        "np.allclose(mcmc.get_samples()['weights'].mean(0), [0.3, 0.7], rtol=0, atol=0.06)",
    ],
    "docs/player.md": [
        "'<title>Waves</title>' in page",
        "files['waves.html'].read_text(encoding='utf-8').count('id=\"frame-') == len(clip)",
    ],
    "docs/quickstart.md": [
        "{'foldgauss-demo', 'holiday.fgz', 'slow.mp4', 'short.safetensors'} <= {*files}",
        "picture.shape == (*guides.SIZE, 3)",
    ],
    "docs/rendering.md": [
        "image.shape == (90, 160, 3)",
        "features.shape == (90, 160, 7)",
        # Equal but for a splat at the very cutoff, and the perspective's own rounding.
        "np.allclose(exact, image, rtol=0, atol=1 / 255)",
        "np.allclose(pair[0], image, rtol=0, atol=1e-6)",
        "np.allclose(same, image, rtol=0, atol=0.02)",
        "np.allclose(mirrored, same[:, ::-1], rtol=0, atol=1e-3)",
        "np.allclose(trace.image, np.moveaxis(image, -1, 0), rtol=0, atol=1e-6)",
        "np.allclose(1 - trace.transmittance, alpha, rtol=0, atol=1e-6)",
        "np.mean((better - target) ** 2) < 0.5 * np.mean((image - target) ** 2)",
        "np.allclose(white, np.asarray(image) + 1 - np.asarray(alpha)[..., None], rtol=0, atol=1e-6)",
        "np.allclose(camera.intrinsics((90, 160)), K, rtol=1e-5, atol=0)",
        "1 < depth[opaque > 0.1].min() < 4 < depth[opaque > 0.1].max() < 7",
        "all(np.isfinite(other).all() for other in (added, sharp, soft, aside, from_above))",
        "all(abs(other - image).max() > 0.05 for other in (added, sharp, soft, aside, from_above))",
    ],
    "docs/results.md": [
        "files['trade'].joinpath('tradeoff.png').exists()",
        "files['few'].joinpath('tradeoff.json').exists()",
    ],
    "docs/scale.md": [
        "joined.mean_psnr > 15",
        "spans == [(0, 12), (9, 20)]",
        "part.num_frames == 11",
        "{'slow.mp4', 'waves-ply', 'second.safetensors', 'second.fgz', 'long.safetensors'} <= {*files}",
        "all(own.any() for own in np.split(left.selection.mask, [video.segments[0].num_gaussians]))",
        "abs(darker.render(0.5) - video.render(0.5)).max() > 0.1",
    ],
    "docs/slow-motion.md": [
        "len(slow) == 4 * (guides.NUM_FRAMES - 1) + 1",
        "len(large) == 2 * guides.NUM_FRAMES - 1",
        "large[0].shape == (96, 160, 3)",
    ],
    "docs/tutorial-points.md": ["best == 2", "mixture.score(points) > 0.5", "curve.shape == (50, 1)"],
    "docs/tutorial-video.md": [
        "evaluate(model, frames).mean_psnr > 25",
        "5 < len(ball) < model.num_gaussians / 2",
        "gone.num_gaussians == model.num_gaussians - len(ball)",
        "{'copies.safetensors', 'copies.mp4', 'ball.html'} <= {*files}",
        "load_video_model(files['copies.safetensors']).num_gaussians > model.num_gaussians",
    ],
    "docs/uncertainty.md": [
        "'chains.h5' in files",
        "posterior.converged",
        "[(one.frames, one.kind) for one in found] == [((4, 5), 'duplicated'), ((11, 12), 'dropped')]",
        "some.free.tolist() == [4, 5, 6]",
        "row.name == 'even'",
    ],
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
        ("```sh\npython -m benchmarks.figures --nonsense\n```", pytest.fail.Exception),
        ("```sh\npython -m benchmarks.nothing\n```", ModuleNotFoundError),
    ],
)
def test_what_is_wrong_fails(text, wrong, tmp_path, monkeypatch):
    (tmp_path / "page.md").write_text(text)
    with pytest.raises(wrong):
        guides.run_page(str(tmp_path / "page.md"), tmp_path, monkeypatch)


@pytest.mark.parametrize(
    ("text", "wrong"),
    [
        ("```python\nfrom foldgauss.video import nothing\n```", ImportError),
        ("```sh\nfoldgauss info --nonsense\n```", AssertionError),
        ("```sh\nfoldgauss nothing\n```", KeyError),
    ],
)
def test_wrong_names_fail(text, wrong, tmp_path):
    (tmp_path / "page.md").write_text(text)
    with pytest.raises(wrong):
        guides.check_names(str(tmp_path / "page.md"))


def test_commands_are_split_as_a_shell_does():
    text = 'pip install ".[a]" && foldgauss fit a.mp4 \\\n  --out b  # a comment\n\n# nothing\nfoldgauss info b'
    assert list(guides.commands(text)) == [
        ["pip", "install", ".[a]"],
        ["foldgauss", "fit", "a.mp4", "--out", "b"],
        ["foldgauss", "info", "b"],
    ]
