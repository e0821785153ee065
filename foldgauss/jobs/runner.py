"""Runs one fit: reads the frames, resumes, takes the steps, writes checkpoints and the model.

`run_fit` serves the command `foldgauss fit` and `fit_job`, which fits segments and many clips, here or on a worker.
"""

import dataclasses
import itertools
import json
import os
import time
import warnings
from collections.abc import Callable, Iterable
from contextlib import AbstractContextManager, nullcontext, suppress
from pathlib import Path
from typing import Any

import jax
import numpy as np

from foldgauss import __version__
from foldgauss._runtime.checks import require
from foldgauss.io import Clip, FrameIndex, read_indexed, save_video_model
from foldgauss.io._atomic import OutputError, atomic_path, lock_output, write_or_keep
from foldgauss.io.models.checkpoint import is_known_good, load_checkpoint, save_checkpoint
from foldgauss.io.models.compact import COMPACT_SUFFIX, leave_room, save_compact
from foldgauss.io.models.rendered_clip import is_model, place_in_clip, read_clip_or_model
from foldgauss.io.provenance import describe_reading, describe_source, fingerprint
from foldgauss.jobs.job import FitJob, file_digest, limit_range, read_record
from foldgauss.jobs.object_masks import find_masks
from foldgauss.video import Evaluation, FitConfig, FitDiverged, FitState, VideoModel, evaluate
from foldgauss.video.fitting.loop import FitInfo, finish, fit_steps
from foldgauss.video.layered import LayerPlan, plan_layers, stack
from foldgauss.video.motion.background_plate import Alignment

#: Seconds between two checkpoints of a running fit.
CHECKPOINT_SECONDS = 30.0
#: Seconds between two reports of its progress.
REPORT_SECONDS = 1.0
#: Seconds that a job waits for another one of the same target: a worker that is believed dead may be about to finish.
WAIT_SECONDS = 60.0
#: How many dB a model may be below the PSNR that was asked for without a warning.
TOLERATED_DB = 0.05
#: A warning tells of the hidden background that no frame shows, if its fraction is at least this.
LEAST_TOLD = 0.005
#: Number of clip shapes whose compiled programs are kept.
MAX_SHAPES = 8

#: Sees every step of a fit; returns True to stop it.
Observer = Callable[[FitState, FitInfo], bool | None]
#: Opens the observer of a fit of these frames, with these settings, from the state it resumes from, or None.
OpenObserver = Callable[[Clip, FitConfig, FitState | None], AbstractContextManager[Observer]]
#: Called with the error of a checkpoint that could not be written, and its step.
CheckpointError = Callable[[OSError, int], None]


class Stopped(Exception):
    """The fit was asked to stop; its checkpoint is written."""


# ------------------------------------------------------------------------------------------------------- one fit


@dataclasses.dataclass(frozen=True)
class Checkpoint:
    """The checkpoint file of a running fit: `config` and `source`, the frames' fingerprint, must not change."""

    path: Path
    config: FitConfig
    source: dict[str, Any]
    on_error: CheckpointError = lambda error, step: None

    def load(self) -> FitState | None:
        """The state of the file, None if there is none. Raises ValueError for one that is damaged or of another fit."""
        return load_checkpoint(self.path, config=self.config, source=self.source) if self.path.exists() else None

    def try_save(self, state: FitState) -> None:
        """Save the state; a full disk must not end the fit."""
        try:
            save_checkpoint(self.path, state, config=self.config, source=self.source)
        except OSError as error:
            self.on_error(error, state.step)


