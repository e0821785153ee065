"""Accuracy against time for every knob of `RenderOptions`, on a fitted model.

    python -m benchmarks.knobs [--json FILE] [--plot FILE] [--model FILE | --seconds S] [--size HxW] [--frames N]
                               [--rounds N]

Without options: Bunny at 320x640, fitted for two minutes first. One knob is turned at a time, from the constants that
the model was fitted with; the presets (with the fitted low pass) are shown beside. All settings draw the same frames in
turn (engine "cpu", one thread, conditioning not counted); `time` is the median over rounds of the ratio to the fitted
constants in the same round. PSNR is against the clip; `apart` is that at the worst frame between a setting's picture
and that of the fitted constants, `largest` the largest difference of a number. The tile size is no knob here: this
engine has one.
"""

import argparse
import dataclasses
import itertools
from pathlib import Path

import numpy as np

from benchmarks import _common
from benchmarks._common import Task, console
from foldgauss._runtime.threads import set_num_threads
from foldgauss.io import read_video
from foldgauss.io.datasets import sample_clip
from foldgauss.io.models.video_model import load_video_model
from foldgauss.render import RenderOptions, cpu
from foldgauss.video.fitting.loop import FitConfig, fit
from foldgauss.video.models.renderer import VideoRenderer

SIZE, SECONDS, GAUSSIANS, FRAMES = (320, 640), 120.0, 60_000, 12

KNOBS = {
    "alpha_cutoff": (1e-4, 1 / 1024, 1 / 255, 1 / 128, 1 / 64, 1 / 32, 1 / 16),
    "alpha_ceiling": (0.9, 0.99, 0.999, 1.0),
    "transmittance_stop": (0.0, 1e-4, 1e-3, 1e-2, 1e-1),
    "low_pass": (0.0, 0.1, 0.3, 0.5),
    "support_radius": (None, 3.0, 2.5, 2.0, 1.5),
}

#: The plot: its span of times, the differences (time, dB) up to which points share a name (a time repeats within some
#: 0.05), and where a name may stand, the best first.
TIMES, SAME = (0.6, 1.4), (0.06, 0.05)
SIDES = ((1, -1), (0, -1), (1, 0), (-1, 0), (-1, -1), (0, 1), (1, 1), (-1, 1))


def settings(fitted: RenderOptions) -> dict[tuple[str, str], RenderOptions]:
    """(knob, value) -> options; the fitted ones come first."""
    made = {("as fitted", ""): fitted}
    for knob, values in KNOBS.items():
        for value in values:
            shown = "None" if value is None else f"{value:.3g}"
            made[knob, shown] = dataclasses.replace(fitted, **{knob: value})
    for preset in ("exact", "standard", "fast"):
        # The low pass is part of the model, not of the engine: what was fitted with one looks wrong with another.
        made["preset", preset] = dataclasses.replace(getattr(RenderOptions, preset)(), low_pass=fitted.low_pass)
    return made


def main(arguments: list[str] | None = None) -> None:
    options = _common.parse(_parser(), arguments)
    facts, clip = _common.describe_machine(), read_video(sample_clip("bunny"), size=options.size)
    if options.model is not None:
        model = load_video_model(options.model)
    else:
        config = FitConfig(num_gaussians=GAUSSIANS, minutes=options.seconds / 60)
        console.print(f"fitting {GAUSSIANS:,} Gaussians for {options.seconds:.0f} s", style="dim")
        model = fit(clip.frames, config, fps=clip.fps).model
    playback, times = VideoRenderer(model, options.size), np.asarray(model.frame_times.times())
    shown = np.linspace(0, len(times) - 1, options.frames).astype(int)
    leaves = []
    for k in shown:
        splats = playback.splats(times[k])
        leaves.append((splats.mean, splats.factor, splats.opacity, splats.color, np.zeros(3, np.float32)))
    made = settings(model.options)
    draw = lambda how: [cpu.forward(*leaf, playback.size, options=how).image for leaf in leaves]  # noqa: E731
    pictures = {name: draw(how) for name, how in made.items()}
    tasks = {name: Task(lambda how=how: draw(how)) for name, how in made.items()}
    set_num_threads(1)  # the second thread's share depends on what else the machine does
    spans = {name: np.array(each) for name, each in _common.interleaved(tasks, options.rounds).items()}
    set_num_threads(None)
    targets = [clip.frames[k].transpose(2, 0, 1) / np.float32(255) for k in shown]
    base, rows = ("as fitted", ""), []
    table = _common.table(
        "accuracy against time", "knob", "value", "ms/frame", "time", "PSNR, dB", "apart, dB", "largest"
    )
    for name in made:
        scores = [_psnr(a, b) for a, b in zip(pictures[name], targets, strict=True)]
        apart = [_psnr(a, b) for a, b in zip(pictures[name], pictures[base], strict=True)]
        largest = max(float(np.abs(a - b).max()) for a, b in zip(pictures[name], pictures[base], strict=True))
        milliseconds, ratio = 1e3 * np.median(spans[name]) / len(shown), np.median(spans[name] / spans[base])
        rows.append((*name, milliseconds, ratio, np.mean(scores), np.min(apart), largest))
        knob, value, *numbers = rows[-1]
        table.add_row(knob, value, *(f"{x:.3g}" if i != 2 else f"{x:.2f}" for i, x in enumerate(numbers)))
    console.print(table)
    if options.plot is not None:
        _plot(rows, options.plot)
    figures = {
        f"{knob} {value}: {what}": x
        for knob, value, *xs in rows
        for what, x in zip(("ms", "time", "psnr"), xs[:3], strict=True)
    }
    _common.finish(options.json, figures, facts, size=options.size)


