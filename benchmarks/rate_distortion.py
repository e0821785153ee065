"""Rate and distortion: compact files beside video codecs.

    python -m benchmarks.rate_distortion --clips FOLDER [--only NAME ...] [--frames N] [--minutes M]
                                         [--qualities Q ...] [--sizes-mb S ...] [--json FILE] [--figure FILE]

The first N frames of the subfolders of FOLDER, folders of images each, at their own size. `foldgauss`: fits of M
minutes of one core with several qualities, and with several sizes of the file. Codecs: FFmpeg's encoders through PyAV
at several constant rate factors, tuned for PSNR, whole Matroska files. x264 and x265 store 4:4:4, as chroma subsampling
would limit their PSNR of RGB; SVT-AV1 has 4:2:0 only. Figures of quality are means over the decoded 8-bit frames:

- PSNR of RGB;
- PSNR of YUV, weighted 6:1:1, of BT.601 luma and of chroma averaged over 2x2 pixels, so that 4:2:0 costs nothing;
- MS-SSIM of luma (Wang, Simoncelli and Bovik 2003).

Seconds are of the processor, to encode (to fit) and to decode all frames (to render them).

BD-rate (Bjontegaard 2001, VCEG-M33): how many more bytes a coder takes at equal quality than x264 medium, by piecewise
cubic interpolation of log bytes. The range of quality is that of the compact files, as far as both coders cover it. It
is printed beside each figure. The figure is "none" if there is no common range.
With --json finished runs are kept, and the same command goes on after them.
"""

import argparse
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path
from typing import NamedTuple

import av
import cv2
import matplotlib.pyplot as plt
import numpy as np
from scipy.interpolate import PchipInterpolator
from skimage.color import rgb2ycbcr

from benchmarks import _common
from benchmarks._clips import ClipSource, folder_sources
from benchmarks._runs import Run, Runs, fit_by_clock
from foldgauss._runtime.threads import set_num_threads
from foldgauss.io import load_video_model, read_video, save_compact
from foldgauss.io.media.decoder import CONVERSION
from foldgauss.io.media.writing import open_with_own_priority
from foldgauss.video import FitConfig, psnr

NUM_FRAMES = 50
QUALITIES = (20.0, 35.0, 50.0, 65.0)
MINUTES = 3.0
OURS = "foldgauss"
REFERENCE = "x264 medium"
#: Weights of the five scales, finest first, and constants of SSIM for 8 bits: Wang, Simoncelli and Bovik 2003.
SCALE_WEIGHTS = (0.0448, 0.2856, 0.3001, 0.2363, 0.1333)
LUMINANCE_CONSTANT = (0.01 * 255) ** 2
CONTRAST_CONSTANT = (0.03 * 255) ** 2


class Codec(NamedTuple):
    """An encoder of FFmpeg, its pixel format, options, and constant rate factors."""

    encoder: str
    pixels: str
    options: dict[str, str]
    factors: tuple[int, ...]


X265 = {"tune": "psnr", "x265-params": "log-level=none"}
CODECS = {
    "x264 medium": Codec("libx264", "yuv444p", {"preset": "medium", "tune": "psnr"}, (12, 18, 24, 30, 36, 42, 48)),
    "x264 veryslow": Codec("libx264", "yuv444p", {"preset": "veryslow", "tune": "psnr"}, (12, 18, 24, 30, 36, 42, 48)),
    "x265 medium": Codec("libx265", "yuv444p", {"preset": "medium", **X265}, (12, 18, 24, 30, 36, 42, 48)),
    "SVT-AV1 6": Codec("libsvtav1", "yuv420p", {"preset": "6"}, (10, 20, 30, 40, 50, 60, 63)),
    "SVT-AV1 3": Codec("libsvtav1", "yuv420p", {"preset": "3"}, (10, 20, 30, 40, 50, 60, 63)),
}
#: Figures of quality, and how the table calls them.
MEASURES = {"psnr": "PSNR (dB)", "psnr_yuv": "YUV 6:1:1 (dB)", "ms_ssim": "MS-SSIM"}


