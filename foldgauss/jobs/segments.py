"""Fits long clips in segments: the plan, one job per segment, and the joined model."""

import dataclasses
import json
import os
import shutil
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from foldgauss._runtime.checks import is_integer, is_within, require
from foldgauss._runtime.settings import check_unchanged, flatten
from foldgauss.io import FrameIndex, index_video, join_segments, read_indexed
from foldgauss.io._atomic import OutputError, atomic_path
from foldgauss.io.models.rendered_clip import is_model
from foldgauss.io.models.video_model import MODEL_SUFFIX, keep_origin, load_video_model, read_metadata
from foldgauss.io.provenance import describe_reading
from foldgauss.jobs.job import FitJob, file_digest, limit_range, stamp_clip
from foldgauss.jobs.runner import describe_fit, mean_scores
from foldgauss.video import Evaluation, FitConfig, Segment, SegmentedVideo, plan_segments, psnr, ssim

#: Default length of a segment.
SEGMENT_SECONDS = 10.0
#: Number of frames that neighboring segments share.
OVERLAP = 8
#: What a joined file has of each segment beside its own file, in 10^6 bytes, at most: its properties and metadata.
_MB_PER_SEGMENT = 0.004
_PLAN = "plan.json"
_INDEX = "index.npz"
#: How the names of files of a fit in the folder begin, of unfinished ones with a dot.
_OWN = ("segment-", _PLAN, _INDEX, ".segment-", f".{Path(_PLAN).stem}.", f".{Path(_INDEX).stem}.")


@dataclasses.dataclass(frozen=True)
class LongFit:
    """The plan of a clip: its `index`, the `spans` [first, stop) of its segments, and the `jobs` that fit them.

    Made by `plan_long_fit`. Its files are in `folder`; `join` makes one model of them.
    """

    target: Path
    folder: Path
    index: FrameIndex
    spans: tuple[tuple[int, int], ...]
    jobs: tuple[FitJob, ...]
    metadata: dict[str, Any]

    def join(
        self,
        records: Mapping[str, Mapping[str, Any]],
        *,
        on_frame: Callable[[], None] = lambda: None,
    ) -> Evaluation:
        """Write the segments as one model, once all jobs are finished, and return its scores; `records`: by job.

        Frames that two segments share are scored as they are played. Equal segments give equal bytes. The folder
        stays, see `clean_up`. Raises as `join_segments`, and `OutputError` if a segment's file is not as recorded.
        """
        for job in self.jobs:
            if file_digest(job.target) != records[job.name]["file_digest"]:
                text = f"path: expected {job.name} as it was written, got a changed {job.target!r}."
                raise OutputError(f"{text} Run the same command again to fit it again.")
        sources = [(first, job.target) for (first, _), job in zip(self.spans, self.jobs, strict=True)]
        scores = np.zeros((2, self.spans[-1][1]))  # shared frames take those of the later segment
        for (first, stop), job in zip(self.spans, self.jobs, strict=True):
            scores[:, first:stop] = records[job.name]["psnr"], records[job.name]["ssim"]
        fades = [(first, stop) for (_, stop), (first, _) in pairwise(self.spans) if first < stop]
        if fades:
            self._score_fades(sources, fades, scores, on_frame)
        joined = Evaluation(*map(tuple, scores.tolist()))
        if len(sources) == 1:  # an ordinary model
            with atomic_path(self.target) as temporary:
                shutil.copyfile(sources[0][1], temporary)
            return joined
        each = [read_metadata(job.target) for job in self.jobs]
        summed = [name for name in ("steps", "fit_seconds") if name in each[0]]
        about = keep_origin(each[0], "version") | {name: sum(one[name] for one in each) for name in summed}
        join_segments(self.target, sources, metadata=self.metadata | mean_scores(joined) | about)
        return joined

    def _score_fades(self, sources, fades, scores, on_frame) -> None:
        """Replace the scores of shared frames by those of the joined video, which loads its segments on demand."""
        segments = []
        for first, file in sources:
            load = partial(load_video_model, file)
            segments.append(dataclasses.replace(Segment.from_model(first, load()), load=load))
        video = SegmentedVideo(segments)
        times = video.frame_times.times()
        for first, stop in fades:
            clip = read_indexed(self.index, first, stop, size=self.jobs[0].size)
            for k, image in enumerate(video.frames(times[first:stop]), first):
                target = clip.over_black[k - first]
                scores[:, k] = psnr(target, image), ssim(target, image)
                on_frame()

    def clean_up(self) -> None:
        """Remove this fit's files, and the folder if nothing else is in it."""
        for entry in list(self.folder.iterdir()):
            if entry.name.startswith(_OWN):
                entry.unlink()
        with suppress(OSError):  # files of others
            self.folder.rmdir()


def has_plan(target: str | os.PathLike) -> bool:
    """Whether a fit of `target` in segments is unfinished."""
    return (segments_folder(target) / _PLAN).exists()


