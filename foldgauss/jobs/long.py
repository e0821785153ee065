"""A long clip, fitted in segments: the plan, one job each, and the joining of what they made."""

import dataclasses
import json
import os
import shutil
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from foldgauss._runtime.checks import invalid, is_integer, is_within
from foldgauss.io._atomic import OutputError, atomic_path
from foldgauss.io.media.frame_index import FrameIndex, index_video
from foldgauss.io.media.indexed_reader import read_indexed
from foldgauss.io.models.segmented import join_segments
from foldgauss.io.models.video_model import load_video_model
from foldgauss.jobs.fitting import FitJob, file_digest
from foldgauss.video.fitting.config import FitConfig
from foldgauss.video.models.metrics import psnr, ssim
from foldgauss.video.segmented.segmented_video import Segment, SegmentedVideo, plan_segments

#: Length of a segment, and frames that neighbours share, where nothing is said.
SEGMENT_SECONDS, OVERLAP = 10.0, 8
#: Frames on either side of an overlap that it is compared with.
BESIDE = 8
_PLAN, _INDEX = "plan.json", "index.npz"


@dataclasses.dataclass(frozen=True)
class LongFit:
    """A clip's plan: its `index`, the `spans` [first, stop) of its segments, and the `jobs` that fit them.

    Made by `plan_long_fit`; all its files are in `folder` until `join` has made one of them.
    """

    target: Path
    folder: Path
    index: FrameIndex
    spans: tuple[tuple[int, int], ...]
    jobs: tuple[FitJob, ...]
    noted: dict[str, Any]

    def join(
        self,
        records: Mapping[str, Mapping[str, Any]],
        *,
        on_frame: Callable[[], None] = lambda: None,
    ) -> "JoinedFit":
        """Write the segments as one model, once all jobs are done; `records` by name of the job.

        The frames that two segments share are scored as they are played. The same segments give the same bytes. The
        folder stays: see `tidy`. Raises as `join_segments`, and `OutputError` where a segment's file is not what its
        record tells of.
        """
        for job in self.jobs:
            if file_digest(job.target) != records[job.name]["file_digest"]:
                got = f"a changed {job.target!r}"
                cure = "Give the same command again, and it is fitted again."
                raise OutputError(str(invalid("path", expected=f"{job.name} as it was written", got=got, cure=cure)))
        sources = [(first, job.target) for (first, _), job in zip(self.spans, self.jobs, strict=True)]
        scores = [(records[job.name]["psnr"], records[job.name]["ssim"]) for job in self.jobs]
        psnr_of, ssim_of = (_joined(self.spans, kind) for kind in zip(*scores, strict=True))
        fades = [(b, stop) for (_, stop), (b, _) in zip(self.spans[:-1], self.spans[1:], strict=True) if b < stop]
        if fades:
            self._score(_video_of(sources), fades, psnr_of, ssim_of, on_frame)
        if len(sources) == 1:  # an ordinary model
            with atomic_path(self.target) as temporary:
                shutil.copyfile(sources[0][1], temporary)
            return JoinedFit(self.target, tuple(psnr_of.tolist()), tuple(ssim_of.tolist()), ())
        means = {"mean_psnr": round(float(psnr_of.mean()), 3), "mean_ssim": round(float(ssim_of.mean()), 4)}
        join_segments(self.target, sources, metadata=self.noted | means)
        return JoinedFit(self.target, tuple(psnr_of.tolist()), tuple(ssim_of.tolist()), tuple(fades))

    def _score(self, video: SegmentedVideo, fades, psnr_of, ssim_of, on_frame) -> None:
        times = video.frame_times.times()
        for first, stop in fades:
            clip = read_indexed(self.index, *self.index.span(first, stop), size=self.jobs[0].size)
            for k, picture in enumerate(video.frames(times[first:stop]), first):
                target = clip.over_black[k - first]
                psnr_of[k], ssim_of[k] = psnr(target, picture), ssim(target, picture)
                on_frame()

    def tidy(self) -> None:
        """Remove the folder and what this package wrote into it."""
        for job in self.jobs:
            for path in (Path(job.target), job.kept, job.record):
                path.unlink(missing_ok=True)
        for name in (_INDEX, _PLAN):
            (self.folder / name).unlink(missing_ok=True)
        for entry in self.folder.iterdir():
            if entry.name.startswith(
                (".segment-", f".{Path(_PLAN).stem}.", f".{Path(_INDEX).stem}.")
            ):  # of killed ones
                entry.unlink(missing_ok=True)
        try:
            self.folder.rmdir()
        except OSError:  # somebody else's files
            return


@dataclasses.dataclass(frozen=True)
class JoinedFit:
    """A container and its scores: `psnr` in dB and `ssim` of every frame as played, and the frames shared, `fades`."""

    path: Path
    psnr: tuple[float, ...]
    ssim: tuple[float, ...]
    fades: tuple[tuple[int, int], ...]

    @property
    def mean_psnr(self) -> float:
        return float(np.mean(self.psnr))

    @property
    def mean_ssim(self) -> float:
        return float(np.mean(self.ssim))

    @property
    def seam_drop(self) -> float | None:
        """By how many dB shared frames are worse than the `BESIDE` on either side, in the mean; None of none."""
        drops = seam_drops(np.asarray(self.psnr), self.fades)
        return float(drops.mean()) if len(drops) else None


