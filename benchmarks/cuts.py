"""Frame times at cuts: weights of gaps that move as far in time as others do, against plain Adam on all weights.

    python -m benchmarks.cuts [--json FILE] [--clips FOLDER] [--steps N]

*bikes*, and with --clips also three shots of 30 frames each, the first subfolders of FOLDER one after another; 90x160,
20,000 Gaussians, equal steps, one seed. *plain* updates the weight of a gap, which is hundreds of frames long, by as
much as that of any other interval, as the fit did before.
"""

import argparse
from pathlib import Path

import jax
import numpy as np

from benchmarks import _common
from benchmarks._clips import folder_sources
from benchmarks._common import console
from foldgauss.io import read_video
from foldgauss.io.datasets import sample_clip
from foldgauss.video import FitConfig, evaluate, fit
from foldgauss.video.fitting import adam

SIZE, SHOT, GAUSSIANS, STEPS = (90, 160), 30, 20_000, 2000


def main(arguments: list[str] | None = None) -> None:
    parser: argparse.ArgumentParser = _common.parser(__doc__)
    parser.add_argument("--clips", type=Path, metavar="FOLDER", help="a folder whose subfolders are shots")
    parser.add_argument("--steps", type=_common.whole, default=STEPS, help=f"of each fit [{STEPS}]")
    options = _common.parse(parser, arguments)
    clips = {"bikes": read_video(sample_clip("bikes"), size=SIZE).frames}
    if options.clips is not None:
        shots = [source._replace(size=SIZE, frames=SHOT).read().frames for source in folder_sources(options.clips)[:3]]
        clips["three shots"] = np.concatenate(shots)
    table = _common.table(f"{GAUSSIANS:,} Gaussians, {options.steps:,} steps", "clip", "weights", "PSNR", "worst frame")
    figures, ratio = {}, adam.CUT_RATIO
    for clip, frames in clips.items():
        for way, least in (("plain", np.inf), ("slower at cuts", ratio)):
            adam.CUT_RATIO = least
            jax.clear_caches()
            model = fit(frames, FitConfig(num_gaussians=GAUSSIANS, steps=options.steps)).model
            found = evaluate(model, frames)
            figures[f"{clip}, {way}: PSNR"], figures[f"{clip}, {way}: worst"] = found.mean_psnr, float(min(found.psnr))
            table.add_row(clip, way, f"{found.mean_psnr:.2f}", f"{min(found.psnr):.2f}")
    console.print(table)
    _common.finish(options.json, figures, _common.describe_machine(), setting={"steps": options.steps})


if __name__ == "__main__":
    main()