def segments_folder(target: str | os.PathLike) -> Path:
    """The folder of the segments of `target` until they are joined."""
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
    masks: str | None = None,
    shadows: bool = False,
    restart: bool = False,
) -> LongFit:
    """Index a clip and plan its segments, or continue the plan that exists, unless `restart`.

    Segments end at scene cuts near their length, `segment_seconds`; otherwise they share `overlap` frames with the
    next. Each segment has the settings `config`, and a part of `size_mb` in proportion to its frames. `clip`, `size`
    and `frames` as in `read_video`, `masks` and `shadows` as of `FitJob`. Memory grows with the clip by some tens of
    bytes per frame only.

    Raises ValueError for settings out of range, for a folder with the plan of other settings or another clip, and with
    `restart` for one with other files; `VideoError`, FileNotFoundError, `OutputError`.

    Example: `plan_long_fit("long.mp4", "long.safetensors").jobs`, for `run_here` or `run_on`.
    """
    config = FitConfig() if config is None else config
    require(
        not is_model(clip),
        "segment_seconds",
        expected="a clip for segments",
        got=f"the model {str(clip)!r}",
        cure="Fit it in one piece, or render it first: foldgauss render.",
    )
    require(
        is_within(segment_seconds, "(0, 1e9]"),
        "segment_seconds",
        expected="a number of seconds > 0, at most 1e9",
        got=repr(segment_seconds),
    )
    require(is_integer(overlap, 1), "overlap", expected="a whole number of frames >= 1", got=repr(overlap))
    clip, target = Path(clip).absolute(), Path(target).absolute()
    folder = segments_folder(target)
    request = flatten(dataclasses.asdict(config)) | {"size": size, "frames": frames, "masks": masks, "shadows": shadows}
    request = json.loads(json.dumps(request | {"segment_seconds": float(segment_seconds), "overlap": overlap}))
    if restart:
        _check_folder(folder)
    plan = None if restart else _load_plan(folder, request)
    index = _load_index(folder, plan, clip)
    if index is None:
        index = index_video(clip, frames=frames)
        require(
            plan is None or plan["digest"] == index.digest,
            "clip",
            expected=f"the clip that the fit was started with, {(plan or {}).get('clip')!r}",
            got=f"other frames in {str(clip)!r}",
            cure="Use that clip, or start over with --overwrite.",
        )
    length = max(round(segment_seconds * index.fps), 2)
    overlap = max(min(overlap, length // 4), 1)  # so that no frame is in three
    spans = plan_segments(index.num_frames, index.cuts, length=length, overlap=overlap)
    frames = limit_range(frames, index.num_declared)
    metadata = {"clip": clip.name, "seed": config.seed, "frames": frames, "clip_digest": index.digest}
    metadata |= describe_reading(index) | keep_origin(describe_fit(config, 0, 0.0), "budget")
    configs = _divide_size(config, spans, metadata)
    if restart and folder.is_dir():
        shutil.rmtree(folder)  # only once the clip has been read
    try:
        folder.mkdir(exist_ok=True)
    except OSError as error:
        text = f"--out: cannot make the folder {folder} ({error.strerror}). Choose another place."
        raise OutputError(text) from error
    index.save(folder / _INDEX)
    kept = {"clip": str(clip), "digest": index.digest, "stamp": stamp_clip(clip), "asked": request}
    with atomic_path(folder / _PLAN) as temporary:
        temporary.write_text(json.dumps(kept) + "\n")
    begin = 0 if frames is None else frames[0] or 0
    jobs = tuple(
        FitJob(
            name=f"segment {number}",
            clip=str(clip),
            target=str(folder / f"segment-{number:04d}{target.suffix or MODEL_SUFFIX}"),
            config=own,
            size=size,
            frames=span,
            index=str(folder / _INDEX),
            fps=index.fps,
            checkpoint_seconds=checkpoint_seconds,
            source={"digest": index.digest},
            metadata={"clip": clip.name, "frames": [begin + span[0], begin + span[1]]},
            masks=masks,
            shadows=shadows,
        )
        for number, (span, own) in enumerate(zip(spans, configs, strict=True))
    )
    return LongFit(target, folder, index, tuple(spans), jobs, metadata)


def _divide_size(config: FitConfig, spans: Sequence[tuple[int, int]], metadata: Mapping[str, Any]) -> list[FitConfig]:
    """The configuration of each segment: `size_mb` in proportion to its frames; shared frames count twice.

    Room is left for the `metadata` of the clip and of its segments, which may have a number for each frame.
    """
    if config.size_mb is None:
        return [config] * len(spans)
    lengths = [stop - first for first, stop in spans]
    beside = _MB_PER_SEGMENT * len(spans) + 2.5e-6 * len(json.dumps(metadata))
    size_mb = config.size_mb - beside * (len(spans) > 1)
    require(size_mb > 0, "size_mb", expected=f"more than {beside:.4f} for {len(spans)} segments", got=config.size_mb)
    return [dataclasses.replace(config, size_mb=size_mb * one / sum(lengths)) for one in lengths]


def _check_folder(folder: Path) -> None:
    """Raise ValueError for a folder with files other than those of a fit."""
    names = sorted(entry.name for entry in folder.iterdir()) if folder.is_dir() else []
    foreign = [name for name in names if not name.startswith(_OWN)]
    require(
        not foreign,
        "target",
        expected=f"only files of a fit in {folder}",
        got=f"{', '.join(map(repr, foreign[:1]))} in it",
        cure="Move it away.",
    )


def _load_plan(folder: Path, request: dict[str, Any]) -> dict[str, Any] | None:
    """The plan in the folder; None if it cannot be read. Raises ValueError if it is that of another request."""
    try:
        plan = json.loads((folder / _PLAN).read_text())
        before = {**plan["asked"]}
        plan["digest"], plan["clip"]
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError):
        return None
    cure = f"An unfinished fit is in {str(folder)!r}: give its options, or start over with --overwrite."
    check_unchanged("overwrite", before, request, cure)
    return plan


def _load_index(folder: Path, plan: dict[str, Any] | None, clip: Path) -> FrameIndex | None:
    """The saved index, if the clip has not changed since."""
    if plan is None or plan.get("stamp") != stamp_clip(clip) or plan.get("clip") != str(clip) or not clip.is_file():
        return None
    try:
        index = FrameIndex.load(folder / _INDEX)
    except (OSError, ValueError):
        return None
    return index if index.digest == plan["digest"] else None
