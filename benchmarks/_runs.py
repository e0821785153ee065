"""Long tables, run by run: what is finished is kept in a file, and the same command goes on after it."""

import dataclasses
import datetime
import json
import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks._common import console, describe_machine
from foldgauss._runtime.threads import num_threads
from foldgauss.io import Clip, save_video_model
from foldgauss.io._atomic import atomic_path
from foldgauss.video import FitConfig, FitResult, VideoModel, fit_steps, psnr, ssim
from foldgauss.video.fitting.loop import finish
from foldgauss.video.fitting.state import to_model

Run = dict[str, Any]


class Runs:
    """Finished runs by name, in `path` (None: nowhere). After each one the file is written anew and renamed into place.

    `setting` is what all runs have in common. Raises ValueError for a file of runs with another setting, or of no runs.
    """

    def __init__(self, path: Path | None, setting: dict[str, Any]):
        self.path = path
        self.setting = json.loads(json.dumps(setting))  # as it is read back: tuples are lists
        self.done: dict[str, Run] = {}
        if path is not None and path.exists():
            self.done = _read(path, self.setting)
            console.print(f"{path}: {len(self.done)} finished runs are taken over", style="dim", soft_wrap=True)

    def get(self, name: str, make: Callable[[], Run]) -> Run:
        """A finished run, or the one that `make` makes now."""
        if name not in self.done:
            made = make() | {"date": datetime.datetime.now(datetime.UTC).date().isoformat()}
            self.done[name] = made
            self.write()
            console.print(f"{name}: {told(made)}", style="dim", soft_wrap=True)
        return self.done[name]

    def write(self, **more: Any) -> None:
        """The file, with `more` beside the runs."""
        if self.path is not None:
            whole = {"setting": self.setting, "runs": self.done, "machine": describe_machine(), **more}
            with atomic_path(self.path) as temporary:
                temporary.write_text(json.dumps(whole, indent=2) + "\n")


def _read(path: Path, setting: dict[str, Any]) -> dict[str, Run]:
    try:
        found = json.loads(path.read_text())
        runs, kept = found["runs"], found["setting"]
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(f"--json: expected a file of finished runs, got {path}. Choose another name.") from error
    other = [name for name in {**kept, **setting} if kept.get(name) != setting.get(name)]
    if other:
        was = ", ".join(f"{name} {kept.get(name)} instead of {setting.get(name)}" for name in other)
        raise ValueError(f"--json: {path} holds runs with {was}. Choose another file, or the same options.")
    return runs


def told(run: Run) -> str:
    """A run in one line."""
    shown = {
        "psnr": "{:.2f} dB",
        "gaussians": "{:,} Gaussians",
        "steps": "{:,} steps",
        "seconds": "{:.0f} s",
        "killed": "killed: {}",
    }
    return ", ".join(form.format(run[name]) for name, form in shown.items() if name in run)


def scores(model: Any, frames: np.ndarray, *, with_ssim: bool = True) -> Run:
    """Mean PSNR, and SSIM, over all frames, of 8-bit pictures of anything that has `frames()`."""
    pairs = [(psnr(*pair), ssim(*pair) if with_ssim else 0.0) for pair in zip(frames, model.frames(), strict=True)]
    by_psnr, by_ssim = zip(*pairs, strict=True)
    return {"psnr": statistics.fmean(by_psnr), "worst_psnr": min(by_psnr)} | (
        {"ssim": statistics.fmean(by_ssim)} if with_ssim else {}
    )


def fitted(clip: Clip, config: FitConfig, *, with_ssim: bool = True, cpu_time: bool = False) -> tuple[VideoModel, Run]:
    """A fit, its quality, its size and its cost; `seconds` include initialization and motion.

    With `cpu_time`, seconds and the budget are processor time divided by the number of threads. This is the wall time
    on a quiet machine, so that fits beside other work are comparable.
    """
    clock = (lambda: time.process_time() / num_threads()) if cpu_time else time.perf_counter
    for state, info in fit_steps(clip.frames, config, clock=clock):
        last = info
    model = to_model(state, config, clip.frames.shape[1:3], clip.fps)
    run = scores(model, clip.frames, with_ssim=with_ssim)
    run |= {"gaussians": model.num_gaussians, "floats": model.num_parameters, "steps": last.step}
    run |= size_on_disk(model, clip)
    return model, run | {"frames_seen": last.step * config.batch_size, "seconds": last.seconds}


def fit_by_processor(frames: np.ndarray, config: FitConfig, fps: float) -> FitResult:
    """A fit whose minutes are those of the processor; its history is the last step."""
    for state, info in fit_steps(frames, config, clock=time.process_time):
        last = info
    model, quantized = finish(state, frames, config, fps)
    return FitResult(model, [last], quantized)


def size_on_disk(model: VideoModel, clip: Clip) -> Run:
    """Bytes of the float32 model file, and bits per pixel of the clip."""
    with tempfile.TemporaryDirectory() as folder:
        num_bytes = save_video_model(Path(folder) / "model.safetensors", model).stat().st_size
    return {"bytes": num_bytes, "bits_per_pixel": 8 * num_bytes / clip.frames[..., 0].size}


#: Steps that a pace is measured by, after some in which kernels are loaded.
TIMED, UNTIMED = 12, 4


def seconds_per_step(clip: Clip, config: FitConfig, num_gaussians: int) -> float:
    """The median of some steps with so many Gaussians, none of them born or dead."""
    still = {"num_gaussians": num_gaussians, "growth": None}
    timed = dataclasses.replace(config, steps=UNTIMED + TIMED, minutes=None, **still)
    seconds = [info.seconds for _, info in fit_steps(clip.frames, timed)]
    return statistics.median(np.diff(seconds[UNTIMED - 1 :]))


def scaled(count: float, size: tuple[int, int], full: tuple[int, int] = (640, 1280)) -> int:
    """A number of Gaussians given for frames of `full` size, in proportion to the pixels of frames of `size`."""
    return max(round(count * size[0] * size[1] / (full[0] * full[1])), 1)
