"""Frames a second of a fitted model, conditioning included.

    python -m benchmarks.playback [--json FILE] [--model FILE | --seconds S --gaussians N] [--size HxW] [--rounds N]

Without options: the Bunny clip, fitted at 640x1280 for five minutes first; give `--keep FILE` to keep the model, and
`--model FILE` to play one. Every frame of the clip is drawn once per round, into a uint8 picture in memory.
`playback_fps` is the median over rounds of frames / seconds; the slowest frame is shown too, since that is where a
player stutters. Conditioning, blending and the conversion to bytes are timed apart in one more round.
"""

import argparse
import time
from pathlib import Path

import numpy as np

from benchmarks import _common
from benchmarks._common import console
from foldgauss.io import read_video
from foldgauss.io.datasets import sample_clip
from foldgauss.io.models.video_model import load_video_model, save_video_model
from foldgauss.render import cpu
from foldgauss.video.fitting.loop import FitConfig, fit
from foldgauss.video.models.renderer import VideoRenderer, to_bytes
from foldgauss.video.models.video_model import VideoModel

SIZE, SECONDS, GAUSSIANS = (640, 1280), 300.0, 150_000


def fitted(options: argparse.Namespace) -> VideoModel:
    if options.model is not None:
        return load_video_model(options.model)
    clip = read_video(sample_clip("bunny"), size=options.size)
    config = FitConfig(num_gaussians=options.gaussians, minutes=options.seconds / 60)
    console.print(f"fitting {options.gaussians:,} Gaussians for {options.seconds:.0f} s", style="dim")
    model = fit(clip.frames, config, fps=clip.fps).model
    if options.keep is not None:
        save_video_model(options.keep, model)
    return model


def stages(playback: VideoRenderer, times: np.ndarray) -> dict[str, float]:
    """Median milliseconds per frame of each stage."""
    seconds = {"condition": [], "blend": [], "to bytes": []}
    alive, pairs = [], []
    for t in times:
        begun = time.perf_counter()
        splats = playback.splats(t)
        conditioned = time.perf_counter()
        leaves = splats.mean, splats.factor, splats.opacity, splats.color, np.zeros(3, np.float32)
        trace = cpu.forward(*leaves, playback.size, options=playback.model.options)
        blended = time.perf_counter()
        to_bytes(trace.image)
        done = time.perf_counter()
        for name, span in zip(seconds, (conditioned - begun, blended - conditioned, done - blended), strict=True):
            seconds[name].append(span)
        alive.append(len(splats.opacity))
        pairs.append(trace.num_pairs)
    return {f"{name} (ms)": 1e3 * float(np.median(spans)) for name, spans in seconds.items()} | {
        "alive": float(np.median(alive)),
        "million pairs": 1e-6 * float(np.median(pairs)),
    }


def main(arguments: list[str] | None = None) -> None:
    options = _common.parse(_parser(), arguments)
    facts, model = _common.describe_machine(), fitted(options)
    playback, times = VideoRenderer(model, options.size), np.asarray(model.frame_times.times())
    list(playback.frames(times[:3]))  # compiled
    rates, slowest = [], 0.0
    for _ in range(options.rounds):
        begun, last = time.perf_counter(), time.perf_counter()
        for _picture in playback.frames(times):
            now = time.perf_counter()
            slowest, last = max(slowest, now - last), now
        rates.append(len(times) / (time.perf_counter() - begun))
    figures = {"playback_fps": float(np.median(rates)), "slowest frame (ms)": 1e3 * slowest, **stages(playback, times)}
    setting = {"size": options.size, "num_frames": len(times), "num_gaussians": model.splats.num_gaussians}
    _common.finish(options.json, figures, facts, setting=setting)


def _parser() -> argparse.ArgumentParser:
    parser = _common.parser(__doc__)
    source = parser.add_mutually_exclusive_group()
    source.add_argument("--model", type=Path, help="a fitted model [fit one first]")
    source.add_argument("--keep", type=Path, help="where to keep the model that is fitted")
    parser.add_argument("--size", type=_common.size, default=SIZE, metavar="HxW", help="[640x1280]")
    parser.add_argument("--seconds", type=float, default=SECONDS, help=f"of fitting [{SECONDS:g}]")
    parser.add_argument("--gaussians", type=_common.whole, default=GAUSSIANS, help=f"[{GAUSSIANS}]")
    parser.add_argument("--rounds", type=_common.whole, default=3, help="[3]")
    return parser


if __name__ == "__main__":
    main()
