"""Frames never seen: fit every second frame, draw those in between, and compare with what is usual.

    python -m benchmarks.interpolation [--json FILE] [--clip bunny|bikes|carphone|PATH ...] [--size HxW]
                                       [--frames A:B] [--gaussians N] [--steps N | --minutes M [--cpu-time]]
                                       [--seed S] [--set NAME=VALUE ...] [--sheet FILE] [--cost] [--weight W ...]

Without options: *bunny* and *bikes* at 160x320, 5 minutes each, with as many Gaussians as the fit chooses. Frames 0, 2,
4, ... are fitted, and frames 1, 3, 5, ... drawn half way between the learned times of their neighbors, as `foldgauss
render` does (`interpolate_frames`) and by the Gaussians alone. Beside them, of the same neighbors:

- their mean, and their mean after warping each half way by OpenCV's DIS flow between the two;
- what the fit learns from between frames, `Motion.interpolate`;
- the first two again, of the model's own pictures of the neighbors: then all start from the same quality;
- with `--weight`, `interpolate_frames` with other weights of the prediction by optical flow, the same everywhere.

PSNR and SSIM of 8-bit pictures, means over the frames; "without cuts" leaves out frames between two shots, which
nothing can know. `--sheet` draws the held-out frames on which ours and the best rival differ most. `--cost` instead
fits all frames, with interpolated frames and without, and compares the PSNR at the frames. With `--cpu-time` minutes
are those of the processor, on one thread, so that fits beside other work are comparable.
"""

import argparse
import dataclasses
import itertools
import time
from pathlib import Path
from unittest import mock

import cv2
import numpy as np

from benchmarks import _common, fit_clip
from benchmarks._common import console
from foldgauss._runtime.threads import set_num_threads
from foldgauss.cli.shared.contact_sheet import make_comparison_sheet
from foldgauss.io import Clip, read_video, write_image
from foldgauss.io.datasets import sample_clip
from foldgauss.video import interpolate_frames, interpolated_times
from foldgauss.video.fitting.config import FitConfig
from foldgauss.video.fitting.loop import fit_steps, to_model
from foldgauss.video.models.frame_times import is_cut
from foldgauss.video.models.metrics import psnr, ssim
from foldgauss.video.models.video_model import VideoModel
from foldgauss.video.motion import slow_motion
from foldgauss.video.motion.optical_flow import Motion

CLIPS, SIZE, MINUTES = ("bunny", "bikes"), (160, 320), 5.0
SHOWN = 4
OURS = "interpolate_frames"


def mean_of_two(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Linear blending, half way; uint8 (height, width, 3)."""
    return ((one.astype(np.uint16) + other + 1) // 2).astype(np.uint8)


def warped_half_way(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Each picture moved half of its flow to the other, then their mean."""
    search = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    gray = [cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY) for picture in (one, other)]
    rows, columns = one.shape[:2]
    grid = np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), -1).astype(np.float32)
    moved = []
    for picture, pair in ((one, gray), (other, gray[::-1])):
        flow = search.calc(*pair, None)
        moved.append(cv2.remap(picture, grid - flow / 2, None, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE))
    return mean_of_two(*moved)


def interpolated_half_way(frames: np.ndarray) -> list[np.ndarray]:
    """What the optical flow predicts between each frame and the next."""
    motion = Motion.from_frames(np.ascontiguousarray(frames))
    made = (motion.interpolate(frames, k, 0.5, frames.shape[1:3]).image for k in range(len(frames) - 1))
    return [np.clip(np.rint(picture), 0, 255).astype(np.uint8) for picture in made]


def fit_model(frames: np.ndarray, config: FitConfig, fps: float, cpu_time: bool) -> VideoModel:
    """The fitted model; its minutes are those of the processor with `cpu_time`."""
    for last, _ in fit_steps(frames, config, clock=time.process_time if cpu_time else time.perf_counter):
        state = last
    return to_model(state, config, frames.shape[1:3], fps)


