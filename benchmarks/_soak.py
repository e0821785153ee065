"""Half an hour of work in one process, and what its memory does meanwhile."""

import contextlib
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy import stats

from foldgauss.io import Clip, write_video
from foldgauss.io.datasets import bunny
from foldgauss.io.models.checkpoint import load_checkpoint, save_checkpoint
from foldgauss.io.models.video_model import load_video_model, save_video_model
from foldgauss.video import FitConfig, evaluate
from foldgauss.video.fitting.loop import fit_steps, to_model

FRAMES = (0, 16)
SIZE = (80, 160)
#: Gaussians of all fits.
GAUSSIANS = 3000
#: Steps of each short fit.
STEPS = 240
#: Seconds of the long fit in each cycle.
LONG = 12.0
#: Seconds between two looks at the memory.
LOOK = 2.0
#: Of the soak, its beginning: what is compiled and cached in the first cycles is no growth.
WARM_UP = 0.25
MIB = 2**20


class Sample(NamedTuple):
    """Seconds since the start; resident set and, of it, what is in no file, in bytes."""

    seconds: float
    resident: int
    anonymous: int


def memory() -> tuple[int, int]:
    """Resident set of this process and its anonymous part, in bytes. Linux alone tells."""
    fields = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines())
    return tuple(1024 * int(fields[name].split()[0]) for name in ("VmRSS", "RssAnon"))


@contextlib.contextmanager
def sampling(every: float = LOOK) -> Iterator[list[Sample]]:
    """A list that grows by a sample every so many seconds, as long as the block lasts."""
    samples, over, begun = [], threading.Event(), time.monotonic()

    def look() -> None:
        while not over.wait(every):
            samples.append(Sample(time.monotonic() - begun, *memory()))

    thread = threading.Thread(target=look, daemon=True)
    thread.start()
    try:
        yield samples
    finally:
        over.set()
        thread.join()


def soak(minutes: float, folder: Path, tell: Callable[[str], None] = print) -> list[tuple[float, float]]:
    """Seconds at which each cycle began and ended. A cycle is some steps of a fit that lasts throughout, kept and read
    back, and a short fit of its own, kept, resumed, saved, loaded, evaluated and rendered.
    """
    clip, begun, cycles = bunny(frames=FRAMES, size=SIZE), time.monotonic(), []
    config = FitConfig(num_gaussians=GAUSSIANS, steps=10**6)
    lasting = fit_steps(clip.frames, config)
    while time.monotonic() - begun < 60 * minutes:
        first = time.monotonic() - begun
        until = time.monotonic() + LONG
        for state, info in lasting:
            if time.monotonic() > until:
                break
        save_checkpoint(folder / "long.checkpoint", state, config=config, source={})
        load_checkpoint(folder / "long.checkpoint", config=config, source={})
        number = len(cycles)
        shown = _short(clip, _kind(number), folder)
        cycles.append((first, time.monotonic() - begun))
        tell(f"cycle {number}: {cycles[-1][1]:.0f} s, long fit at step {info.step}, {shown}")
    return cycles


def _kind(number: int) -> FitConfig:
    """Plain and growing fits in turn, each with a seed of its own."""
    if number % 2:
        growing = {"num_gaussians": 1000, "max_gaussians": GAUSSIANS, "degree": 3}
        return FitConfig.preset("paper", **growing, steps=STEPS, seed=number)
    return FitConfig(num_gaussians=GAUSSIANS, steps=STEPS, seed=number)


def _short(clip: Clip, config: FitConfig, folder: Path) -> str:
    """A fit that is stopped in its middle and goes on from its checkpoint; what comes out is used."""
    kept, path, state = folder / "short.checkpoint", folder / "short.safetensors", None
    for state, info in fit_steps(clip.frames, config):
        if info.step == STEPS // 2:
            break
    save_checkpoint(kept, state, config=config, source={})
    for state, info in fit_steps(clip.frames, config, load_checkpoint(kept, config=config, source={})):
        pass
    save_video_model(path, to_model(state, config, clip.size, clip.fps))
    model = load_video_model(path)
    scores = evaluate(model, clip.frames)
    write_video(folder / "short.mp4", model.frames(), clip.fps)
    return f"short one {info.num_gaussians:,} Gaussians, {scores.mean_psnr:.2f} dB"


def by_cycle(samples: list[Sample], cycles: list[tuple[float, float]], field: str) -> list[tuple[float, float]]:
    """(hours, MiB), the mean of each cycle: within one the memory goes up and down, by what is being done."""
    means = []
    for first, last in cycles:
        own = [getattr(sample, field) for sample in samples if first <= sample.seconds < last]
        if own:
            means.append(((first + last) / 2 / 3600, float(np.mean(own)) / MIB))
    return means


def trend(points: list[tuple[float, float]]) -> tuple[float, float, float]:
    """MiB an hour of a line through `points` (hours, MiB) after the warm-up, its standard error, and the mean MiB."""
    hours, mib = np.array([point for point in points if point[0] >= WARM_UP * points[-1][0]]).T
    line = stats.linregress(hours, mib)
    return line.slope, line.stderr, mib.mean()
