"""Results as tables on the console, and as JSON."""

import json
from pathlib import Path
from typing import Any

from rich.table import Table

from foldgauss.cli.app.application import out
from foldgauss.cli.shared.clips import Video
from foldgauss.io._atomic import atomic_path
from foldgauss.video.models.metrics import Evaluation


def summarize_scores(model: Video, scores: Evaluation) -> dict[str, Any]:
    """Mean and lowest scores, and the model's size, as results show them."""
    return {
        "mean_psnr": round(scores.mean_psnr, 3),
        "mean_ssim": round(scores.mean_ssim, 4),
        "lowest_psnr": round(min(scores.psnr), 3),
        "num_frames": model.num_frames,
        "height": model.size[0],
        "width": model.size[1],
        "num_gaussians": model.num_gaussians,
        "degree": model.degree,
    }


_LABELS = {
    "mean_psnr": ("mean PSNR", "{:.2f} dB"),
    "mean_psnr_on_white": ("mean PSNR over white", "{:.2f} dB"),
    "mean_ssim": ("mean SSIM", "{:.4f}"),
    "lowest_psnr": ("lowest PSNR of a frame", "{:.2f} dB"),
    "num_frames": ("frames", "{:,}"),
    "height": ("height", "{:,} px"),
    "width": ("width", "{:,} px"),
    "num_gaussians": ("Gaussians", "{:,}"),
    "degree": ("degree of the folds", "{}"),
    "fit_seconds": ("fitting time", "{:.1f} s"),
    "wall_seconds": ("total time", "{:.1f} s"),
    "peak_mib": ("peak memory of a process", "{:,} MiB"),
    "num_segments": ("segments", "{:,}"),
    "seam_drop": ("PSNR lost where segments meet", "{:.2f} dB"),
    "steps": ("steps", "{:,}"),
    "stopped_by": ("stopped by", "{}"),
    "loss_db": ("loss", "{:.3f} dB"),
    "num_dropped": ("Gaussians removed", "{:,}"),
    "bytes_before": ("before", "{:,} bytes"),
    "file_bytes": ("model file", "{:,} bytes"),
    "frames_per_second": ("rendering speed", "{:.0f} frames per second"),
    "ratio": ("compression factor", "{:.2f}"),
    "bits_per_pixel": ("bits per pixel", "{:.3f}"),
}


def print_figures(title: str, figures: dict[str, Any]) -> None:
    table = Table(title=title, show_header=False)
    for name, value in figures.items():
        label, form = _LABELS[name]
        table.add_row(label, form.format(value))
    out.print(table)


def format_count(count: int, noun: str) -> str:
    """A count with its noun, as "1 frame" or "1,200 frames"."""
    return f"{count:,} {noun}{'' if count == 1 else 's'}"


def write_json(path: Path, figures: dict[str, Any]) -> None:
    with atomic_path(path) as temporary:
        temporary.write_text(json.dumps(figures, indent=2) + "\n")
