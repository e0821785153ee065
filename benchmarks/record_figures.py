"""Figures of quality against time and bytes, from the records of measurements.

    python -m benchmarks.record_figures [--records FOLDER] [--out FOLDER] [--only NAME ...]

- *quality-time*: PSNR and megabytes (float32) against minutes of fitting, *Bunny*, from `defaults.json` and
  `defaults-followed.json` (`benchmarks.defaults`), beside the figures of the VeGaS paper (table:init-gauss). Points are
  not joined: load, number of Gaussians and its rule differ.
- *tradeoff-clips*: PSNR against CPU time and against bytes, from `tradeoff-clips.json` (`benchmarks.tradeoff_clips`).

Each figure is 5 inches wide, so that its text is readable on a screen of 360 pixels.
"""

import json
from pathlib import Path
from typing import Any

import matplotlib
from matplotlib import pyplot as plt
from matplotlib.lines import Line2D

from benchmarks import _common
from benchmarks.reproduce import PAPER_STARTS
from foldgauss.io._atomic import atomic_path

RECORDS = Path(__file__).parent / "records"
BLUE = "#2b5c8a"
ORANGE = "#d1662b"
GREEN = "#3f8f5b"
GREY = "#6b7178"
#: Inches.
WIDTH = 5.0
#: Pixels for each inch.
DPI = 200
STYLE = {
    "font.size": 10.5,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": GREY,
    "axes.grid": True,
    "grid.color": "#e3e5e8",
    "legend.frameon": False,
    "lines.markersize": 7,
    "figure.constrained_layout.use": True,
}
#: Runs of *Bunny* in the figure of time: record, names, color, whether the marker is filled, and the offset of its text
#: in points.
BUNNY = {
    "160x320": ("defaults", ("bunny-160-1", "bunny-160"), GREEN, True, 8),
    "160x320, another day: 0.6 times the steps": ("defaults-followed", ("bunny-160-1", "bunny-160"), GREEN, False, -20),
    "640x1280": ("defaults", ("bunny-640-5", "bunny-640"), BLUE, True, 8),
    "640x1280, earlier rule for the number of Gaussians": ("defaults", ("bunny-640-60",), BLUE, False, 8),
}
#: Megabytes of a million Gaussians of degree 7: 25 float32 parameters each.
PAPER_MEGABYTES = 100
CLIPS = {"bunny": BLUE, "bikes": ORANGE, "carphone": GREEN}
#: Presets in the figure of the trade-off, which are drawn apart from the budgets: marker and label.
PRESETS = {"draft": ("^", "--preset draft"), "standard": ("s", "no option")}
#: Runs of compact files are named as the fit, with this.
COMPACT = ", compact"

Runs = dict[str, dict[str, Any]]


def quality_time(records: Path) -> plt.Figure:
    """PSNR against minutes of fitting, here and in the paper."""
    fig, ax = plt.subplots(figsize=(WIDTH, 4.2))
    for label, (record, names, color, filled, offset) in BUNNY.items():
        runs = _read(records, record)["runs"]
        for name in names:
            minutes, psnr, size = runs[name]["seconds"] / 60, runs[name]["psnr"], 4e-6 * runs[name]["floats"]
            style = {"color": color, "mfc": color if filled else "white"}
            ax.plot(minutes, psnr, "o", label=f"foldgauss, {label}" if name == names[0] else None, **style)
            ax.annotate(f"{psnr:.1f}, {size:.0f} MB", (minutes, psnr), (0, offset), textcoords="offset points",
                        ha="center", color=color, fontsize=9)  # fmt: skip
    minutes, psnr = zip(*((_to_minutes(time), psnr) for psnr, _, time in PAPER_STARTS.values()), strict=True)
    ax.plot(minutes, psnr, "x", color=ORANGE, mew=2, label="VeGaS as published, 640x1280")
    sizes = [PAPER_MEGABYTES * count for _, count, _ in PAPER_STARTS.values()]
    text = f"{min(psnr):.1f} to {max(psnr):.1f}, {min(sizes):.0f} to {max(sizes):.0f} MB"
    ax.annotate(
        text, (max(minutes), min(psnr)), (0, -16), textcoords="offset points", ha="right", color=ORANGE, fontsize=9
    )
    ax.set(xscale="log", xlabel="minutes of fitting", ylabel="PSNR (dB), mean over all frames")
    ticks = [1, 2, 5, 10, 20, 60]
    ax.set_xticks(ticks, [str(tick) for tick in ticks])
    ax.minorticks_off()
    ax.set_xlim(0.6, 110)
    low, high = ax.get_ylim()
    ax.set_ylim(low - 0.5, high + 0.6)
    fig.legend(loc="outside upper left", fontsize=9)
    return fig


