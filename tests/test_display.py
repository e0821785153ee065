"""What notebooks show: pictures of what is there, quickly, and never an error."""

import base64
import builtins

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from soft_models import NUM, NUM_FRAMES, SIZE, soft_model

from foldgauss import FoldedGaussian, FoldedMixture, PolynomialFold
from foldgauss.analysis import notebook as _display
from foldgauss.video import FitInfo, FitResult

pytest.importorskip("matplotlib", reason="matplotlib is an optional extra")


def bend(spaces=1, batch=(), dtype=np.float32, slope=1.0):
    rng = np.random.default_rng(0)
    loc = rng.normal(size=(*batch, spaces)).astype(dtype)
    scale = np.full((*batch, spaces), 0.3, dtype)
    coefficients = np.zeros((*batch, 2, spaces), dtype)
    coefficients[..., 0, :] = slope
    time_loc, time_scale = np.linspace(0, 1, max(int(np.prod(batch)), 1)).reshape(batch).astype(dtype), dtype(0.5)
    return FoldedGaussian(loc, scale=scale, time_loc=time_loc, time_scale=time_scale, fold=PolynomialFold(coefficients))


def mixture(spaces=1, num=4, batch=()):
    weights = np.random.default_rng(1).dirichlet(np.ones(num), batch).astype(np.float32)
    return FoldedMixture(bend(spaces, (*batch, num)), weights=weights)


def picture(png: bytes) -> np.ndarray:
    assert png.startswith(b"\x89PNG")
    return cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR)


CASES = {
    "plane": bend(1),
    "seven": bend(7),
    "batch": bend(1, (5,)),
    "batches": bend(2, (2, 3)),
    "large batch": bend(2, (3000,)),
    "function": FoldedGaussian(
        [0.0, 0.0], scale=[0.1, 0.2], time_loc=0.0, time_scale=1.0, fold=lambda u: jnp.stack([jnp.sin(u), u])
    ),
    "mixture": mixture(1),
    "mixture in space": mixture(3),
    "many components": mixture(2, 20_000),
    "mixtures": mixture(1, 3, (4,)),
}


@pytest.fixture
def compiled():
    """Seconds of each of XLA's compilations since the test began."""
    seconds = []

    def listen(event, duration, **details):
        if event.endswith("backend_compile_duration"):
            seconds.append(duration)

    jax.monitoring.register_event_duration_secs_listener(listen)
    yield seconds
    jax.monitoring.unregister_event_duration_listener(listen)


SLOW_CASES = ("plane", "seven", "large batch", "batches", "many components", "mixtures")


@pytest.mark.parametrize("name", [pytest.param(k, marks=pytest.mark.slow if k in SLOW_CASES else []) for k in CASES])
def test_it_shows(name, compiled):
    jax.clear_caches()
    shown = CASES[name]
    image = picture(shown._repr_png_())
    assert compiled
    assert image.shape[0] < 400
    assert image.shape[1] < 1500
    # Something is drawn: blue of densities, red of paths.
    blue, _, red = (image[..., k].astype(int) for k in range(3))
    assert (blue - red > 40).mean() > 0.01
    assert (red - blue > 40).sum() > 20
    # Quick the second time, 0.1 to 0.3 s on a quiet core: nothing is compiled anew.
    del compiled[:]
    again = shown._repr_png_()
    assert compiled == []
    assert len(again) < 200_000


def test_the_density_drawn_is_the_density(monkeypatch):
    """Shades of (t, s_j) against the marginal's own density."""
    shown = mixture(2, 3)
    seen = []

    class Axes:
        def pcolormesh(self, t, s, shade, **style):
            seen.append((t, s, shade))

        def plot(self, *arguments, **style):
            pass

        set = plot

    bells = _display._bells(shown.components, np.asarray(shown.weights, float))
    for j in (0, 1):
        _display._draw_time(bells, j, Axes())
        t, s, shade = seen[-1]
        points = np.stack(np.broadcast_arrays(s[:, None], t[None, :]), -1).astype(np.float32)
        density = np.asarray(jax.jit(lambda dist, x: dist.pdf(x))(shown.marginal([j, -1]), points))
        np.testing.assert_allclose(shade**2, density / density.max(), atol=2e-4)


def test_the_heaviest_components_are_drawn():
    dist = bend(2, (300,))
    weights = np.full(300, 1e-6)
    weights[7] = 1.0
    chosen = []
    honest = _display._drawn

    def spy(dist, weights, title):
        chosen.append((dist, weights, title))
        return honest(dist, weights, title)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(_display, "_drawn", spy)
        assert FoldedMixture(dist, weights=weights)._repr_png_()
    (drawn, kept, title) = chosen[0]
    assert "300 components, the 48 heaviest: 100%" in title
    assert kept.max() > 0.99
    np.testing.assert_array_equal(drawn.loc[kept.argmax()], dist.loc[7])


def test_it_falls_back_to_text(monkeypatch):
    """Without matplotlib, and where a number is none."""
    assert FoldedGaussian([np.nan], scale=[0.1], time_loc=0.0, time_scale=1.0, validate_args=False)._repr_png_() is None
    assert jax.eval_shape(lambda x: _traced(x), jnp.zeros(1)).shape == (1,)
    honest = builtins.__import__

    def without(name, *arguments, **options):
        if name.partition(".")[0] == "matplotlib":
            raise ImportError(name)
        return honest(name, *arguments, **options)

    monkeypatch.setattr(builtins, "__import__", without)
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