def _psnr(a: np.ndarray, b: np.ndarray) -> float:
    error = float(np.mean((np.clip(a, 0, 1) - np.clip(b, 0, 1)) ** 2, dtype=np.float64))
    return float("inf") if error == 0 else -10 * np.log10(error)


def _plot(rows, path: Path) -> None:
    """A panel for each knob, all on the same axes, so that their slopes may be compared."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(2, 3, figsize=(12, 7), dpi=110, sharex=True, sharey=True, layout="constrained")
    fitted, lowest, highest = rows[0], min(row[4] for row in rows), max(row[4] for row in rows)
    margin = 0.08 * (highest - lowest)
    axes[0, 0].set(xlim=TIMES, ylim=(lowest - margin, highest + margin))
    for ax, knob in zip(axes.flat, [*KNOBS, "preset"], strict=True):
        own = [row for row in rows if row[0] == knob]
        times, qualities = np.clip([row[3] for row in own], *TIMES), [row[4] for row in own]
        ax.plot(1.0, fitted[4], "o", color="black", markerfacecolor="none", markersize=11)
        ax.plot(times, qualities, "o" if knob == "preset" else "o-", color="tab:blue", markersize=5, clip_on=False)
        ax.set_title(knob, fontsize=11)
        ax.grid(alpha=0.3)
    figure.supxlabel("time per frame, relative to the constants fitted with (circle)")
    figure.supylabel("PSNR against the clip, dB")
    figure.draw_without_rendering()  # from here on places are known in pixels
    for ax, knob in zip(axes.flat, [*KNOBS, "preset"], strict=True):
        _label(ax, [row for row in rows if row[0] == knob], ax.transData.transform((1.0, fitted[4])))
    figure.savefig(path)
    pyplot.close(figure)


def _label(ax, rows, circle) -> None:
    """Name the points, those that cannot be told apart by one name; no name stands over anything else."""
    from matplotlib.transforms import Bbox

    places = ax.transData.transform([(np.clip(row[3], *TIMES), row[4]) for row in rows])
    steps = np.linspace(0, 1, 30)[:, None]
    along = [(1 - steps) * one + steps * other for one, other in itertools.pairwise(places)]
    taken = [Bbox.from_extents(*(place - 4), *(place + 4)) for place in np.concatenate([places, *along])]
    taken.append(Bbox.from_extents(*(circle - 9), *(circle + 9)))
    groups = []
    for k, row in enumerate(rows):
        if groups and np.all(np.abs(np.subtract(row[3:5], rows[groups[-1][0]][3:5])) <= SAME):
            groups[-1].append(k)
        else:
            groups.append([k])
    for group in groups:
        names = [rows[k][1] for k in group]
        text = names[0] if len(names) == 1 else ", ".join(names) if len(names) < 3 else f"{names[0]} to {names[-1]}"
        time = rows[group[0]][3]
        text += "" if TIMES[0] <= time <= TIMES[1] else f" (time {time:.2f})"
        for distance, (x, y) in itertools.product((9, 18, 30), SIDES):
            how = {"ha": ("right", "center", "left")[x + 1], "va": ("top", "center", "bottom")[y + 1], "fontsize": 9}
            offset = distance * np.array([x, y]) / np.hypot(x, y)
            how |= {"xycoords": "figure pixels", "textcoords": "offset pixels", "in_layout": False}
            note = ax.annotate(text, places[group].mean(axis=0), offset, **how)
            box = note.get_window_extent()
            if ax.bbox.contains(*box.min) and ax.bbox.contains(*box.max) and not box.count_overlaps(taken):
                break
            note.remove()
        taken.append(box)


def _parser() -> argparse.ArgumentParser:
    parser = _common.parser(__doc__)
    source = parser.add_mutually_exclusive_group()
    source.add_argument("--model", type=Path, help="a fitted Bunny [fit one first]")
    source.add_argument("--seconds", type=float, default=SECONDS, help=f"of fitting [{SECONDS:g}]")
    parser.add_argument("--plot", type=Path, help="write the plot here (PNG)")
    parser.add_argument("--size", type=_common.size, default=SIZE, metavar="HxW", help="[320x640]")
    parser.add_argument("--frames", type=_common.whole, default=FRAMES, help=f"[{FRAMES}]")
    parser.add_argument("--rounds", type=_common.whole, default=15, help="[15]")
    return parser


if __name__ == "__main__":
    main()
