"""The paper's figure and a fit's course: what is drawn, and where."""

import sys
from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest

from foldgauss.analysis.plot import _mass_levels, plot_density, plot_history
from foldgauss.distribution import FoldedGaussian
from foldgauss.fold import PolynomialFold
from foldgauss.mixture import FoldedMixture

pyplot = pytest.importorskip("matplotlib.pyplot", reason="matplotlib is an optional extra")


@pytest.fixture
def ax():
    pyplot.switch_backend("Agg")
    figure, ax = pyplot.subplots()
    yield ax
    pyplot.close(figure)


def _dist(bend=((-1.0,),), **changes):
    parameters = {"time_loc": 0.5, "time_scale": 0.3, "fold": PolynomialFold(jnp.array(bend))} | changes
    return FoldedGaussian([0.2], [[0.4]], **parameters)


def _red(ax):
    return [line for line in ax.lines if line.get_color() == "#d1242f"]


SLOW_BENDS = [pytest.param(bend, marks=pytest.mark.slow) for bend in (((-1.0,),), ((0.0,), (1.0,)))]


@pytest.mark.parametrize("bend", [((0.0,),), ((0.0,), (0.0,), (1.0,)), *SLOW_BENDS])
def test_slices_stand_on_the_conditional_gaussians(ax, bend):
    dist, times = _dist(bend), [0.2, 0.5, 0.9]
    assert plot_density(dist, ax, slices=times) is ax
    ax.figure.canvas.draw()
    dots = [line for line in _red(ax) if line.get_marker() == "o"]
    bells = [line for line in _red(ax) if len(line.get_xdata()) > 2]
    assert len(dots) == len(bells) == 3
    for t, dot, bell in zip(times, dots, bells, strict=True):
        center = 0.2 + sum(c * (0.5 - t) ** (k + 1) for k, (c,) in enumerate(bend))  # u = time_loc - t
        scale = 0.4 * np.exp(-0.25 * ((t - 0.5) / 0.3) ** 2)
        np.testing.assert_allclose([dot.get_xdata()[0], dot.get_ydata()[0]], [t, center], atol=1e-6)
        foot, s = bell.get_xdata() - t, bell.get_ydata()
        np.testing.assert_allclose(foot / foot.max(), np.exp(-0.5 * ((s - center) / scale) ** 2), atol=1e-3)


def test_limits_labels_and_axes(ax):
    plot_density(_dist(), ax, t_limits=(0.0, 1.0), s_limits=(-1.0, 2.0))
    assert (ax.get_xlim(), ax.get_ylim()) == ((0.0, 1.0), (-1.0, 2.0))
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("time t", "space s")
    own = plot_density(_dist(), slices=0)
    assert own is not ax
    assert not _red(own)
    pyplot.close(own.figure)


def test_contours_hold_the_mass_they_say():
    z = np.linspace(-6, 6, 400)
    density = np.exp(-0.5 * (z[:, None] ** 2 + z[None] ** 2))
    # P(density of a plane Gaussian above c times its peak) = 1 - c.
    np.testing.assert_allclose(_mass_levels(density), [0.1, 0.4, 0.7], atol=2e-3)


def test_only_one_distribution_in_the_plane_is_drawn(ax):
    with pytest.raises(ValueError, match=r"dist: expected batch_shape \(\) and event_shape \(2,\)"):
        plot_density(_dist(time_loc=jnp.zeros(2)), ax)


def _course(num=200):
    rng = np.random.default_rng(0)
    return [
        SimpleNamespace(
            step=k, seconds=5 + 0.1 * k, loss=rng.choice([0.1, 0.2, 0.9], p=[0.1, 0.8, 0.1]), psnr=20 + 0.05 * k
        )
        for k in range(1, num + 1)
    ]


def test_history_is_drawn_against_seconds_and_steps():
    pyplot.switch_backend("Agg")
    axes = plot_history(_course())
    axes[0, 0].figure.canvas.draw()
    assert [ax.get_xlabel() for ax in axes[1]] == ["seconds", "steps"]
    assert [ax.get_ylabel() for ax in axes[:, 0]] == ["PSNR (dB)", "loss"]
    for x, (upper, lower) in zip((5 + 0.1 * np.arange(1, 201), np.arange(1, 201)), axes.T, strict=True):
        np.testing.assert_allclose(upper.lines[0].get_xdata(), x)
        np.testing.assert_allclose(upper.lines[0].get_ydata(), 20 + 0.05 * np.arange(1, 201))
        raw, middle = (line.get_ydata() for line in lower.lines)
        assert set(np.round(raw, 3)) == {0.1, 0.2, 0.9}
        assert np.median(middle) == 0.2
        assert middle.std() < 0.5 * raw.std()
    pyplot.close(axes[0, 0].figure)


def test_history_of_any_length(ax):
    axes = ax.figure.subplots(2, 2)
    step = _course(1)[0]
    step.loss = np.nan  # of a kept fit that needed no more steps
    assert plot_history([step], axes) is axes
    plot_history(_course(12_000), axes)
    assert len(axes[0, 1].lines[-1].get_xdata()) <= 6000
    ax.figure.canvas.draw()
    with pytest.raises(ValueError, match="history: expected at least one step"):
        plot_history([])


@pytest.mark.parametrize("draw", [lambda: plot_density(_dist()), lambda: plot_history(_course())])
def test_missing_matplotlib_names_the_extra(monkeypatch, draw):
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(ImportError, match=r"pip install 'foldgauss\[plot\]'"):
        draw()


def test_a_mixture_is_drawn_with_the_means_of_its_conditionals(ax):
    """The dots lie at E[s | t], between the two components."""
    parts = FoldedGaussian(
        loc=jnp.array([[0.0], [1.0]]),
        scale_tril=jnp.full((2, 1, 1), 0.1),
        time_loc=jnp.array([0.3, 0.6]),
        time_scale=jnp.array([0.1, 0.2]),
        fold=PolynomialFold(jnp.array([[[1.0]], [[-1.0]]])),
    )
    mixture = FoldedMixture(parts, logits=jnp.zeros(2))
    axes = plot_density(mixture, ax, slices=[0.4])
    (dot,) = [line for line in axes.lines if line.get_marker() == "o"]
    np.testing.assert_allclose(dot.get_ydata(), mixture.condition_time(0.4).mean, rtol=1e-5)
