"""What notebooks show: pictures of what is there, quickly, and never an error."""

import base64
import sys

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from soft_models import NUM, NUM_FRAMES, SIZE, soft_model

from foldgauss import FoldedGaussian, FoldedMixture, PolynomialFold
from foldgauss.video import FitInfo, FitResult

pytest.importorskip("matplotlib", reason="matplotlib is an optional extra")


def bend(spaces=1, batch=()):
    loc = np.random.default_rng(0).normal(size=(*batch, spaces))
    fold = PolynomialFold([[1.0] * spaces, [0.0] * spaces])
    time_loc = np.linspace(0, 1, int(np.prod(batch))).reshape(batch)
    return FoldedGaussian(loc, scale=np.full(spaces, 0.3), time_loc=time_loc, time_scale=0.5, fold=fold)


def mixture(spaces=1, num=4, batch=()):
    weights = np.random.default_rng(1).dirichlet(np.ones(num), batch).astype(np.float32)
    return FoldedMixture(bend(spaces, (*batch, num)), weights=weights)


def picture(png: bytes) -> np.ndarray:
    assert png.startswith(b"\x89PNG")
    return cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR)


CASES = {
    "plane": lambda: bend(1),
    "seven": lambda: bend(7),
    "function": lambda: FoldedGaussian(
        [0.0, 0.0], scale=[0.1, 0.2], time_loc=0.0, time_scale=1.0, fold=lambda u: jnp.stack([jnp.sin(u), u])
    ),
    "mixture": lambda: mixture(1),
    "mixture in space": lambda: mixture(3),
}


@pytest.mark.parametrize(
    "name", [pytest.param(k, marks=pytest.mark.slow if k in ("plane", "seven") else []) for k in CASES]
)
def test_it_shows(name):
    png = CASES[name]()._repr_png_()
    assert len(png) < 200_000
    image = picture(png)
    assert image.shape[0] < 400
    assert image.shape[1] < 1500
    # Something is drawn: blue of densities, red of conditional densities.
    blue, _, red = (image[..., k].astype(int) for k in range(3))
    assert (blue - red > 40).mean() > 0.01
    assert (red - blue > 40).sum() > 20


def test_it_falls_back_to_text(monkeypatch):
    """Batches, large mixtures, values that are traced or NaN, and without matplotlib."""
    assert bend(1, (5,))._repr_png_() is None
    assert mixture(1, 3000)._repr_png_() is None
    assert FoldedGaussian([np.nan], scale=[0.1], time_loc=0.0, time_scale=1.0, validate_args=False)._repr_png_() is None
    assert jax.eval_shape(lambda x: _traced(x), jnp.zeros(1)).shape == (1,)
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    assert bend(1)._repr_png_() is None
    assert mixture(2)._repr_png_() is None
    assert "FoldedGaussian(" in repr(bend(1))


def _traced(x):
    dist = FoldedGaussian(x, scale=jnp.ones(1), time_loc=jnp.zeros(()), time_scale=jnp.ones(()))
    assert dist._repr_png_() is None
    return x


def test_notebooks_take_it():
    """IPython finds the picture by its name, the text beside it."""
    formatter = pytest.importorskip("IPython.core.formatters", reason="IPython comes with the notebooks")
    data, _ = formatter.DisplayFormatter().format(bend(1))
    assert "text/plain" in data
    png = data["image/png"]
    assert picture(png if isinstance(png, bytes) else base64.b64decode(png)).size


def test_no_second_figure_is_left_behind():
    from matplotlib import pyplot

    before = pyplot.get_fignums()
    bend(1)._repr_png_()
    mixture(2)._repr_png_()
    assert pyplot.get_fignums() == before


def test_fit_result():
    course = [FitInfo(step, step / 3, 0.1 / step, 20.0 + step, NUM, NUM, 0.5 * step, 1.0, None) for step in (1, 2, 3)]
    result = FitResult(soft_model(), course)
    of_what = f"{NUM_FRAMES} frames of {SIZE[0]}x{SIZE[1]}, {NUM} Gaussians"
    assert repr(result) == f"FitResult({of_what}; 23.00 dB after 3 steps, 1.5 s)"
    assert picture(result._repr_png_()).shape[1] > 400
    empty = FitResult(result.model, [])
    assert repr(empty) == f"FitResult({of_what})"
    assert empty._repr_png_() is None
