"""Figures that are drawn from records show all of what was measured."""

import json

import pytest

pytest.importorskip("matplotlib", reason="the figures need the extra 'plot'").use("Agg")

from benchmarks import record_figures  # noqa: E402
from benchmarks.reproduce import PAPER_STARTS  # noqa: E402


def _points(figure) -> set[tuple[float, float]]:
    lines = [line for axes in figure.axes for line in axes.lines]
    return {(round(float(x), 6), round(float(y), 6)) for line in lines for x, y in line.get_xydata()}


def test_figure_of_time_has_every_fit_of_bunny_and_the_papers():
    figure = record_figures.quality_time(record_figures.RECORDS)
    points = _points(figure)
    for record, names in (
        ("defaults", ("bunny-160", "bunny-640", "bunny-640-60")),
        ("defaults-followed", ("bunny-160",)),
    ):
        runs = json.loads((record_figures.RECORDS / f"{record}.json").read_text())["runs"]
        for name in names:
            assert (round(runs[name]["seconds"] / 60, 6), round(runs[name]["psnr"], 6)) in points
    assert all(line.get_linestyle() == "None" or len(line.get_xydata()) == 1 for line in figure.axes[0].lines)
    assert {(57.0, 38.53), (round(60 + 53 / 60, 6), 38.86)} <= points
    assert len(PAPER_STARTS) == len({point for point in points if point[0] > 50 and point[1] < 40})


def test_figure_of_the_trade_off_has_every_run():
    points = _points(record_figures.tradeoff_clips(record_figures.RECORDS))
    runs = json.loads((record_figures.RECORDS / "tradeoff-clips.json").read_text())["runs"]
    for name, run in runs.items():
        assert (round(1e-6 * run["bytes"], 6), round(run["psnr"], 6)) in points, name
        if not name.endswith(", compact"):
            assert (round(run["cpu_seconds"], 6), round(run["psnr"], 6)) in points, name
