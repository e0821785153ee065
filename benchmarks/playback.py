"""Speed of rendering a fitted model, and accuracy against time for every field of `RenderOptions`.

    python -m benchmarks.playback [--json FILE] [--plot FILE] [--model FILE] [--size HxW] [--gaussians N] [--minutes M]
                                  [--rounds N]

Without options: *Bunny* at 640x1280 with 150,000 Gaussians, fitted for five minutes first. Every frame of the clip is
rendered once per round, into a uint8 picture in memory. `playback_fps` is the median over rounds of frames / seconds,
conditioning included; the slowest frame is shown too, since that is where a player stutters.

With --plot (PNG) 12 frames are also rendered with one field changed at a time, from the constants that the model was
fitted with; the presets (with the fitted low pass) are shown beside. All settings render the same frames in turn
(engine "cpu", one thread, conditioning not counted); `time` is the median over rounds, divided by
that with the fitted constants. PSNR is against the clip. The tile size is not among the fields: this engine has one.
"""

import dataclasses
import time
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import _common
from benchmarks._common import Task, console
from foldgauss._runtime.threads import set_num_threads
from foldgauss.io import load_video_model, read_video
from foldgauss.io.datasets import sample_clip
from foldgauss.io.figures import write_figure
from foldgauss.render import RenderOptions, cpu
from foldgauss.video import FitConfig, VideoModel, fit
from foldgauss.video.models.renderer import VideoRenderer

#: Frames that are rendered with each setting.
FRAMES = 12
FIELDS = {
    "alpha_cutoff": (1e-4, 1 / 1024, 1 / 255, 1 / 128, 1 / 64, 1 / 32, 1 / 16),
    "alpha_ceiling": (0.9, 0.99, 0.999, 1.0),
    "transmittance_stop": (0.0, 1e-4, 1e-3, 1e-2, 1e-1),
    "low_pass": (0.0, 0.1, 0.3, 0.5),
    "support_radius": (None, 3.0, 2.5, 2.0, 1.5),
}
#: Figures of a setting: field, value, time relative to the fitted constants, and PSNR in dB.
Row = tuple[str, str, float, float]


def settings(fitted: RenderOptions) -> dict[tuple[str, str], RenderOptions]:
    """(field, value) -> options; the fitted ones come first."""
    made = {("as fitted", ""): fitted}
    for field, values in FIELDS.items():
        for value in values:
            made[field, "None" if value is None else f"{value:.3g}"] = dataclasses.replace(fitted, **{field: value})
    for preset in ("exact", "standard", "fast"):
        # The low pass is part of the model, not of the engine: what was fitted with one looks wrong with another.
        made["preset", preset] = dataclasses.replace(getattr(RenderOptions, preset)(), low_pass=fitted.low_pass)
    return made


def measure_settings(model: VideoModel, frames: np.ndarray, rounds: int) -> list[Row]:
    playback, times = VideoRenderer(model, frames.shape[1:3]), np.asarray(model.frame_times.times())
    shown = np.linspace(0, len(times) - 1, FRAMES).astype(int)
    splats = [playback.splats(times[k]) for k in shown]
    leaves = [(one.mean, one.factor, one.opacity, one.color, np.zeros(3, np.float32)) for one in splats]
    targets = np.moveaxis(frames[shown], -1, 1) / np.float32(255)
    made = settings(model.options)
    draw = lambda how: [cpu.forward(*leaf, playback.size, options=how).image for leaf in leaves]  # noqa: E731
    tasks = {name: Task(lambda how=how: draw(how)) for name, how in made.items()}
    set_num_threads(1)  # the second thread's part depends on what else the machine does
    seconds = {name: np.median(each) for name, each in _common.interleaved(tasks, rounds).items()}
    set_num_threads(None)
    errors = {name: np.clip(draw(how), 0, 1) - targets for name, how in made.items()}
    psnr = {name: -10 * np.log10((error**2).mean((1, 2, 3))).mean() for name, error in errors.items()}
    return [(*name, own / seconds["as fitted", ""], psnr[name]) for name, own in seconds.items()]


def plot(rows: list[Row], path: Path) -> None:
    """A panel for each field, all on the same axes, so that their slopes may be compared."""

    def draw(figure: Any) -> None:
        panels = figure.subplots(2, 3, sharex=True, sharey=True)
        for ax, field in zip(panels.flat, [*FIELDS, "preset"], strict=True):
            own = [row for row in rows if row[0] == field]
            ax.plot(1.0, rows[0][3], "o", color="black", markerfacecolor="none", markersize=11)
            ax.plot([row[2] for row in own], [row[3] for row in own], "o" if field == "preset" else "o-", markersize=5)
            for k, (_, value, *place) in enumerate(own):
                offset = (0, 8 if k % 2 else -14)  # neighbors' names stand on two sides
                ax.annotate(value, place, offset, textcoords="offset points", ha="center", fontsize=8)
            ax.set_title(field, fontsize=11)
            ax.grid(alpha=0.3)
        figure.supxlabel("time per frame, relative to the constants of the fit (circle)")
        figure.supylabel("PSNR against the clip, dB")

    write_figure(path, draw, (12, 7))


def measure_speed(model: VideoModel, size: tuple[int, int], rounds: int) -> dict[str, float]:
    playback, times = VideoRenderer(model, size), np.asarray(model.frame_times.times())
    list(playback.frames(times[:3]))  # compiled
    seconds = []
    for _ in range(rounds):
        shown = [time.perf_counter()]
        for _picture in playback.frames(times):
            shown.append(time.perf_counter())
        seconds.append(np.diff(shown))
    rate = len(times) / np.median(np.sum(seconds, axis=1))
    return {"playback_fps": rate, "slowest frame (ms)": 1e3 * np.max(seconds)}


def main(arguments: list[str] | None = None) -> None:
    parser = _common.parser(__doc__)
    parser.add_argument("--model", type=Path, help="a fitted Bunny [fit one first]")
    parser.add_argument("--plot", type=Path, metavar="FILE", help="measure the fields of RenderOptions, and plot them")
    parser.add_argument("--size", type=_common.parse_size, default=(640, 1280), metavar="HxW", help="[640x1280]")
    parser.add_argument("--gaussians", type=_common.whole, default=150_000, help="[150000]")
    parser.add_argument("--minutes", type=_common.positive, default=5.0, help="of fitting [5]")
    parser.add_argument("--rounds", type=_common.whole, default=3, help="[3]")
    options = _common.parse(parser, arguments)
    clip = read_video(sample_clip("bunny"), size=options.size)
    if options.model is not None:
        model = load_video_model(options.model)
    else:
        console.print(f"fitting {options.gaussians:,} Gaussians for {options.minutes:g} minutes", style="dim")
        model = fit(clip.frames, FitConfig(num_gaussians=options.gaussians, minutes=options.minutes)).model
    figures = measure_speed(model, options.size, options.rounds)
    if options.plot is not None:
        rows = measure_settings(model, clip.frames, options.rounds)
        columns = "field", "value", "time", "PSNR, dB"
        _common.print_table(
            "Accuracy against time", columns, ((*row[:2], *(f"{x:.3f}" for x in row[2:])) for row in rows)
        )
        figures |= {f"{field} {value}: time": ratio for field, value, ratio, _ in rows}
        figures |= {f"{field} {value}: psnr": quality for field, value, _, quality in rows}
        plot(rows, options.plot)
    _common.finish(options.json, figures, setting={"size": options.size, "num_gaussians": model.num_gaussians})


if __name__ == "__main__":
    main()