def seam_drops(
    scores: Float[np.ndarray, " num_frames"], fades: Sequence[tuple[int, int]], beside: int = BESIDE
) -> Float[np.ndarray, " fades"]:
    """Of each overlap, the mean of `beside` frames on either side less its own."""
    drops = []
    for first, stop in fades:
        around = np.concatenate([scores[max(first - beside, 0) : first], scores[stop : stop + beside]])
        drops.append(around.mean() - scores[first:stop].mean())
    return np.array(drops)


def _video_of(sources: Sequence[tuple[int, str]]) -> SegmentedVideo:
    """The files as one video, before they are one file; a model or two are in memory at once."""
    segments = []
    for first, file in sources:
        load = partial(load_video_model, file)
        segments.append(dataclasses.replace(Segment.from_model(first, load()), load=load))
    return SegmentedVideo(segments)


def _joined(spans: Sequence[tuple[int, int]], scores: Sequence[Sequence[float]]) -> np.ndarray:
    """By frame of the whole clip; of shared ones, any."""
    whole_clip = np.zeros(spans[-1][1])
    for (first, stop), own in zip(spans, scores, strict=True):
        whole_clip[first:stop] = own
    return whole_clip


def segments_folder(target: str | os.PathLike) -> Path:
    """Where the parts of `target` are until they are joined."""
    target = Path(target)
    return target.with_name(f"{target.name}.segments")


def plan_long_fit(
    clip: str | os.PathLike,
    target: str | os.PathLike,
    config: FitConfig | None = None,
    *,
    size: tuple[int, int] | None = None,
    frames: tuple[int | None, int | None] | None = None,
    segment_seconds: float = SEGMENT_SECONDS,
    overlap: int = OVERLAP,
    checkpoint_seconds: float | None = None,
    on_frame: Callable[[], None] = lambda: None,
    anew: bool = False,
) -> LongFit:
    """Look through a clip once and plan its segments, or take up the plan that is there, unless `anew`.

    Segments are cut at scene changes near their length, `segment_seconds`, else they share `overlap` frames with the
    next. `config` is that of each segment; its `max_size_mb` is shared out by their frames. `clip`, `size` and
    `frames` as in `read_video`. Memory does not grow with the clip, but for some tens of bytes a frame.

    Raises ValueError for settings that are out of range, and where the folder holds a plan of others, or of another
    clip, or, `anew`, what is no part of a fit; `VideoError`, FileNotFoundError, `OutputError`.

    Example: `plan_long_fit("long.mp4", "long.safetensors").jobs`, for `run_here` or `run_on`.
    """
    config = FitConfig() if config is None else config
    if not is_within(segment_seconds, "(0, 1e9]"):
        raise invalid("segment_seconds", expected="a number of seconds > 0, at most 1e9", got=repr(segment_seconds))
    if not is_integer(overlap, 1):
        raise invalid("overlap", expected="a whole number of frames >= 1", got=repr(overlap))
    clip, target = Path(clip).absolute(), Path(target).absolute()
    folder = segments_folder(target)
    asked = {
        "config": dataclasses.asdict(config),
        "size": size,
        "frames": frames,
        "segment_seconds": float(segment_seconds),
        "overlap": overlap,
    }
    asked = json.loads(json.dumps(asked))
    if anew:
        _check_own(folder)
    plan = None if anew else _kept_plan(folder, asked)
    index = _kept_index(folder, plan, clip)
    if index is None:
        index = index_video(clip, frames=frames, on_frame=on_frame)
        if plan is not None and plan["digest"] != index.digest:
            cure = "Give that clip, or start anew with --overwrite."
            expected = f"the clip that was begun with, {plan['clip']!r}"
            raise invalid("clip", expected=expected, got=f"other frames in {str(clip)!r}", cure=cure)
    if plan is None or not _cover(plan["spans"], index.num_frames):
        length = max(round(segment_seconds * index.fps), 2)
        spans = plan_segments(index.num_frames, index.cuts, length=length, overlap=_overlap(overlap, length))
    else:
        spans = plan["spans"]
    if anew and folder.is_dir():
        shutil.rmtree(folder)  # not before the clip has turned out to be one
    _make(folder)
    index.save(folder / _INDEX)
    kept = {"clip": str(clip), "digest": index.digest, "stamp": _stamp(clip), "asked": asked, "spans": spans}
    with atomic_path(folder / _PLAN) as temporary:
        temporary.write_text(json.dumps(kept) + "\n")
    noted = {"clip": clip.name, "seed": config.seed, "frames": frames, "clip_digest": index.digest}
    begin = 0 if frames is None else frames[0] or 0
    each = _shared_out(config, spans)
    jobs = (_job(number, span, folder, clip, each[number], size, index, begin) for number, span in enumerate(spans))
    jobs = tuple(dataclasses.replace(job, checkpoint_seconds=checkpoint_seconds) for job in jobs)
    return LongFit(target, folder, index, tuple(spans), jobs, noted)


