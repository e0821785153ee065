"""Accuracy against time for every knob of `RenderOptions`, on a fitted model.

    python -m benchmarks.knobs [--json FILE] [--plot FILE] [--model FILE | --seconds S] [--size HxW] [--frames N]
                               [--rounds N]

Without options: Bunny at 320x640, fitted for two minutes first. One knob is turned at a time, from the constants that
the model was fitted with; the presets (with the fitted low pass) are shown beside. All settings draw the same frames in
turn (engine "cpu", conditioning not counted). PSNR is against the clip; `apart` is that at the worst frame between
a setting's picture and that of the fitted constants, and `largest` the largest difference of a number of theirs.
"""

import argparse
import dataclasses
from pathlib import Path

import numpy as np

from benchmarks import _common
from benchmarks._common import Task, console
from foldgauss.datasets import sample_clip
from foldgauss.io.video_file import read_video
from foldgauss.io.video_model import load_video_model
from foldgauss.render import RenderOptions, cpu
from foldgauss.video.fit import FitConfig, fit
from foldgauss.video.playback import Playback

SIZE, SECONDS, GAUSSIANS, FRAMES = (320, 640), 120.0, 60_000, 12

KNOBS = {
    "alpha_cutoff": (1e-4, 1 / 1024, 1 / 255, 1 / 128, 1 / 64, 1 / 32, 1 / 16),
    "alpha_ceiling": (0.9, 0.99, 0.999, 1.0),
    "transmittance_stop": (0.0, 1e-4, 1e-3, 1e-2, 1e-1),
    "low_pass": (0.0, 0.1, 0.3, 0.5),
    "support_radius": (None, 3.0, 2.5, 2.0, 1.5),
    "tile_size": (8, 16),
}


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
    facts, clip = _common.machine(), read_video(sample_clip("bunny"), size=options.size)
    if options.model is not None:
        model = load_video_model(options.model)
    else:
        config = FitConfig(num_gaussians=GAUSSIANS, minutes=options.seconds / 60)
        console.print(f"fitting {GAUSSIANS:,} Gaussians for {options.seconds:.0f} s", style="dim")
        model = fit(clip.frames, config, fps=clip.fps).model
    playback, times = Playback(model, options.size), np.asarray(model.frame_times.times())
    shown = np.linspace(0, len(times) - 1, options.frames).astype(int)
    leaves = []
    for k in shown:
        splats = playback.splats(times[k])
        leaves.append((splats.mean, splats.factor, splats.opacity, splats.color, np.zeros(3, np.float32)))
    made = {}
    for name, how in settings(model.options).items():
        try:
            cpu.check_options(how)
        except ValueError as error:
            console.print(f"{name}: {error}", style="yellow")
            continue
        made[name] = how
    draw = lambda how: [cpu.forward(*leaf, playback.size, options=how).image for leaf in leaves]  # noqa: E731
    pictures = {name: draw(how) for name, how in made.items()}
    tasks = {name: Task(lambda how=how: draw(how)) for name, how in made.items()}
    seconds = {name: np.median(spans) for name, spans in _common.interleaved(tasks, options.rounds).items()}
    targets = [clip.frames[k].transpose(2, 0, 1) / np.float32(255) for k in shown]
    base, rows = ("as fitted", ""), []
    table = _common.table(
        "accuracy against time", "knob", "value", "ms/frame", "time", "PSNR, dB", "apart, dB", "largest"
    )
    for name in made:
        scores = [_psnr(a, b) for a, b in zip(pictures[name], targets, strict=True)]
        apart = [_psnr(a, b) for a, b in zip(pictures[name], pictures[base], strict=True)]
        largest = max(float(np.abs(a - b).max()) for a, b in zip(pictures[name], pictures[base], strict=True))
        milliseconds = 1e3 * seconds[name] / len(shown)
        rows.append((*name, milliseconds, seconds[name] / seconds[base], np.mean(scores), np.min(apart), largest))
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
    import matplotlib.pyplot as plt

    knobs = [*KNOBS, "preset"]
    figure, axes = plt.subplots(2, 4, figsize=(15, 6.5), sharex=True, sharey=True, layout="constrained")
    fitted = rows[0]
    for ax, knob in zip(axes.flat, knobs, strict=False):
        own = [row for row in rows if row[0] == knob]
        time, quality = [row[3] for row in own], [row[4] for row in own]
        ax.plot(time, quality, "o-" if knob != "preset" else "o", color="tab:blue", markersize=4)
        for row in own:
            ax.annotate(row[1], (row[3], row[4]), textcoords="offset points", xytext=(4, 4), fontsize=8)
        ax.plot(1.0, fitted[4], "o", color="black", markerfacecolor="none", markersize=9)
        ax.set_title(knob, fontsize=10)
        ax.grid(alpha=0.3)
    axes.flat[-1].axis("off")
    figure.supxlabel("time per frame, relative to the constants fitted with (circle)")
    figure.supylabel("PSNR against the clip, dB")
    figure.savefig(path, dpi=110)


def _parser() -> argparse.ArgumentParser:
    parser = _common.parser(__doc__)
    source = parser.add_mutually_exclusive_group()
    source.add_argument("--model", type=Path, help="a fitted Bunny [fit one first]")
    source.add_argument("--seconds", type=float, default=SECONDS, help=f"of fitting [{SECONDS:g}]")
    parser.add_argument("--plot", type=Path, help="write the plot here (PNG)")
    parser.add_argument("--size", type=_common.size, default=SIZE, metavar="HxW", help="[320x640]")
    parser.add_argument("--frames", type=_common.whole, default=FRAMES, help=f"[{FRAMES}]")
    parser.add_argument("--rounds", type=_common.whole, default=5, help="[5]")
    return parser


if __name__ == "__main__":
    main()
