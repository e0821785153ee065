"""Long tables, run by run: finished runs are kept in a file, and the same command continues after them."""

import datetime
import functools
import json
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks._common import console, describe_machine, finish
from foldgauss._runtime.threads import num_threads
from foldgauss.io import Clip, save_video_model
from foldgauss.io._atomic import atomic_path
from foldgauss.video import FitConfig, FitResult, VideoModel, evaluate, fit, fit_steps
from foldgauss.video.fitting.loop import finish as finish_fit

Run = dict[str, Any]
Clock = Callable[[], float]
#: Height and width of the frames of `warm_up`: large enough for all levels of resolution.
WARM_UP_SIZE = (128, 128)
#: Figures of a run that are printed when it is finished.
SHOWN = {"psnr": "{:.2f} dB", "gaussians": "{:,} Gaussians", "steps": "{:,} steps", "seconds": "{:.0f} s"}


class Runs:
    """Finished runs by name, in `path` (None: nowhere). After each one the file is written anew and renamed into place.

    `setting` is what all runs have in common. Raises SystemExit for a file of runs with another setting, or of no runs.
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
            self._write()
            shown = ", ".join(form.format(made[figure]) for figure, form in SHOWN.items() if figure in made)
            console.print(f"{name}: {shown}", style="dim", soft_wrap=True)
        return self.done[name]

    def finish(self, figures: dict[str, float], **more: Any) -> None:
        """Print the figures, and write them and `more` beside the runs."""
        finish(None, figures)
        self._write(figures=figures, **more)

    def _write(self, **more: Any) -> None:
        if self.path is not None:
            whole = {"setting": self.setting, "runs": self.done, "machine": describe_machine(), **more}
            with atomic_path(self.path) as temporary:
                temporary.write_text(json.dumps(whole, indent=2) + "\n")


def _read(path: Path, setting: dict[str, Any]) -> dict[str, Run]:
    try:
        found = json.loads(path.read_text())
        runs, kept = found["runs"], found["setting"]
    except (ValueError, KeyError, TypeError) as error:
        raise SystemExit(f"--json: expected a file of finished runs, got {path}. Choose another name.") from error
    other = [name for name in {**kept, **setting} if kept.get(name) != setting.get(name)]
    if other:
        was = ", ".join(f"{name} {kept.get(name)} instead of {setting.get(name)}" for name in other)
        raise SystemExit(f"--json: {path} holds runs with {was}. Choose another file, or the same options.")
    return runs


def scores(model: Any, frames: np.ndarray) -> Run:
    """PSNR, mean and worst, and mean SSIM of the 8-bit frames of any video."""
    found = evaluate(model, frames)
    return {"psnr": found.mean_psnr, "worst_psnr": min(found.psnr), "ssim": found.mean_ssim}


def fit_by_clock(frames: np.ndarray, config: FitConfig, fps: float, clock: Clock = time.process_time) -> FitResult:
    """A fit whose `minutes` are measured by `clock`; its history has the last step only."""
    for state, info in fit_steps(frames, config, clock=clock):
        last = info
    model, quantized = finish_fit(state, frames, config, fps)
    return FitResult(model, [last], quantized)


def fitted(clip: Clip, config: FitConfig, *, cpu_time: bool = False) -> tuple[VideoModel, Run]:
    """A fit, its quality, its size and its cost; `seconds` include initialization and motion.

    With `cpu_time`, seconds and the budget are processor time divided by the number of threads. This is the wall time
    on a quiet machine, so that fits beside other work are comparable.
    """
    clock = (lambda: time.process_time() / num_threads()) if cpu_time else time.perf_counter
    result = fit_by_clock(clip.frames, config, clip.fps, clock)
    model, last = result.model, result.history[-1]
    run = scores(model, clip.frames) | size_on_disk(model, clip)
    run |= {"gaussians": model.num_gaussians, "floats": model.num_parameters, "steps": last.step}
    return model, run | {"frames_seen": last.step * config.views.batch_size, "seconds": last.seconds}


@functools.cache
def warm_up(num_frames: int) -> None:
    """A fit that does not count: JAX compiles for each number of frames, in 0.7 s of CPU time of a first fit."""
    frames = np.random.default_rng(0).integers(0, 256, (num_frames, *WARM_UP_SIZE, 3), np.uint8)
    fit(frames, FitConfig(num_gaussians=100, steps=20))


def size_on_disk(model: VideoModel, clip: Clip) -> Run:
    """Bytes of the float32 model file, and bits per pixel of the clip."""
    with tempfile.TemporaryDirectory() as folder:
        num_bytes = save_video_model(Path(folder) / "model.safetensors", model).stat().st_size
    return {"bytes": num_bytes, "bits_per_pixel": 8 * num_bytes / clip.frames[..., 0].size}


def scaled(count: float, size: tuple[int, int], full: tuple[int, int] = (640, 1280)) -> int:
    """A number of Gaussians given for frames of `full` size, in proportion to the pixels of frames of `size`."""
    return max(round(count * size[0] * size[1] / (full[0] * full[1])), 1)
