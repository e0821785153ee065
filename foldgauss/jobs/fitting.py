"""One fit as a job: it can be done anywhere, killed at any moment, and done again by another, with the same bits.

A job reads its frames, fits, keeps a checkpoint beside its target now and then, writes the model and last a record of
how it went. Whoever does it again takes up what is there.
"""

import dataclasses
import hashlib
import json
import os
import sys
import threading
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax

from foldgauss.io._atomic import OutputError, atomic_path
from foldgauss.io._lock import lock_output
from foldgauss.io.media.clip import Clip
from foldgauss.io.media.frame_index import FrameIndex
from foldgauss.io.media.indexed_reader import read_indexed
from foldgauss.io.media.video_reading import read_video
from foldgauss.io.models.checkpoint import load_checkpoint, save_checkpoint
from foldgauss.io.models.video_model import load_video_model, save_video_model
from foldgauss.io.provenance import describe_source, fingerprint
from foldgauss.video.fitting.config import FitConfig
from foldgauss.video.fitting.divergence import FitDiverged
from foldgauss.video.fitting.loop import FitInfo, FitState, fit_steps, to_model
from foldgauss.video.models.metrics import evaluate

#: A running job is kept on disk this often, and tells how far it is, in seconds.
CHECKPOINT_SECONDS, TELL_SECONDS = 30.0, 1.0
#: So long a job waits for one that has the same target: a worker that is taken for dead may be about to end.
WAIT_SECONDS = 60.0


#: Clips of so many shapes are fitted with what has been compiled for them at hand.
SHAPES = 8


class Stopped(Exception):
    """A job was asked to stop, and is kept."""


class Progress(NamedTuple):
    """How far a job is: `share` in [0, 1], running PSNR in dB, steps, seconds spent and left; as `FitInfo`."""

    name: str
    share: float
    psnr: float
    step: int
    num_gaussians: int
    seconds: float
    seconds_left: float


#: What a record says besides `asked` and the scores of each frame.
_TOLD = {"num_frames", "size", "fps", "num_gaussians", "mean_psnr", "mean_ssim", "steps", "seconds", "stopped_by"}
_TOLD |= {"file_bytes", "file_digest", "peak_bytes", "warnings"}

#: Is told how far a job is, and answers whether to go on.
Tell = Callable[[Progress], bool]


@dataclasses.dataclass(frozen=True)
class FitJob:
    """A fit of a clip, or of a span of one, with all that it depends on; small, and the same on every machine.

    `clip` and `target` are paths that every worker finds; `size` (height, width) of the frames or None; `frames` (A, B)
    of the clip or None. With `index`, the file of a `FrameIndex`, these are found by seeking, as `index.span` counts.
    `fps`: the model's rate, where it is not the clip's. `source`: what must be the same for what is there to be taken
    up. `noted`: what the model's file says besides.
    """

    name: str
    clip: str
    target: str
    config: FitConfig
    size: tuple[int, int] | None = None
    frames: tuple[int | None, int | None] | None = None
    index: str | None = None
    fps: float | None = None
    checkpoint_seconds: float | None = None
    folder: str | None = None
    source: dict[str, Any] = dataclasses.field(default_factory=dict)
    noted: dict[str, Any] = dataclasses.field(default_factory=dict)

    @property
    def asked(self) -> dict[str, Any]:
        """What a finished job is told by, as JSON has it."""
        size = None if self.size is None else list(self.size)
        frames = None if self.frames is None else list(self.frames)
        asked = {"config": dataclasses.asdict(self.config), "size": size, "frames": frames, "source": self.source}
        return json.loads(json.dumps(asked))

    @property
    def kept(self) -> Path:
        """The checkpoint."""
        return self._beside(".checkpoint")

    @property
    def record(self) -> Path:
        """What `fit_job` returned, as JSON."""
        return self._beside(".json")

    def _beside(self, ending: str) -> Path:
        target = Path(self.target)
        return Path(self.folder or target.parent) / f"{target.name}{ending}"