def _to_minutes(text: str) -> float:
    """Minutes of a time as the paper writes it: 57m00s, 1h00m53s."""
    hours, _, rest = text.rpartition("h")
    minutes, _, seconds = rest.removesuffix("s").partition("m")
    return 60 * int(hours or 0) + int(minutes) + int(seconds) / 60


def tradeoff_clips(records: Path) -> plt.Figure:
    """Above, PSNR against CPU time; below, against the bytes of model files and compact files."""
    runs = _read(records, "tradeoff-clips")["runs"]
    fig, (by_time, by_bytes) = plt.subplots(2, figsize=(WIDTH, 6.4))
    for clip, color in CLIPS.items():
        own = {name.removeprefix(f"{clip}, "): run for name, run in runs.items() if name.startswith(f"{clip}, ")}
        fits = {name: run for name, run in own.items() if not name.endswith(COMPACT)}
        compact = {name.removesuffix(COMPACT): run for name, run in own.items() if name.endswith(COMPACT)}
        _draw(by_time, fits, "cpu_seconds", 1.0, color=color)
        _draw(by_bytes, fits, "bytes", 1e-6, color=color, mfc="white", ls="--")
        _draw(by_bytes, compact, "bytes", 1e-6, color=color)
    by_time.set(xlabel="time to fit, CPU seconds (one core)", ylabel="PSNR (dB)", xscale="log")
    by_bytes.set(xlabel="size, megabytes", ylabel="PSNR (dB)", xscale="log")
    for axes, ticks in ((by_time, (5, 10, 20, 40, 80, 160, 320)), (by_bytes, (0.05, 0.1, 0.2, 0.5, 1, 2, 5, 10))):
        low, high = axes.get_xlim()
        shown = [tick for tick in ticks if low <= tick <= high]
        axes.set_xticks(shown, [f"{tick:g}" for tick in shown])
        axes.minorticks_off()
    handles = [Line2D([], [], color=color, lw=3, label=clip) for clip, color in CLIPS.items()]
    markers = {"--minutes": "o"} | {label: marker for name, (marker, label) in PRESETS.items() if name in fits}
    styles = {label: {"marker": marker} for label, marker in markers.items()}
    styles |= {"model file": {"marker": "o", "mfc": "white"}, "compact file": {"marker": "o"}}
    handles += [Line2D([], [], color=GREY, ls="", label=label, **style) for label, style in styles.items()]
    fig.legend(handles=handles, loc="outside upper center", ncols=2, fontsize=9.5, columnspacing=1)
    return fig


def _draw(axes: plt.Axes, runs: Runs, cost: str, factor: float, **style: Any) -> None:
    """A curve of the budgets, and a point for each preset."""
    points = sorted((factor * run[cost], run["psnr"]) for name, run in runs.items() if name not in PRESETS)
    axes.plot([x for x, _ in points], [y for _, y in points], marker="o", **style)
    for name, (marker, _) in PRESETS.items():
        if name in runs:
            axes.plot(factor * runs[name][cost], runs[name]["psnr"], marker, **style | {"ls": ""})


def _read(folder: Path, name: str) -> dict[str, Any]:
    return json.loads((folder / f"{name}.json").read_text())


FIGURES = {"quality-time": quality_time, "tradeoff-clips": tradeoff_clips}


def main(arguments: list[str] | None = None) -> None:
    parser = _common.parser(__doc__)
    parser.add_argument("--records", type=Path, default=RECORDS, metavar="FOLDER", help="[benchmarks/records]")
    parser.add_argument("--out", type=Path, default=Path("docs"), metavar="FOLDER", help="[docs]")
    parser.add_argument(
        "--only", choices=tuple(FIGURES), nargs="+", default=tuple(FIGURES), metavar="NAME", help="[all]"
    )
    options = _common.parse(parser, arguments)
    matplotlib.use("Agg")
    options.out.mkdir(parents=True, exist_ok=True)
    with plt.rc_context(STYLE):
        for name in options.only:
            figure = FIGURES[name](options.records)
            with atomic_path(options.out / f"{name}.png") as temporary:
                figure.savefig(temporary, dpi=DPI, format="png", facecolor="white")
            plt.close(figure)


if __name__ == "__main__":
    main()