def _shared_out(config: FitConfig, spans: Sequence[tuple[int, int]]) -> list[FitConfig]:
    """The settings of each segment: of a file's size their frames' share, those counted twice that two fit."""
    if config.max_size_mb is None:
        return [config] * len(spans)
    lengths = [stop - first for first, stop in spans]
    return [dataclasses.replace(config, max_size_mb=config.max_size_mb * one / sum(lengths)) for one in lengths]


def _overlap(asked: int, length: int) -> int:
    """Fewer than a quarter of a short segment, so that no frame is in three."""
    return max(min(asked, length // 4), 1)


def _job(
    number: int,
    span: tuple[int, int],
    folder: Path,
    clip: Path,
    config: FitConfig,
    size: tuple[int, int] | None,
    index: FrameIndex,
    begin: int,
) -> FitJob:
    low, high = index.span(*span)  # as `read_video` counts, where damage left frames out
    return FitJob(
        name=f"segment {number}",
        clip=str(clip),
        target=str(folder / f"segment-{number:04d}.safetensors"),
        config=config,
        size=size,
        frames=span,
        index=str(folder / _INDEX),
        fps=index.fps,
        source={"digest": index.digest},
        noted={"clip": clip.name, "frames": [begin + low, begin + high]},
    )


def _check_own(folder: Path) -> None:
    """Raise ValueError for a folder in which there is more than parts of a fit."""
    if not folder.is_dir():
        return
    own = ("segment-", ".segment-", _PLAN, f".{Path(_PLAN).stem}.", _INDEX, f".{Path(_INDEX).stem}.")
    foreign = sorted(entry.name for entry in folder.iterdir() if not entry.name.startswith(own))
    if foreign:
        got = f"{foreign[0]!r} in it"
        raise invalid("target", expected=f"parts of a fit alone in {folder}", got=got, cure="Move it away.")


def _cover(spans: Sequence[tuple[int, int]], num_frames: int) -> bool:
    """Whether spans are those of a plan: nobody is to edit one."""
    if not spans or spans[0][0] != 0 or spans[-1][1] != num_frames:
        return False
    pairs, apart = pairwise(spans), zip(spans[:-2], spans[2:], strict=True)
    in_order = all(one[0] < other[0] <= one[1] < other[1] for one, other in pairs)
    return in_order and all(one[1] <= other[0] for one, other in apart)


def kept_seconds(target: str | os.PathLike) -> float | None:
    """The length of segments in the plan of a fit that was begun; None where there is none."""
    try:
        seconds = json.loads((segments_folder(target) / _PLAN).read_text())["asked"]["segment_seconds"]
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return None
    return seconds if is_within(seconds, "(0, 1e9]") else None


def _make(folder: Path) -> None:
    try:
        folder.mkdir(exist_ok=True)
    except OSError as error:
        raise OutputError(
            f"--out: cannot make the folder {folder} ({error.strerror}). Choose another place."
        ) from error


def _kept_plan(folder: Path, asked: dict[str, Any]) -> dict[str, Any] | None:
    """The plan that was begun, if it is for what is asked; None where there is none that can be read."""
    try:
        plan = json.loads((folder / _PLAN).read_text())
        before = plan["asked"]
        before.get("config", {}).get("seed")
        plan["digest"], plan["clip"]
        plan["spans"] = [(int(first), int(stop)) for first, stop in plan["spans"]]
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError):
        return None
    changed = sorted(name for name in asked if asked[name] != before.get(name))
    if changed:
        if changed == ["config"]:
            pairs = {name: (before["config"].get(name), value) for name, value in asked["config"].items()}
            told = {name: pair for name, pair in pairs.items() if pair[0] != pair[1]}
        else:
            told = {name: (before.get(name), asked[name]) for name in changed if name != "config"}
        raise invalid(
            "resume",
            expected=", ".join(f"{name}={pair[0]!r}" for name, pair in told.items()),
            got=", ".join(f"{name}={pair[1]!r}" for name, pair in told.items()),
            cure=f"What was begun is kept in {str(folder)!r}: give its options, or start anew with --overwrite.",
        )
    return plan


def _kept_index(folder: Path, plan: dict[str, Any] | None, clip: Path) -> FrameIndex | None:
    """The index of a clip that has not been touched since."""
    if plan is None or plan.get("stamp") != _stamp(clip) or plan.get("clip") != str(clip) or not clip.is_file():
        return None
    try:
        index = FrameIndex.load(folder / _INDEX)
    except (OSError, ValueError):
        return None
    return index if index.digest == plan["digest"] else None


def _stamp(clip: Path) -> list[int]:
    """What changes when a file is written again; of a folder it says little."""
    try:
        stat = clip.stat()
    except OSError:
        return []
    return [stat.st_size, stat.st_mtime_ns]