def run_fit(
    job: FitJob,
    observer: OpenObserver,
    *,
    resume: bool = True,
    measure: Callable[[VideoModel, np.ndarray], Evaluation] = evaluate,
    on_checkpoint_error: CheckpointError = lambda error, step: None,
) -> dict[str, Any]:
    """Fit the frames of a job, from its checkpoint if there is one, and write its model; returns the job's record.

    The record is described in `fit_job`. The checkpoint of the last step stays until the caller removes it.
    Without `resume` the first step removes an earlier one. The observer is opened once the frames are read; `measure`
    computes the scores.

    Raises `Stopped` if the observer stops the fit, `FitDiverged` as `fit_steps`, ValueError and OSError for frames that
    cannot be read or fitted, for outputs that cannot be written, and for a checkpoint that is damaged or of another
    fit.
    """
    require(
        Path(job.target).suffix.lower() != COMPACT_SUFFIX or job.config.is_compact,
        "config",
        expected=f"one of a compact model for {job.target}",
        got="others",
        cure="Give a quality, a size or a PSNR.",
    )
    if job.index is None:
        clip = read_clip_or_model(job.clip, frames=job.frames, size=job.size)
    else:
        clip = read_indexed(FrameIndex.load(job.index), *job.frames, size=job.size)
        clip = dataclasses.replace(clip, fps=job.fps or clip.fps)
    _limit_compiled(clip.frames.shape)
    span = {"frames": limit_range(job.frames, clip.num_declared)}
    about = describe_source(clip, job.config.seed) | span | describe_reading(clip) | job.metadata
    if is_model(job.clip):
        about |= place_in_clip(job.clip, clip, job.frames)
    models, compact, seconds, num_steps = {}, {}, 0.0, 0
    for number, plan in enumerate(_plan_layers(job, clip, (about["frames"] or (0,))[0] or 0)):
        own = clip.notes * (not number)
        part = dataclasses.replace(clip, frames=plan.frames, source=plan.name or clip.source, notes=own)
        checkpoint = Checkpoint(job.checkpoint_of(number), plan.config, fingerprint(part), on_checkpoint_error)
        state = checkpoint.load() if resume else None
        config = dataclasses.replace(plan.config, size_mb=leave_room(plan.config.size_mb, about))
        steps = fit_steps(plan.frames, config, state, cuts=plan.cuts)
        with observer(part, plan.config, state) as observe:
            if not (resume or number):  # an earlier fit could be resumed by mistake; it goes once a step is taken
                steps = itertools.chain([next(steps)], steps)
                job.remove_checkpoints()
            state, info = run_steps(steps, observe, checkpoint, job.checkpoint_seconds)
        models[plan.name], compact[plan.name] = finish(state, plan.frames, config, clip.fps)
        seconds, num_steps = seconds + state.seconds, num_steps + state.step
    model, quantized = models.get(""), compact.get("")
    if model is None:
        model, quantized = stack(models), compact
    scores = measure(model, clip.frames)
    about |= describe_fit(job.config, num_steps, seconds) | mean_scores(scores)

    def save(path: Path) -> Path:
        if path.suffix.lower() == COMPACT_SUFFIX:
            return save_compact(path, quantized, metadata=about)
        return save_video_model(path, model, metadata=about)

    _write_model(job, save)
    return {
        "asked": job.request,
        "num_frames": clip.num_frames,
        "size": list(clip.size),
        "fps": clip.fps,
        "num_gaussians": model.num_gaussians,
        "psnr": list(scores.psnr),
        "ssim": list(scores.ssim),
        **mean_scores(scores),
        "steps": num_steps,
        "seconds": round(seconds, 2),
        "stopped_by": info.stopped_by,
        "file_bytes": os.path.getsize(job.target),
        "file_digest": file_digest(job.target),
        "peak_bytes": peak_bytes(),
        "notes": list(clip.notes),
        "warnings": missed_psnr(job.config, scores.mean_psnr),
    }


def _plan_layers(job: FitJob, clip: Clip, first: int) -> list[LayerPlan]:
    """The layers of the clip, or the clip as the only one; `first`: the number that its first frame has.

    Warnings tell of what moves, of shots, and of how much of the background no frame shows.
    """
    if job.masks is None:
        return [LayerPlan("", clip.frames, job.config)]
    require(
        not clip.has_alpha,
        "masks",
        expected="a clip without alpha",
        got=repr(clip.source),
        cure="Its alpha cuts out the object.",
    )
    alignment = Alignment.from_frames(clip.frames)
    masks = find_masks(job, clip, first, alignment)
    if len(alignment.starts) > 1:
        starts = ", ".join(map(str, alignment.starts))
        warnings.warn(
            f"What is behind objects is found in each shot on its own. Shots begin at frames {starts}.",
            stacklevel=2,
        )
    plans = plan_layers(clip.frames, masks, job.config, shadows=job.shadows, alignment=alignment)
    if plans[-1].unknown >= LEAST_TOLD:
        warnings.warn(
            f"{plans[-1].unknown:.0%} of what is behind objects is shown by no frame: texture replaces it.",
            stacklevel=2,
        )
    return plans


def _write_model(job: FitJob, save: Callable[[Path], Path]) -> None:
    """Write the model; if that fails, the fit is kept by its checkpoint, or the model in the folder for such files."""
    if not job.checkpoint.exists():
        write_or_keep(Path(job.target), save)
        return
    try:
        save(Path(job.target))
    except OSError as error:
        text = f"The fit is kept in {job.checkpoint}: the same command writes the model."
        raise OutputError(f"{error} {text}") from error


