"""Quality against bytes: compact files beside video codecs and images.

    python -m benchmarks.codecs [--json FILE] [--clips FOLDER] [--minutes M] [--figure FILE]

The sample clips and the subfolders of FOLDER, 50 frames each, at 160x284 (carphone: 144x176). `foldgauss`: fits of M
minutes of one core with several numbers of Gaussians, compressed for at most 0.3 dB, and the same where no Gaussian
follows the camera. Codecs: FFmpeg's encoders
through PyAV, 4:2:0, at several constant rate factors, presets *medium* and *slow* (SVT-AV1: 6 and 3), all tuned for
PSNR, whole Matroska files. Images: one JPEG or WebP for each frame. PSNR and SSIM of the decoded RGB frames, means;
bits per pixel; seconds of processor time to encode (to fit and compress) and to decode all frames (to render them).

BD-rate (Bjontegaard 2001, VCEG-M33): how many more bytes a coder takes at equal PSNR than x264 medium, by piecewise
cubic interpolation of log bytes over the common range of PSNR; none where there is no common range. With --json
finished runs are kept, and the same command goes on after them.
"""

import argparse
import io
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path

import av
import matplotlib.pyplot as plt
import numpy as np
from PIL import Image
from scipy.interpolate import PchipInterpolator

from benchmarks import _common
from benchmarks._clips import ClipSource, folder_sources, sample_sources
from benchmarks._common import console
from benchmarks._runs import Run, Runs
from benchmarks.interpolation import fit_model
from foldgauss._runtime.threads import set_num_threads
from foldgauss.io import load_video_model, read_video, save_compact
from foldgauss.io.media.decoder import CONVERSION
from foldgauss.io.media.encoder import open_with_own_priority
from foldgauss.video import FitConfig, compress, psnr, ssim

NUM_FRAMES, SIZE = 50, (160, 284)
GAUSSIANS = (3_000, 12_000, 48_000)
#: Whether Gaussians follow the camera.
FITS = {"foldgauss": True, "foldgauss, camera not followed": False}
LOSS_DB, MINUTES, REFERENCE = 0.3, 1.0, "x264 medium"
#: Encoder, options, constant rate factors. SVT-AV1 is tuned for PSNR by default.
CODECS = {
    "x264 medium": ("libx264", {"preset": "medium", "tune": "psnr"}, (18, 24, 30, 36, 42)),
    "x264 slow": ("libx264", {"preset": "slow", "tune": "psnr"}, (18, 24, 30, 36, 42)),
    "x265 medium": (
        "libx265",
        {"preset": "medium", "tune": "psnr", "x265-params": "log-level=none"},
        (18, 24, 30, 36, 42),
    ),
    "x265 slow": ("libx265", {"preset": "slow", "tune": "psnr", "x265-params": "log-level=none"}, (18, 24, 30, 36, 42)),
    "SVT-AV1 6": ("libsvtav1", {"preset": "6"}, (16, 28, 40, 50, 60)),
    "SVT-AV1 3": ("libsvtav1", {"preset": "3"}, (16, 28, 40, 50, 60)),
}
IMAGES = {"JPEG": (5, 20, 50, 80, 95), "WebP": (5, 20, 50, 80, 95)}


def score(frames: np.ndarray, decoded: np.ndarray, num_bytes: int, encode: float, decode: float) -> Run:
    pairs = list(zip(frames, decoded, strict=True))
    return {
        "bytes": num_bytes,
        "bits_per_pixel": 8 * num_bytes / frames[..., 0].size,
        "psnr": float(np.mean([psnr(a, b) for a, b in pairs])),
        "ssim": float(np.mean([ssim(a, b) for a, b in pairs])),
        "encode_s": encode,
        "decode_s": decode,
    }


def timed(task: Callable[[], object]) -> tuple[object, float]:
    begun = time.process_time()
    return task(), time.process_time() - begun


def run_codec(frames: np.ndarray, fps: float, name: str, crf: int) -> Run:
    encoder, options, _ = CODECS[name]
    rate = Fraction(fps).limit_denominator(1000)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "clip.mkv"

        def encode() -> None:
            with av.open(str(path), "w") as container:
                stream = container.add_stream(encoder, rate=rate, options={**options, "crf": str(crf)})
                stream.height, stream.width, stream.pix_fmt = *frames.shape[1:3], "yuv420p"
                open_with_own_priority(stream.codec_context)
                for number, frame in enumerate(frames):
                    given = av.VideoFrame.from_ndarray(frame, format="rgb24")
                    given = given.reformat(format="yuv420p", interpolation=CONVERSION)
                    given.pts, given.time_base = number, 1 / rate
                    container.mux(stream.encode(given))
                container.mux(stream.encode())

        _, encode_s = timed(encode)
        clip, decode_s = timed(lambda: read_video(path))
        return score(frames, clip.frames, path.stat().st_size, encode_s, decode_s)


def run_images(frames: np.ndarray, name: str, quality: int) -> Run:
    def encode() -> list[bytes]:
        files = []
        for frame in frames:
            file = io.BytesIO()
            Image.fromarray(frame).save(file, name.upper(), quality=quality)
            files.append(file.getvalue())
        return files

    files, encode_s = timed(encode)
    read = lambda: np.stack([np.asarray(Image.open(io.BytesIO(file)).convert("RGB")) for file in files])  # noqa: E731
    decoded, decode_s = timed(read)
    return score(frames, decoded, sum(map(len, files)), encode_s, decode_s)


