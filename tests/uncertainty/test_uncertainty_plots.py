"""Plots of a posterior: data, frames and labels."""

import numpy as np
import pytest
from synthetic_posteriors import posterior_about

from foldgauss.uncertainty.diagnostics import plots

pyplot = pytest.importorskip("matplotlib.pyplot", reason="matplotlib is an optional extra")


@pytest.fixture(autouse=True)
def _no_screen():
    pyplot.switch_backend("Agg")
    yield
    pyplot.close("all")


@pytest.fixture(scope="module")
def posterior():
    steps = np.ones(20)
    steps[[4, 12]] = 0.01, 2.2
    times = np.concatenate([[0], np.cumsum(steps)])
    return posterior_about(times / times[-1], 0.03)


def test_times_in_frames(posterior):
    upper, lower = axes = plots.plot_times(posterior, fitted=np.linspace(0, 1, 21))
    axes[0].figure.canvas.draw()
    lines = {line.get_label(): line for line in (*upper.lines, *lower.lines)}
    np.testing.assert_allclose(lines["posterior mean"].get_ydata(), posterior.mean() * 20 - np.arange(21))
    np.testing.assert_allclose(lines["as fitted"].get_ydata(), 0, atol=1e-12)
    assert lines["duplicated"].get_xdata().tolist() == [4.5]
    assert lines["dropped"].get_xdata().tolist() == [12.5]
    half = np.diff(posterior.exact.interval(0.9), axis=0)[0, 1:-1] * 10
    np.testing.assert_allclose(lines["exact, 90%"].get_ydata(), half)
    assert "frames" in upper.get_ylabel()
    own = pyplot.subplots(2, 1)[1]
    assert plots.plot_times(posterior, own) is own
    with pytest.raises(ValueError, match="fitted: expected 21 times"):
        plots.plot_times(posterior, fitted=np.zeros(3))


def test_increments(posterior):
    ax = plots.plot_increments(posterior)
    marked = {line.get_label(): list(line.get_xdata()) for line in ax.lines}
    assert marked["duplicated: 1"] == [4.5]
    assert marked["dropped: 1"] == [12.5]
    low, high = ax.get_ylim()
    assert low < 0
    assert high > 2.2
    assert plots.plot_increments(posterior, ax=ax, flagged=[]) is ax


def test_correlation_title_states_the_effective_number(posterior):
    ax = plots.plot_correlation(posterior.profiles)
    np.testing.assert_allclose(ax.lines[0].get_ydata(), 0.7 ** np.arange(12))
    assert ax.get_title() == "Residuals of 5.1 gray levels, one value in 10 counts"


def test_cuts_are_left_out():
    steps = np.ones(20)
    steps[9] = 60.0
    times = np.concatenate([[0], np.cumsum(steps)])
    posterior = posterior_about(times / times[-1], 0.005)
    upper, _ = plots.plot_times(posterior)
    line = next(line for line in upper.lines if line.get_label() == "posterior mean")
    assert np.abs(line.get_ydata()).max() < 0.5
    assert 9.5 not in plots.plot_increments(posterior).lines[1].get_xdata()