def run_steps(
    steps: Iterable[tuple[FitState, FitInfo]],
    observe: Observer,
    checkpoint: Checkpoint,
    seconds: float | None = None,
) -> tuple[FitState, FitInfo]:
    """Take all steps of a fit and return the last. The state is saved every `seconds` seconds and at the end.

    Raises as `run_fit`.
    """
    saved = time.monotonic()
    try:
        for state, info in steps:
            stop = observe(state, info) and info.progress < 1
            # Rather at a step whose state is known to be good, for which the file is half as large.
            longest = (CHECKPOINT_SECONDS if seconds is None else seconds) * (1 if is_known_good(state) else 2)
            due = time.monotonic() - saved > longest
            if stop or due or info.progress >= 1:
                checkpoint.try_save(state)
                saved = time.monotonic()
            if stop:
                raise Stopped(f"stopped after step {info.step}")
    except FitDiverged as error:
        if error.state is not None:
            checkpoint.try_save(error.state)
        raise
    return state, info


def describe_fit(config: FitConfig, steps: int, seconds: float) -> dict[str, Any]:
    """Metadata of how a model was fitted: version, budgets and steps.

    A fit by `minutes` depends on the load of the machine: its metadata also hold the seconds of the clock.
    """
    budgets = {name: getattr(config, name) for name in ("steps", "minutes", "quality", "size_mb", "psnr")}
    about = {"version": __version__, "steps": steps}
    about["budget"] = {name: value for name, value in budgets.items() if value is not None}
    if config.minutes is not None:
        about |= {"fit_seconds": round(seconds, 2)}
    return about


def missed_psnr(config: FitConfig, psnr: float, cure: str = "--minutes or --steps, or more --gaussians") -> list[str]:
    """A warning that the model of a fit has a lower PSNR than asked for."""
    if config.psnr is None or psnr >= config.psnr - TOLERATED_DB:
        return []
    larger = "" if config.size_mb is None else ", or a larger --size-mb"
    larger += "" if config.quality is None else ", or a higher --quality"
    return [f"--psnr: expected {config.psnr:g} dB, got {psnr:.2f}. Give more {cure}{larger}."]


def mean_scores(scores: Evaluation) -> dict[str, float]:
    """The mean scores as files have them."""
    return {"mean_psnr": round(scores.mean_psnr, 3), "mean_ssim": round(scores.mean_ssim, 4)}


def _limit_compiled(shape: tuple[int, ...]) -> None:
    """Before a clip of a new shape, and after `MAX_SHAPES` others, discard what JAX has compiled, which it never does.

    It is some MiB for each number and size of frames.
    """
    if shape not in _SHAPES and len(_SHAPES) >= MAX_SHAPES:
        jax.clear_caches()
        _SHAPES.clear()
    _SHAPES.add(shape)


_SHAPES: set[tuple[int, ...]] = set()


# -------------------------------------------------------------------------------------------- one fit with a record


#: Receives the last step of a running job now and then, and returns whether to go on.
Report = Callable[[FitInfo], bool]


def _make_reporter(report: Report) -> Observer:
    """An observer that reports the progress of a job now and then."""
    reported = time.monotonic()

    def observe(state: FitState, info: FitInfo) -> bool:
        nonlocal reported
        if time.monotonic() - reported <= REPORT_SECONDS and info.step != 1 and info.progress < 1:
            return False
        reported = time.monotonic()
        return not report(info)

    return observe


def fit_job(job: FitJob, report: Report = lambda info: True) -> dict[str, Any]:
    """Run the job, or what is left of it; returns its record. A process runs one job at a time.

    The record: `asked` (the request), `num_frames`, `size`, `fps`, `num_gaussians`, `psnr` and `ssim` by frame,
    `mean_psnr`, `mean_ssim`, `steps`, `seconds` (spent fitting), `stopped_by`, `file_bytes`, `file_digest`,
    `peak_bytes` (of the process, so far), `notes` (of the clip) and `warnings`.

    Raises `Stopped` if `report` returns False; ValueError and OSError for a clip that cannot be read or fitted and
    outputs that cannot be written; `FitDiverged` as `fit_steps`.
    """
    if record := read_record(job):
        return record
    with lock_output(Path(job.target), own=(job.checkpoint, job.record), wait=WAIT_SECONDS):
        if record := read_record(job):  # the previous holder of the lock may have finished it
            return record
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            record = run_fit(job, lambda clip, config, state: nullcontext(_make_reporter(report)))
        texts = dict.fromkeys(" ".join(str(warning.message).split()) for warning in caught)
        record["warnings"] = [*texts, *record["warnings"]]
        with atomic_path(job.record) as temporary:
            temporary.write_text(json.dumps(record) + "\n")
        job.remove_checkpoints()
        return record


def peak_bytes() -> int | None:
    """The largest resident memory of this process so far; None where the system is not Linux."""
    # Not `resource.getrusage`, whose `ru_maxrss` is at least that of the process that started this one.
    with suppress(OSError, StopIteration), open("/proc/self/status", "rb") as status:
        return 1024 * next(int(line.split()[1]) for line in status if line.startswith(b"VmHWM:"))
    return None
