"""Numbers stored at one PSNR: models that hold only what the scene requires, beside plain ones, the best of a sweep.

    python -m benchmarks.economy [--json FILE] [--clip NAME] [--size HxW] [--psnr DB] [--steps N] [--degrees 1,3,7,0]

*Off* is a plain fit: for each degree the number of Gaussians is searched, in steps of an eighth of an octave, for the
smallest that reaches the PSNR (mean over the frames); each fit that does is also *pruned*, of Gaussians in the order of
what they add to the pictures, as far as the PSNR allows, nothing fitted again. *On* is the fit with
`Economy(psnr=...)`. All have as many steps, but the economical one may take half as many again when it falls short,
which the table tells.
"""

import json
import time
from pathlib import Path

import numpy as np

from benchmarks import _common
from benchmarks._common import console
from benchmarks.compress import kept
from foldgauss.io import read_video, save_video_model
from foldgauss.io.datasets import sample_clip
from foldgauss.video import Economy, FitConfig, VideoModel, evaluate, fit
from foldgauss.video.selection.contributions import Contributions, sum_contributions
from foldgauss.video.selection.regions import Region

SIZE, PSNR, STEPS, DEGREES = (160, 320), 33.0, 6000, (1, 3, 7, 0)
#: Where the search begins, for the default clip, and its step.
FIRST, RATIO = 12_000, 2**0.125


def pruned(model: VideoModel, frames: np.ndarray, psnr: float) -> VideoModel:
    """Without as many of the Gaussians that add least as leave the mean PSNR at `psnr`."""
    lit, everywhere = Contributions(model), np.ones(model.size, np.float32)
    order = np.argsort(sum_contributions(lit, Region(tuple(range(model.num_frames)), lambda k: everywhere))[1])
    least, most = 0, model.num_gaussians - 1
    while most - least > max(model.num_gaussians // 200, 1):
        middle = (least + most) // 2
        enough = evaluate(kept(model, np.sort(order[middle:])), frames).mean_psnr >= psnr
        least, most = (middle, most) if enough else (least, middle)
    return kept(model, np.sort(order[least:]))


class Sweep:
    """Plain fits of one degree, by their number of Gaussians."""

    def __init__(self, frames: np.ndarray, degree: int, psnr: float, steps: int):
        self.frames, self.degree, self.psnr, self.steps = frames, degree, psnr, steps
        self.rows = []

    def reaches(self, num: int) -> bool:
        begun = time.perf_counter()
        model = fit(self.frames, FitConfig(num_gaussians=num, degree=self.degree, steps=self.steps)).model
        seconds, reached = time.perf_counter() - begun, evaluate(model, self.frames).mean_psnr
        self._note("plain", model, reached, seconds)
        if reached >= self.psnr:
            small = pruned(model, self.frames, self.psnr)
            self._note("plain, pruned", small, evaluate(small, self.frames).mean_psnr, seconds)
        return reached >= self.psnr

    def _note(self, what: str, model: VideoModel, reached: float, seconds: float) -> None:
        self.rows.append((what, self.degree, model.num_gaussians, model.num_parameters, reached, seconds))
        console.print(*self.rows[-1])

    def search(self, first: int) -> int:
        """Down or up from `first` until the PSNR is bracketed; then the next larger one too, for pruning."""
        num, there = first, self.reaches(first)
        while True:
            num = round(num / RATIO if there else num * RATIO)
            if self.reaches(num) != there:
                break
        smallest = num if not there else round(num * RATIO)
        self.reaches(round(smallest * RATIO**3))
        return smallest


def main(arguments: list[str] | None = None) -> None:
    parser = _common.parser(__doc__)
    parser.add_argument("--clip", choices=("bunny", "bikes", "carphone"), default="bunny")
    parser.add_argument("--size", type=_common.size, default=SIZE, metavar="HxW", help="[160x320]")
    parser.add_argument("--psnr", type=float, default=PSNR, help="dB [33]")
    parser.add_argument("--steps", type=_common.whole, default=STEPS, help="[6000]")
    parser.add_argument("--first", type=_common.whole, default=FIRST, help="Gaussians the search begins with [12000]")
    parser.add_argument("--degrees", default=",".join(map(str, DEGREES)), help="[1,3,7,0]")
    parser.add_argument("--model", type=Path, help="write the economical model here")
    options = _common.parse(parser, arguments)
    facts, figures, rows = _common.describe_machine(), {}, []
    clip = read_video(sample_clip(options.clip), size=options.size)
    begun = time.perf_counter()
    result = fit(clip.frames, FitConfig(steps=options.steps, economy=Economy(psnr=options.psnr)), fps=clip.fps)
    model, seconds = result.model, time.perf_counter() - begun
    reached, steps = evaluate(model, clip.frames).mean_psnr, result.history[-1].step
    if options.model is not None:
        save_video_model(options.model, model)
    rows.append(
        (f"economy, {steps:,} steps", model.degree, model.num_gaussians, model.num_parameters, reached, seconds)
    )
    console.print(*rows[0])
    first = options.first
    for degree in map(int, options.degrees.split(",")):
        sweep = Sweep(clip.frames, degree, options.psnr, options.steps)
        first = sweep.search(first)
        rows += sweep.rows
    off = min((row for row in rows[1:] if row[4] >= options.psnr), key=lambda row: row[3])
    table = _common.table(
        f"{options.clip}, {clip.num_frames} frames of {options.size[0]}x{options.size[1]}, {options.psnr:g} dB",
        "fit",
        "degree",
        "Gaussians",
        "parameters stored",
        "PSNR",
        "seconds",
    )
    for what, degree, num, floats, reached, seconds in rows:
        mark = " *" if floats == off[3] else ""
        table.add_row(what + mark, str(degree), f"{num:,}", f"{floats:,}", f"{reached:.2f}", f"{seconds:.0f}")
    console.print(table)
    ratio = off[3] / rows[0][3]
    console.print(
        f"* the smallest of the sweep that reaches it: {ratio:.2f} times the parameters of the economical one"
    )
    figures |= {"economy: numbers": rows[0][3], "off: numbers": off[3], "off / economy": ratio}
    figures["rows"] = json.dumps(rows)
    _common.finish(options.json, figures, facts, setting={"clip": options.clip, "size": options.size})


if __name__ == "__main__":
    main()
