"""Stabilization: how much jitter of the camera is left in what `stabilize` renders.

    python -m benchmarks.stabilization [--json FILE] [--model FILE.safetensors ...] [--minutes M]

Without --model: *Bunny*, seen through a window of 240x480 that pans and shakes over its frames of 320x640, is fitted
for M minutes (1). Jitter is the root mean square of the camera's path after a Gaussian of 4 frames is subtracted, in
pixels: of its horizontal and vertical motion, and of its rotation at half the width. It is measured on 8-bit output by
Shi and Tomasi's corners and Lucas and Kanade's flow, of which `stabilize` uses neither.
"""

import itertools
from pathlib import Path

import cv2
import numpy as np
from scipy.ndimage import gaussian_filter1d

from benchmarks import _common
from benchmarks._common import console
from foldgauss.io import load_video_model, read_video
from foldgauss.io.datasets import sample_clip
from foldgauss.video import FitConfig, VideoModel, estimate_camera_path, fit, stabilize
from foldgauss.video.motion.stabilization import BORDERS

SIZE = (320, 640)
WINDOW = (240, 480)
#: Standard deviation of the shake, in pixels.
SHAKE = 6.0
#: Standard deviation of its rotation, in radians.
TURN = 0.01
#: Frames of the Gaussian that makes the shake continuous, as that of a hand.
HAND = 2.0
#: Pixels of the pan in each frame.
PAN = 0.8
#: Frames of the Gaussian whose result is the intended path.
INTENDED = 4.0


def shaken_bunny(seed: int = 0) -> np.ndarray:
    """Frames (num, 240, 480, 3) of *Bunny* seen through a window that pans and shakes."""
    frames = read_video(sample_clip("bunny"), size=SIZE).frames
    rng, (height, width) = np.random.default_rng(seed), WINDOW
    shake = gaussian_filter1d(rng.normal(size=(len(frames), 3)), HAND, axis=0, mode="wrap")
    shake *= [SHAKE, SHAKE, TURN] / shake.std(axis=0)
    seen = []
    for k, (frame, (*shift, turn)) in enumerate(zip(frames, shake, strict=True)):
        shift = shift + np.array([PAN * (k - len(frames) / 2), 0])
        center = np.array(SIZE[::-1]) / 2 + shift
        window = cv2.getRotationMatrix2D(tuple(map(float, center)), float(np.degrees(turn)), 1.0)
        window[:, 2] += np.array([width, height]) / 2 - center
        seen.append(
            cv2.warpAffine(frame, window, (width, height), flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
        )
    return np.stack(seen)


def measure_jitter(frames: list[np.ndarray]) -> float:
    """Root mean square of the camera's path without its slow part, in pixels."""
    height, width = frames[0].shape[:2]
    center, steps = np.array([width / 2, height / 2, 1.0]), []
    grays = [cv2.cvtColor(frame, cv2.COLOR_RGB2GRAY) for frame in frames]
    for one, other in itertools.pairwise(grays):
        points = cv2.goodFeaturesToTrack(one, 1500, 0.005, 5)
        there, found, _ = cv2.calcOpticalFlowPyrLK(one, other, points, None, winSize=(15, 15), maxLevel=4)
        back, returned, _ = cv2.calcOpticalFlowPyrLK(other, one, there, None, winSize=(15, 15), maxLevel=4)
        known = (found & returned).ravel().astype(bool) & (np.abs(points - back).reshape(-1, 2).max(1) < 0.3)
        step, _ = cv2.estimateAffinePartial2D(points[known], there[known], ransacReprojThreshold=1.0)
        steps.append([*(step @ center - center[:2]), np.arctan2(step[1, 0], step[0, 0]) * width / 2])
    path = np.cumsum(steps, axis=0)
    rest = path - gaussian_filter1d(path, INTENDED, axis=0, mode="nearest")
    ends = int(2 * INTENDED)
    return float(np.sqrt((rest[ends:-ends] ** 2).sum(1).mean()))


def measure(name: str, model: VideoModel) -> dict[str, float]:
    path = estimate_camera_path(model)
    videos = {"as fitted": model}
    for border in BORDERS:
        try:
            videos[f"smooth, {border}"] = stabilize(model, border=border, path=path)
        except ValueError as error:
            console.print(f"{name}, {border}: {error}")
    videos["fixed, fill"] = stabilize(model, fixed=True, border="fill", path=path)
    jitter = {how: measure_jitter(list(video.frames())) for how, video in videos.items()}
    rows = ((how, f"{value:.2f}", f"{jitter['as fitted'] / value:.1f}x") for how, value in jitter.items())
    _common.print_table(f"{name}: {model.num_frames} frames", ("camera", "jitter, px", "less by"), rows)
    return {f"{how}: jitter of {name}": value for how, value in jitter.items()}


def main(arguments: list[str] | None = None) -> None:
    parser = _common.parser(__doc__)
    parser.add_argument("--model", type=Path, nargs="+", metavar="FILE", help="models instead of the shaken Bunny")
    parser.add_argument("--minutes", type=_common.positive, default=1.0, metavar="M", help="of the fit [1]")
    options, figures = _common.parse(parser, arguments), {}
    if options.model:
        models = {path.stem: load_video_model(path) for path in options.model}
    else:
        models = {"bunny": fit(shaken_bunny(), FitConfig(minutes=options.minutes), fps=25.0).model}
    for name, model in models.items():
        figures |= measure(name, model)
    _common.finish(options.json, figures, setting={"minutes": options.minutes})


if __name__ == "__main__":
    main()