def fit_job(job: FitJob, tell: Tell | None = None) -> dict[str, Any]:
    """Do the job, or what is left of it; returns its record.

    The record: `asked`, `num_frames`, `size`, `fps`, `num_gaussians`, `psnr` and `ssim` by frame, `mean_psnr`,
    `mean_ssim`, `steps`, `seconds` (spent fitting), `stopped_by`, `file_bytes`, `file_digest`, `peak_bytes` (of the
    process, so far) and `warnings`.

    Raises `Stopped` where `tell` answers False; ValueError and OSError for a clip that cannot be read or fitted, and
    outputs that cannot be written, `FitDiverged` as `fit_steps` does.
    """
    if done := finished(job):
        return done
    with _only_one(job):
        if done := finished(job):  # by who had the lock
            return done
        return _fitted(job, (lambda progress: True) if tell is None else tell)


def finished(job: FitJob) -> dict[str, Any] | None:
    """The record of a job that is done: its model is there, of what it asks.

    Of a segment's it is looked at whether they are the same bytes: segments of one length are of one size.
    """
    try:
        record = json.loads(job.record.read_text())
        same = record["asked"] == job.asked and os.path.getsize(job.target) == record["file_bytes"]
        same = same and len(record["psnr"]) == len(record["ssim"]) == record["num_frames"] and record.keys() >= _TOLD
        same = same and (job.index is None or record["file_digest"] == file_digest(job.target))
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return None
    return record if same else None


def file_digest(path: str | os.PathLike) -> str:
    """blake2b of 16 bytes over a file, as a hexadecimal text."""
    with open(path, "rb") as file:
        return hashlib.file_digest(file, partial(hashlib.blake2b, digest_size=16)).hexdigest()


def begin(job: FitJob) -> None:
    """Note what a job asks where its record is to be. Not atomic: there may be thousands, and half of one is none."""
    job.record.write_text(json.dumps({"asked": job.asked}) + "\n")


def begun(job: FitJob) -> dict[str, Any] | None:
    """What was asked when a job of its target was begun, or done; None where nothing says so."""
    try:
        asked = json.loads(job.record.read_text())["asked"]
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return None
    return asked if isinstance(asked, dict) else None


@contextmanager
def _only_one(job: FitJob) -> Iterator[None]:
    """The lock of the target, for which a job waits a while."""
    until = time.monotonic() + WAIT_SECONDS
    while True:
        holder = lock_output(Path(job.target), own=(job.kept, job.record))
        try:
            holder.__enter__()
            break
        except OutputError as error:
            if not isinstance(error.__cause__, BlockingIOError) or time.monotonic() > until:
                raise
            time.sleep(0.5)
    try:
        yield
    finally:
        holder.__exit__(None, None, None)


class _Programs:
    """What JAX has compiled, which it never forgets: some MiB for each number and size of frames."""

    def __init__(self) -> None:
        self._shapes: set[tuple[int, ...]] = set()
        self._lock = threading.Lock()

    def make_room(self, shape: tuple[int, ...]) -> None:
        """For clips of another shape: where there have been `SHAPES`, all are forgotten."""
        with self._lock:
            if shape not in self._shapes and len(self._shapes) >= SHAPES:
                jax.clear_caches()
                self._shapes.clear()
            self._shapes.add(shape)


_PROGRAMS = _Programs()


def _fitted(job: FitJob, tell: Tell) -> dict[str, Any]:
    clip = _read(job)
    _PROGRAMS.make_room(clip.frames.shape)
    source = fingerprint(clip)
    with _CAPTURE.heard() as caught:
        state, info = _steps(job, clip, source, tell)
    model = to_model(state, job.config, clip.size, clip.fps)
    scores = evaluate(model, clip.frames)
    means = {"mean_psnr": round(scores.mean_psnr, 3), "mean_ssim": round(scores.mean_ssim, 4)}
    about = describe_source(clip, job.config.seed) | {"frames": job.frames} | job.noted | means
    save_video_model(job.target, model, metadata=about)
    record = {
        "asked": job.asked,
        "num_frames": clip.num_frames,
        "size": list(clip.size),
        "fps": clip.fps,
        "num_gaussians": model.num_gaussians,
        "psnr": [round(one, 4) for one in scores.psnr],
        "ssim": [round(one, 5) for one in scores.ssim],
        **means,
        "steps": info.step,
        "seconds": round(info.seconds, 2),
        "stopped_by": info.stopped_by,
        "file_bytes": os.path.getsize(job.target),
        "file_digest": file_digest(job.target),
        "peak_bytes": peak_bytes(),
        "warnings": [
            *(_of_clip(clip) if job.index is None else ()),
            *dict.fromkeys(caught),
            *_missed(job.config, scores.mean_psnr, info),
        ],
    }
    with atomic_path(job.record) as temporary:
        temporary.write_text(json.dumps(record) + "\n")
    job.kept.unlink(missing_ok=True)
    return record