def measure_cost(clip: Clip, config: FitConfig, name: str, cpu_time: bool) -> dict[str, float]:
    """PSNR at the frames of a fit to all of them, with `config` and without interpolated frames."""
    figures = {}
    for way, chosen in {"frames": config, "plain": dataclasses.replace(config, interpolation_fraction=0.0)}.items():
        model = fit_model(clip.frames, chosen, clip.fps, cpu_time)
        scores = [psnr(target, made) for target, made in zip(clip.frames, model.frames(), strict=True)]
        figures[f"{way}_{name}"] = float(np.mean(scores))
    figures[f"cost_{name}"] = figures[f"plain_{name}"] - figures[f"frames_{name}"]
    table = _common.table(f"{name}: all {len(clip.frames)} frames fitted", "PSNR at the frames, dB", "")
    table.add_row("with interpolated frames", f"{figures[f'frames_{name}']:.2f}")
    table.add_row("without", f"{figures[f'plain_{name}']:.2f}")
    console.print(table)
    return figures


def interpolate_with_weight(model: VideoModel, times: np.ndarray, weight: float) -> list[np.ndarray]:
    """`interpolate_frames` with a weight of the prediction that does not depend on how much the frames differ."""
    with mock.patch.multiple(slow_motion, FLOW_WEIGHT=weight, HALVING_DIFFERENCE=np.inf):
        return list(interpolate_frames(model, times))


def measure(
    clip: Clip, config: FitConfig, name: str, sheet: Path | None, cpu_time: bool, weights: list[float]
) -> dict[str, float]:
    """Figures of one clip, which are also shown."""
    seen, held_out = clip.frames[::2], clip.frames[1:-1:2] if len(clip.frames) % 2 else clip.frames[1::2][:-1]
    model = fit_model(np.ascontiguousarray(seen), config, clip.fps / 2, cpu_time)
    times = np.asarray(model.frame_times.times())
    own = list(model.frames())
    half_way = interpolated_times(times, 2)[1::2]
    whole = ~np.asarray(is_cut(times))
    pictures = {OURS: list(interpolate_frames(model, half_way)), "folded Gaussians alone": list(model.frames(half_way))}
    pictures |= {f"weight {weight:g}": interpolate_with_weight(model, half_way, weight) for weight in weights}
    for whose, frames in (("frames", seen), ("own pictures", own)):
        pairs = list(itertools.pairwise(frames))
        pictures[f"blending, {whose}"] = [mean_of_two(*pair) for pair in pairs]
        pictures[f"DIS warping, {whose}"] = [warped_half_way(*pair) for pair in pairs]
    pictures["Motion.interpolate, frames"] = interpolated_half_way(seen)
    scores = {
        way: np.array([psnr(target, made) for target, made in zip(held_out, every, strict=True)])
        for way, every in pictures.items()
    }
    likeness = {
        way: float(np.mean([ssim(target, made) for target, made in zip(held_out, every, strict=True)]))
        for way, every in pictures.items()
    }
    training = float(np.mean([psnr(target, made) for target, made in zip(seen, own, strict=True)]))
    ours = scores[OURS]
    _show(scores, likeness, training, whole, f"{name}: {len(seen)} frames of {clip.size[0]}x{clip.size[1]} fitted")
    if sheet is not None:
        _draw(sheet.with_stem(f"{sheet.stem}-{name}"), held_out, pictures, scores, whole)
    names = {"blending, frames": "blend", "DIS warping, frames": "warp", "Motion.interpolate, frames": "motion"}
    names |= {
        "folded Gaussians alone": "alone",
        "blending, own pictures": "own_blend",
        "DIS warping, own pictures": "own_warp",
    }
    names |= {f"weight {weight:g}": f"weight_{weight:g}" for weight in weights}
    figures = {f"held_out_{name}": ours.mean(), f"training_{name}": training}
    figures |= {f"{short}_{name}": scores[way].mean() for way, short in names.items()}
    figures |= {f"{short}_ssim_{name}": likeness[way] for way, short in names.items()}
    figures[f"held_out_ssim_{name}"] = likeness[OURS]
    figures[f"loss_{name}"] = training - ours.mean()
    figures[f"held_out_whole_{name}"] = ours[whole].mean()
    figures[f"warp_whole_{name}"] = scores["DIS warping, frames"][whole].mean()
    return figures