def run_foldgauss(frames: np.ndarray, fps: float, config: FitConfig) -> Run:
    with tempfile.TemporaryDirectory() as folder:

        def encode() -> Path:
            model = fit_model(frames, config, fps, cpu_time=True)
            made = compress(model, frames, max_loss_db=LOSS_DB)
            return save_compact(Path(folder) / "clip.fgz", made.quantized)

        path, encode_s = timed(encode)
        decoded, decode_s = timed(lambda: np.stack(list(load_video_model(path).frames())))
        return score(frames, decoded, path.stat().st_size, encode_s, decode_s)


def bd_rate(reference: list[Run], other: list[Run]) -> float | None:
    """Relative difference of bytes at equal PSNR; None without a common range."""
    curves = []
    for runs in (reference, other):
        points = sorted((run["psnr"], np.log(run["bytes"])) for run in runs)
        quality, log_bytes = np.array(points).T
        increasing = np.r_[True, np.diff(quality) > 1e-6]
        curves.append((quality[increasing], log_bytes[increasing]))
    low, high = max(q[0] for q, _ in curves), min(q[-1] for q, _ in curves)
    if high - low < 0.5 or any(len(q) < 2 for q, _ in curves):
        return None
    first, second = (PchipInterpolator(q, r).integrate(low, high) for q, r in curves)
    return float(np.expm1((second - first) / (high - low)))


def measure(source: ClipSource, runs: Runs, minutes: float) -> dict[str, list[Run]]:
    clip = source.read()
    frames, by_coder = clip.frames, defaultdict(list)
    for name, (_, _, factors) in CODECS.items():
        for crf in factors:
            key = f"{source.name}, {name}, {crf}"
            by_coder[name].append(runs.get(key, lambda n=name, c=crf: run_codec(frames, clip.fps, n, c)))
    for name, qualities in IMAGES.items():
        for quality in qualities:
            key = f"{source.name}, {name}, {quality}"
            by_coder[name].append(runs.get(key, lambda n=name, q=quality: run_images(frames, n, q)))
    for name, follow in FITS.items():
        for num in GAUSSIANS:
            config = FitConfig(num_gaussians=num, minutes=minutes, follow_camera=follow)
            key = f"{source.name}, {name}, {num}"
            by_coder[name].append(runs.get(key, lambda config=config: run_foldgauss(frames, clip.fps, config)))
    return dict(by_coder)


def draw(results: dict[str, dict[str, list[Run]]], path: Path) -> None:
    figure, axes = plt.subplots(1, len(results), figsize=(3.6 * len(results), 3.6), sharey=True, squeeze=False)
    for ax, (clip, by_coder) in zip(axes[0], results.items(), strict=True):
        for number, (name, made) in enumerate(by_coder.items()):
            points = sorted((run["bits_per_pixel"], run["psnr"]) for run in made)
            color, width = ("black", 2.5 if FITS[name] else 1) if name in FITS else (f"C{number}", 1)
            ax.plot(*zip(*points, strict=True), marker="o", ms=3, label=name, lw=width, color=color)
        ax.set(title=clip, xscale="log", xlabel="bits per pixel")
        ax.grid(alpha=0.3)
    axes[0, 0].set_ylabel("PSNR (dB)")
    axes[0, -1].legend(fontsize=7)
    figure.tight_layout()
    figure.savefig(path, dpi=150)
    plt.close(figure)


def main(arguments: list[str] | None = None) -> None:
    parser: argparse.ArgumentParser = _common.parser(__doc__)
    parser.add_argument("--clips", type=Path, metavar="FOLDER", help="a folder whose subfolders are further clips")
    parser.add_argument("--minutes", type=float, default=MINUTES, help=f"of the processor, for each fit [{MINUTES:g}]")
    parser.add_argument("--figure", type=Path, metavar="FILE", help="draw PSNR over bits per pixel")
    options = _common.parse(parser, arguments)
    sources = sample_sources(("bunny", "bikes", "carphone"))
    sources += folder_sources(options.clips) if options.clips else []
    sources = [one._replace(frames=NUM_FRAMES, size=None if one.name == "carphone" else SIZE) for one in sources]
    set_num_threads(1)
    runs = Runs(options.json, {"processor_minutes": options.minutes, "clips": [one.describe() for one in sources]})
    results = {one.name: measure(one, runs, options.minutes) for one in sources}
    bd_rates = {}
    for clip, by_coder in results.items():
        table = _common.table(
            f"{clip}",
            "coder",
            "bits per pixel",
            "PSNR (dB)",
            "SSIM",
            "encode (s)",
            "decode (s)",
            f"BD-rate to {REFERENCE}",
        )
        for name, made in by_coder.items():
            rate = bd_rate(by_coder[REFERENCE], made)
            bd_rates[f"{clip}, {name}"] = rate
            for number, run in enumerate(made):
                shown = "" if number else ("none" if rate is None else f"{100 * rate:+.0f}%")
                numbers = (f"{run['bits_per_pixel']:.3f}", f"{run['psnr']:.2f}", f"{run['ssim']:.3f}")
                table.add_row(name, *numbers, f"{run['encode_s']:.2f}", f"{run['decode_s']:.2f}", shown)
        console.print(table)
    runs.write(bd_rates=bd_rates)
    if options.figure:
        draw(results, options.figure)


if __name__ == "__main__":
    main()