def _missed(config: FitConfig, mean_psnr: float, info: FitInfo) -> list[str]:
    """What was asked for and not reached."""
    if config.economy is None or config.economy.psnr is None or info.stopped_by == "smallest_at_psnr":
        return []
    return [f"{config.economy.psnr:g} dB were not reached, got {mean_psnr:.2f} dB after {info.step:,} steps."]


class _WarningCapture:
    """Warnings by the thread that gives them: a worker may do two jobs at once, and `warnings` has one ear for all."""

    def __init__(self):
        self._lock, self._open, self._heard = threading.Lock(), ExitStack(), {}

    @contextmanager
    def heard(self) -> Iterator[list[str]]:
        """The texts of those that this thread gives in the block; others' are shown as ever."""
        number, texts = threading.get_ident(), []
        with self._lock:
            if not self._heard:
                self._open.enter_context(warnings.catch_warnings())
                warnings.simplefilter("always")
                warnings.showwarning = partial(self._take, warnings.showwarning)
            self._heard[number] = texts
        try:
            yield texts
        finally:
            with self._lock:
                del self._heard[number]
                if not self._heard:
                    self._open.close()

    def _take(self, show: Callable[..., Any], message: Warning | str, *where: Any, **more: Any) -> None:
        texts = self._heard.get(threading.get_ident())
        if texts is None:
            show(message, *where, **more)
        else:
            texts.append(" ".join(str(message).split()))


_CAPTURE = _WarningCapture()


def _read(job: FitJob) -> Clip:
    """The frames."""
    if job.index is None:
        return read_video(job.clip, frames=job.frames, size=job.size)
    index = FrameIndex.load(job.index)
    clip = read_indexed(index, *index.span(*job.frames), size=job.size)
    return clip if job.fps is None else dataclasses.replace(clip, fps=job.fps)


def _of_clip(clip: Clip) -> list[str]:
    lost = clip.num_declared - clip.num_frames
    told = [f"only {clip.num_frames} of {clip.num_declared} frames decode; those are used."] if lost > 0 else []
    return [*told, *clip.notes]


def _steps(job: FitJob, clip: Clip, source: dict[str, Any], tell: Tell) -> tuple[FitState, FitInfo]:
    """The last of the steps, from the checkpoint on, where there is one of this job."""

    def keep(state: FitState) -> None:
        with suppress(OSError):  # a full disk now is no reason to lose the fit
            save_checkpoint(job.kept, state, config=job.config, source=source)

    kept_at = told_at = time.monotonic()
    seconds = CHECKPOINT_SECONDS if job.checkpoint_seconds is None else job.checkpoint_seconds
    try:
        for state, info in fit_steps(clip.frames, job.config, _kept_state(job, source)):
            now, ends = time.monotonic(), info.progress >= 1
            if now - kept_at > seconds and not ends:
                keep(state)
                kept_at = time.monotonic()
            if now - told_at > TELL_SECONDS or info.step == 1 or ends:
                told_at = now
                told = Progress(
                    job.name, info.progress, info.psnr, info.step, info.num_gaussians, info.seconds, info.seconds_left
                )
                if not tell(told) and not ends:
                    keep(state)
                    raise Stopped(f"{job.name}: stopped after step {info.step}")
    except FitDiverged as error:
        if error.state is not None:
            keep(error.state)
        raise
    keep(state)  # what comes now takes its time, too
    return state, info


def _kept_state(job: FitJob, source: dict[str, Any]) -> FitState | None:
    """Where a job like this was left; None where there is nothing, or another's, or what cannot be read."""
    try:
        return load_checkpoint(job.kept, config=job.config, source=source)
    except (OSError, ValueError):
        return None


def model_of(job: FitJob):
    """The model that a finished job has written."""
    return load_video_model(job.target)


def peak_bytes() -> int | None:
    """The most memory that this process has had, where the system tells."""
    try:
        import resource
    except ImportError:  # Windows
        return None
    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return most if sys.platform == "darwin" else 1024 * most