def psnr_yuv(first: np.ndarray, second: np.ndarray) -> float:
    """(6 Y + U + V) / 8 of the PSNR of the planes, chroma at half of the size."""
    difference = rgb2ycbcr(first) - rgb2ycbcr(second)
    height, width = (length // 2 * 2 for length in difference.shape[:2])
    chroma = difference[:height, :width, 1:].reshape(height // 2, 2, width // 2, 2, 2).mean((1, 3))
    errors = np.array([np.square(difference[..., 0]).mean(), *np.square(chroma).mean((0, 1))])
    return float(np.average(10 * np.log10(255**2 / np.maximum(errors, 1e-10)), weights=(6, 1, 1)))


def ms_ssim(first: np.ndarray, second: np.ndarray) -> float:
    """Multi-scale structural similarity of luma."""
    x, y = (np.float32(rgb2ycbcr(image)[..., 0]) for image in (first, second))
    blur = lambda image: cv2.GaussianBlur(image, (11, 11), 1.5)  # noqa: E731
    product = 1.0
    for weight in SCALE_WEIGHTS:
        mean_x, mean_y = blur(x), blur(y)
        variances = blur(x * x) - mean_x**2 + blur(y * y) - mean_y**2
        covariance = blur(x * y) - mean_x * mean_y
        structure = (2 * covariance + CONTRAST_CONSTANT) / (variances + CONTRAST_CONSTANT)
        luminance = (2 * mean_x * mean_y + LUMINANCE_CONSTANT) / (mean_x**2 + mean_y**2 + LUMINANCE_CONSTANT)
        coarsest = weight is SCALE_WEIGHTS[-1]
        product *= max(float((structure * luminance if coarsest else structure).mean()), 0.0) ** weight
        x, y = (cv2.resize(image, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA) for image in (x, y))
    return product


def score(frames: np.ndarray, decoded: np.ndarray, num_bytes: int, encode: float, decode: float) -> Run:
    measures = {"psnr": psnr, "psnr_yuv": psnr_yuv, "ms_ssim": ms_ssim}
    pairs = list(zip(frames, decoded, strict=True))
    quality = {name: float(np.mean([measure(*pair) for pair in pairs])) for name, measure in measures.items()}
    size = {"bytes": num_bytes, "bits_per_pixel": 8 * num_bytes / frames[..., 0].size}
    return size | quality | {"encode_s": encode, "decode_s": decode}


def timed(task: Callable[[], object]) -> tuple[object, float]:
    begun = time.process_time()
    return task(), time.process_time() - begun


def run_codec(frames: np.ndarray, fps: float, codec: Codec, factor: int) -> Run:
    rate = Fraction(fps).limit_denominator(1000)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "clip.mkv"

        def encode() -> None:
            with av.open(str(path), "w") as container:
                stream = container.add_stream(codec.encoder, rate=rate, options={**codec.options, "crf": str(factor)})
                stream.height, stream.width, stream.pix_fmt = *frames.shape[1:3], codec.pixels
                open_with_own_priority(stream.codec_context)
                for number, frame in enumerate(frames):
                    given = av.VideoFrame.from_ndarray(frame, format="rgb24")
                    given = given.reformat(format=codec.pixels, interpolation=CONVERSION)
                    given.pts, given.time_base = number, 1 / rate
                    container.mux(stream.encode(given))
                container.mux(stream.encode())

        _, encode_s = timed(encode)
        clip, decode_s = timed(lambda: read_video(path))
        return score(frames, clip.frames, path.stat().st_size, encode_s, decode_s)


def run_foldgauss(frames: np.ndarray, fps: float, config: FitConfig) -> Run:
    with tempfile.TemporaryDirectory() as folder:

        def encode() -> Path:
            fitted = fit_by_clock(frames, config, fps)
            return save_compact(Path(folder) / "clip.fgz", fitted.quantized)

        path, encode_s = timed(encode)
        model = load_video_model(path)
        decoded, decode_s = timed(lambda: np.stack(list(model.frames())))
        run = score(frames, decoded, path.stat().st_size, encode_s, decode_s)
        return run | {"gaussians": model.num_gaussians, "minutes": config.minutes}


def bd_rate(
    reference: list[Run], other: list[Run], quality: str, within: list[Run]
) -> tuple[float, float, float] | None:
    """Relative difference of bytes at equal quality over the range of quality that all cover; None without one."""
    curves = []
    for runs in (reference, other):
        points = sorted((run[quality], np.log(run["bytes"])) for run in runs)
        values, log_bytes = np.array(points).T
        increasing = np.r_[True, np.diff(values) > 1e-6]
        curves.append((values[increasing], log_bytes[increasing]))
    limits = [run[quality] for run in within]
    low, high = max(min(limits), *(q[0] for q, _ in curves)), min(max(limits), *(q[-1] for q, _ in curves))
    if high <= low or any(len(q) < 2 for q, _ in curves):
        return None
    first, second = (PchipInterpolator(q, r).integrate(low, high) for q, r in curves)
    return float(np.expm1((second - first) / (high - low))), float(low), float(high)


def measure(source: ClipSource, runs: Runs, options: argparse.Namespace) -> dict[str, list[Run]]:
    clip = source.read()
    frames, by_coder = clip.frames, defaultdict(list)
    for name, codec in CODECS.items():
        for factor in codec.factors:
            run = lambda codec=codec, factor=factor: run_codec(frames, clip.fps, codec, factor)  # noqa: E731
            by_coder[name].append(runs.get(f"{source.name}, {name}, {factor}", run))
    aims = [("quality", value) for value in options.qualities] + [("size_mb", value) for value in options.sizes_mb]
    for aim, value in aims:
        config = FitConfig(**{aim: value}, minutes=options.minutes)
        run = lambda config=config: run_foldgauss(frames, clip.fps, config)  # noqa: E731
        by_coder[OURS].append(runs.get(f"{source.name}, {OURS}, {aim} {value:g}", run))
    return dict(by_coder)


def show(clip: str, by_coder: dict[str, list[Run]]) -> dict[str, dict[str, tuple[float, float, float] | None]]:
    """Print the runs of a clip and the BD-rates, which are returned by coder and quality."""
    columns = ("coder", "Gaussians", "bytes", "bits per pixel", *MEASURES.values(), "encode (s)", "decode (s)")
    forms = {"bytes": ",", "bits_per_pixel": ".3f", "psnr": ".2f", "psnr_yuv": ".2f", "ms_ssim": ".4f"}
    forms |= {"encode_s": ".1f", "decode_s": ".2f"}
    rows = (
        (name, run.get("gaussians", ""), *(format(run[figure], form) for figure, form in forms.items()))
        for name, made in by_coder.items()
        for run in made
    )
    _common.print_table(clip, columns, rows)
    base, ours = by_coder[REFERENCE], by_coder[OURS]
    names = [name for name in by_coder if name != REFERENCE]
    rates = {name: {q: bd_rate(base, by_coder[name], q, ours) for q in MEASURES} for name in names}
    shown = (
        (
            name,
            *("none" if rate is None else "{:+.0%} ({:.4g} to {:.4g})".format(*rate) for rate in by_quality.values()),
        )
        for name, by_quality in rates.items()
    )
    title = f"{clip}: BD-rate to {REFERENCE}, and its range of quality"
    _common.print_table(title, ("coder", *MEASURES.values()), shown)
    return rates


def draw(results: dict[str, dict[str, list[Run]]], path: Path) -> None:
    figure, axes = plt.subplots(1, len(results), figsize=(3.6 * len(results), 3.6), sharey=True, squeeze=False)
    for ax, (clip, by_coder) in zip(axes[0], results.items(), strict=True):
        for number, (name, made) in enumerate(by_coder.items()):
            points = sorted((run["bits_per_pixel"], run["psnr"]) for run in made)
            color, width = ("black", 2.5) if name == OURS else (f"C{number}", 1)
            sampling = "" if name == OURS else " 4:2:0" if CODECS[name].pixels == "yuv420p" else " 4:4:4"
            ax.plot(*zip(*points, strict=True), marker="o", ms=3, label=name + sampling, lw=width, color=color)
        ax.set(title=clip, xscale="log", xlabel="bits per pixel")
        ax.grid(alpha=0.3)
    axes[0, 0].set_ylabel("PSNR of RGB (dB)")
    axes[0, -1].legend(fontsize=7)
    figure.tight_layout()
    figure.savefig(path, dpi=150)
    plt.close(figure)


def main(arguments: list[str] | None = None) -> None:
    parser = _common.parser(__doc__)
    parser.add_argument("--clips", type=Path, metavar="FOLDER", required=True, help="its subfolders are the clips")
    parser.add_argument("--only", nargs="+", metavar="NAME", help="[all]")
    parser.add_argument("--frames", type=_common.whole, default=NUM_FRAMES, help=f"[{NUM_FRAMES}]")
    parser.add_argument("--qualities", type=float, nargs="*", default=QUALITIES, metavar="Q", help="[20 35 50 65]")
    parser.add_argument("--sizes-mb", type=float, nargs="*", default=(), metavar="S", help="[none]")
    parser.add_argument("--minutes", type=float, default=MINUTES, help=f"of the processor, for each fit [{MINUTES:g}]")
    parser.add_argument("--figure", type=Path, metavar="FILE", help="draw PSNR over bits per pixel")
    options = _common.parse(parser, arguments)
    sources = [one for one in folder_sources(options.clips) if options.only is None or one.name in options.only]
    sources = [one._replace(frames=options.frames) for one in sources]
    set_num_threads(1)
    runs = Runs(options.json, {"processor_minutes": options.minutes, "frames": options.frames})
    results = {one.name: measure(one, runs, options) for one in sources}
    rates = {clip: show(clip, by_coder) for clip, by_coder in results.items()}
    runs.finish({}, bd_rates=rates)
    if options.figure:
        draw(results, options.figure)


if __name__ == "__main__":
    main()
