"""Frames never seen: fit every second frame, draw those in between, and compare with what is usual.

    python -m benchmarks.interpolation [--json FILE] [--clip bunny|bikes|carphone|PATH ...] [--size HxW]
                                       [--frames A:B] [--gaussians N] [--steps N | --minutes M [--cpu-time]]
                                       [--seed S] [--set NAME=VALUE ...] [--cost] [--weight W ...]

Without options: *bunny* and *bikes* at 160x320, 5 minutes each, with as many Gaussians as the fit chooses. Frames 0, 2,
4, ... are fitted, and frames 1, 3, 5, ... drawn half way between the learned times of their neighbors, as `foldgauss
render` does (`interpolate_frames`) and by the Gaussians alone. Beside them, of the same neighbors:

- their mean, and their mean after warping each half way by OpenCV's DIS flow between the two;
- what the fit learns from between frames, `Motion.interpolate`;
- the first two again, of the model's own pictures of the neighbors: then all start from the same quality;
- with `--weight`, `interpolate_frames` with other weights of the prediction by optical flow, the same everywhere.

PSNR and SSIM of 8-bit pictures, means over the frames; "without cuts" leaves out frames between two shots, which
nothing can know. `--cost` instead fits all frames, with interpolated frames and without, and compares the PSNR at the
frames. With `--cpu-time` fits run on one thread and minutes count its processor time, so that other processes do
not affect the comparison.
"""

import itertools
import time
from pathlib import Path
from unittest import mock

import cv2
import numpy as np

from benchmarks import _common
from benchmarks._clips import clip_path
from benchmarks._runs import Clock, fit_by_clock, scores
from foldgauss._runtime.threads import set_num_threads
from foldgauss.io import Clip, read_video
from foldgauss.video import FitConfig, VideoModel, interpolate_frames, interpolated_times
from foldgauss.video.models.frame_times import is_cut
from foldgauss.video.models.metrics import psnr, ssim
from foldgauss.video.motion import slow_motion
from foldgauss.video.motion.optical_flow import Motion

CLIPS = ("bunny", "bikes")
SIZE = (160, 320)
MINUTES = 5.0


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


def measure_cost(clip: Clip, config: FitConfig, clock: Clock) -> dict[str, float]:
    """PSNR at the frames of a fit to all of them, with `config` and without interpolated frames."""
    plain = config.replace(**{"views.interpolation_fraction": 0.0})
    models = (fit_by_clock(clip.frames, chosen, clip.fps, clock).model for chosen in (config, plain))
    learned, alone = (scores(model, clip.frames)["psnr"] for model in models)
    return {"all frames, with interpolated ones": learned, "all frames, without": alone, "cost": alone - learned}


def interpolate_with_weight(model: VideoModel, times: np.ndarray, weight: float) -> list[np.ndarray]:
    """`interpolate_frames` with a weight of the prediction that does not depend on how much the frames differ."""
    with mock.patch.multiple(slow_motion, FLOW_WEIGHT=weight, HALVING_DIFFERENCE=np.inf):
        return list(interpolate_frames(model, times))


def measure(clip: Clip, config: FitConfig, clock: Clock, weights: list[float]) -> dict[str, float]:
    """Figures of one clip, which are also shown."""
    last = (len(clip.frames) - 1) // 2 * 2  # a fitted frame
    seen, held_out = np.ascontiguousarray(clip.frames[: last + 1 : 2]), clip.frames[1:last:2]
    model = fit_by_clock(seen, config, clip.fps / 2, clock).model
    times = np.asarray(model.frame_times.times())
    own, half_way = list(model.frames()), interpolated_times(times, 2)[1::2]
    whole = ~np.asarray(is_cut(times))
    ways = {"interpolate_frames": interpolate_frames(model, half_way), "Gaussians alone": model.frames(half_way)}
    ways |= {f"weight {weight:g}": interpolate_with_weight(model, half_way, weight) for weight in weights}
    for whose, frames in (("frames", seen), ("own pictures", own)):
        pairs = list(itertools.pairwise(frames))
        ways[f"blending, {whose}"] = itertools.starmap(mean_of_two, pairs)
        ways[f"DIS warping, {whose}"] = itertools.starmap(warped_half_way, pairs)
    ways["Motion.interpolate, frames"] = interpolated_half_way(seen)
    figures, rows = {"fitted frames": scores(model, seen)["psnr"]}, []
    for way, pictures in ways.items():
        each = np.array([(psnr(*pair), ssim(*pair)) for pair in zip(held_out, pictures, strict=True)])
        figures |= {way: each[:, 0].mean(), f"{way}, without cuts": each[whole, 0].mean()}
        figures |= {f"{way}, worst": each[whole, 0].min(), f"{way}, SSIM": each[:, 1].mean()}
        rows.append((way, *(f"{figures[way + what]:.4g}" for what in ("", ", without cuts", ", worst", ", SSIM"))))
    title = f"{len(seen)} frames of {clip.size[0]}x{clip.size[1]} fitted, at {figures['fitted frames']:.2f} dB"
    _common.print_table(title, ("held-out frames", "PSNR, dB", "without cuts", "worst", "SSIM"), rows)
    return figures


def main(arguments: list[str] | None = None) -> None:
    parser = _common.fit_parser(__doc__, MINUTES)
    parser.add_argument("--clip", action="append", help="a sample clip or a path; may be given again [bunny, bikes]")
    parser.add_argument("--size", type=_common.parse_size, metavar="HxW", default=SIZE, help="[160x320]")
    parser.add_argument("--cpu-time", action="store_true", help="minutes of the processor, on one thread")
    parser.add_argument("--cost", action="store_true", help="fit all frames, with interpolated frames and without")
    parser.add_argument("--set", action="append", type=_common.setting, default=[], metavar="NAME=VALUE", help="again")
    parser.add_argument("--weight", type=float, action="append", default=[], metavar="W", help="may be given again")
    options = _common.parse(parser, arguments)
    budget, changes = _common.budget(options), dict(options.set)
    config = FitConfig(num_gaussians=options.gaussians, seed=options.seed, **budget).replace(**changes)
    clock = time.process_time if options.cpu_time else time.perf_counter
    if options.cpu_time:
        set_num_threads(1)
    figures = {}
    for name in options.clip or CLIPS:
        clip = read_video(clip_path(name), frames=options.frames, size=options.size)
        own = measure_cost(clip, config, clock) if options.cost else measure(clip, config, clock, options.weight)
        figures |= {f"{Path(name).stem}, {what}": value for what, value in own.items()}
    setting = {"size": options.size, "gaussians": options.gaussians, "seed": options.seed, **budget, **changes}
    _common.finish(options.json, figures, setting=setting)


if __name__ == "__main__":
    main()