def _show(
    scores: dict[str, np.ndarray], likeness: dict[str, float], training: float, whole: np.ndarray, title: str
) -> None:
    table = _common.table(title, "held-out frames", "PSNR, dB", "without cuts", "worst", "SSIM")
    for way, values in scores.items():
        kept = values[whole]
        table.add_row(way, f"{values.mean():.2f}", f"{kept.mean():.2f}", f"{kept.min():.2f}", f"{likeness[way]:.4f}")
    table.add_section()
    table.add_row("the frames fitted, by the model", f"{training:.2f}", "", "", "")
    console.print(table)


def _draw(path: Path, held_out, pictures, scores, whole) -> None:
    rival = "DIS warping, frames"
    gain = np.where(whole, scores[OURS] - scores[rival], 0)
    order = np.argsort(gain)
    shown = [*order[: SHOWN // 2], *order[-(SHOWN // 2) :]]
    for way, where in ((OURS, path), (rival, path.with_stem(f"{path.stem}-warped"))):
        captions = [f"frame {2 * k + 1}, {scores[way][k]:.1f} dB" for k in shown]
        write_image(
            where, make_comparison_sheet([held_out[k] for k in shown], [pictures[way][k] for k in shown], captions)
        )


def main(arguments: list[str] | None = None) -> None:
    options = _common.parse(_parser(), arguments)
    budget = {"steps": options.steps} if options.steps is not None else {"minutes": options.minutes or MINUTES}
    config = FitConfig(num_gaussians=options.gaussians, seed=options.seed, **budget | dict(options.set or ()))
    if options.cpu_time:
        set_num_threads(1)
    figures = {}
    for name in options.clip or CLIPS:
        path = sample_clip(name) if name in fit_clip.SAMPLES else Path(name)
        clip = read_video(path, frames=options.frames, size=options.size)
        if options.cost:
            figures |= measure_cost(clip, config, Path(name).stem, options.cpu_time)
        else:
            figures |= measure(clip, config, Path(name).stem, options.sheet, options.cpu_time, options.weight or [])
    setting = {"size": options.size, "gaussians": options.gaussians, "seed": options.seed} | budget
    _common.finish(
        options.json, figures, _common.describe_machine(), setting=setting | {"set": dict(options.set or ())}
    )


def _parser() -> argparse.ArgumentParser:
    parser = _common.parser(__doc__)
    parser.add_argument("--clip", action="append", help="a sample clip or a path; may be given again [bunny, bikes]")
    parser.add_argument("--size", type=_common.size, metavar="HxW", default=SIZE, help="[160x320]")
    parser.add_argument("--frames", type=fit_clip._frames, metavar="A:B", help="frames A <= i < B [all]")
    parser.add_argument("--gaussians", type=_common.whole, help="[chosen by the fit]")
    length = parser.add_mutually_exclusive_group()
    length.add_argument("--steps", type=_common.whole, help="how long, in steps")
    length.add_argument("--minutes", type=float, help=f"how long, in minutes [{MINUTES:g}]")
    parser.add_argument("--cpu-time", action="store_true", help="minutes of the processor, on one thread")
    parser.add_argument("--cost", action="store_true", help="fit all frames, with interpolated frames and without")
    parser.add_argument("--seed", type=int, default=0, help="[0]")
    parser.add_argument("--set", action="append", type=fit_clip._setting, metavar="NAME=VALUE", help="of FitConfig")
    parser.add_argument("--weight", type=float, action="append", metavar="W", help="may be given again")
    parser.add_argument("--sheet", type=Path, metavar="FILE", help="pictures of held-out frames go here (PNG)")
    return parser


if __name__ == "__main__":
    main()
