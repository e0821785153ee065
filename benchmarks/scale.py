"""Long clips in segments and many clips at once: what workers bring, what kills cost, where segments meet.

    python -m benchmarks.scale workers --json workers.json    2,000 frames by 1, 2 and 4 workers of one thread each
    python -m benchmarks.scale seams --json seams.json        whether it shows where segments meet, on three clips
    python -m benchmarks.scale kills --json kills.json        SIGKILLs of workers and of the scheduler
    python -m benchmarks.scale many --json many.json          50 small clips, 3 of them broken
    python -m benchmarks.scale hours --json hours.json        what grows with the length: reading, planning, joining

Clips are made of the sample clips, forwards and backwards in turn: of Bunny, which has no cuts, for `workers`, of Bunny
and bikes otherwise. `workers` wants a quiet machine.
"""

import argparse
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
import psutil
from rich.table import Table

from benchmarks._common import console, describe_machine, parse, parser, size, whole
from foldgauss.io import index_video, join_segments, load_video_model, read_video, save_video_model, write_video
from foldgauss.io._atomic import atomic_path
from foldgauss.io.datasets import sample_clip
from foldgauss.jobs import seam_drops
from foldgauss.video import FitConfig, SegmentedVideo, fit, plan_segments, psnr

FPS = 25.0


def made_clip(path: Path, num_frames: int, frame_size: tuple[int, int], *names: str) -> Path:
    """Sample clips, forwards and backwards in turn, as one video of so many frames."""
    parts = []
    for name in names:
        frames = read_video(sample_clip(name), size=frame_size).frames
        parts += [frames, frames[::-1]]
    numbers = np.concatenate([np.full(len(part), k) for k, part in enumerate(parts)])
    within = np.concatenate([np.arange(len(part)) for part in parts])
    pictures = (parts[numbers[k % len(numbers)]][within[k % len(numbers)]] for k in range(num_frames))
    return write_video(path, pictures, FPS)


def fit_words(clip: Path, out: Path, *options: object) -> list[str]:
    words = [sys.executable, "-m", "foldgauss", "fit", clip, "--out", out, "--log-json", *options]
    return [str(word) for word in words]


def done_event(text: str) -> dict[str, Any]:
    """The last event that a command with --log-json told."""
    events = [json.loads(line) for line in text.splitlines() if line.startswith("{")]
    (done,) = (event for event in events if event["event"] == "done")
    return done


# ------------------------------------------------------------------------------------------------ workers


def workers(options: argparse.Namespace, folder: Path) -> dict[str, Any]:
    """The same fit by more and more workers of one thread each, on the cores that there are."""
    clip = made_clip(folder / "long.mp4", options.frames, options.size, "bunny")
    short = made_clip(folder / "short.mp4", options.frames // 4, options.size, "bunny")
    how = ("--threads", 1, "--steps", options.steps, "--segment-seconds", options.seconds)
    rows, digests = [], set()
    for source, count in [*((clip, count) for count in options.workers), (short, 2)]:
        out = folder / f"{source.stem}-by-{count}.safetensors"
        begun = time.perf_counter()
        words = fit_words(source, out, "--workers", count, *how)
        told = subprocess.run(words, check=True, capture_output=True, text=True).stdout
        seconds = time.perf_counter() - begun
        rows.append({"workers": count, "seconds": round(seconds, 1), **done_event(told)})
        if source == clip:
            digests.add(out.read_bytes())
            last = out
        console.print(f"{rows[-1]['num_frames']} frames, {count} workers: {seconds:.1f} s")
    table = Table(title=f"{options.frames} frames of {options.size[0]}x{options.size[1]}, {options.steps} steps each")
    for name in (
        "frames",
        "workers",
        "segments",
        "seconds",
        "faster by",
        "mean PSNR",
        "drop at seams",
        "MiB of a worker",
    ):
        table.add_column(name, justify="right")
    for row in rows:
        alike = row["num_frames"] == options.frames
        row["faster"] = round(rows[0]["seconds"] / row["seconds"], 2) if alike else None
        figures = row["num_frames"], row["workers"], row["num_segments"], row["seconds"], row["faster"] or ""
        drop = f"{row['seam_drop']:+.2f} dB" if "seam_drop" in row else "no fades"
        table.add_row(*map(str, figures), f"{row['mean_psnr']:.2f}", drop, str(row["peak_mib"]))
    console.print(table)
    console.print("The files are the same." if len(digests) == 1 else "THE FILES DIFFER.")
    video = load_video_model(last)
    return {"rows": rows, "same_bytes": len(digests) == 1, "spans": [[s.first, s.stop] for s in video.segments]}


# -------------------------------------------------------------------------------------------------- kills


class Victim:
    """A command that is killed, and given again."""

    def __init__(self, words: list[str], log: Path):
        self.words, self.log, self.process = words, log, None
        self.begin()

    def begin(self) -> None:
        with open(self.log, "a") as log:
            self.process = subprocess.Popen(self.words, stdout=log, stderr=log)

    @property
    def workers(self) -> list[psutil.Process]:
        """Its workers: processes that were spawned and have begun."""
        try:
            found = psutil.Process(self.process.pid).children(recursive=True)
            return [one for one in found if any("spawn_main" in word for word in one.cmdline())]
        except psutil.Error:
            return []


def kill_one(processes: list[psutil.Process], rng: random.Random) -> bool:
    """SIGKILL one of them."""
    if not processes:
        return False
    try:
        rng.choice(processes).send_signal(signal.SIGKILL)
    except psutil.Error:
        return False
    return True


def local_kills(options: argparse.Namespace, folder: Path, clip: Path, how: tuple, whole_model: bytes) -> dict:
    """Workers, and the process that has the scheduler, killed at random moments."""
    rng, out, log = random.Random(options.seed), folder / "killed.safetensors", folder / "killed.log"
    victim = Victim(fit_words(clip, out, "--workers", 2, *how), log)
    events, killed = ["worker"] * options.kills + ["scheduler"] * options.scheduler_kills, {"worker": 0, "scheduler": 0}
    rng.shuffle(events)
    starts = 1
    while events:
        time.sleep(rng.uniform(*options.between))
        if victim.process.poll() is not None:
            console.print(f"ended with {victim.process.returncode} before {len(events)} kills", style="red")
            break
        if events[0] == "scheduler":
            victim.process.kill()
            victim.process.wait()
            killed["scheduler"] += 1
            victim.begin()
            starts += 1
        elif kill_one(victim.workers, rng):
            killed["worker"] += 1
        else:
            continue
        console.print(f"killed a {events.pop(0)}, {sum(killed.values())} in all")
    code = victim.process.wait(timeout=1800)
    same = out.exists() and out.read_bytes() == whole_model
    return {"where": "local", "killed": killed, "started": starts, "exit": code, "same": same}


def cluster_kills(options: argparse.Namespace, folder: Path, clip: Path, how: tuple, whole_model: bytes) -> dict:
    """The scheduler of a cluster killed at random moments: the command fails, and is given again to a new one."""
    rng, out, port = random.Random(options.seed), folder / "cluster.safetensors", 8797
    address, killed, codes = f"tcp://127.0.0.1:{port}", 0, []
    while killed <= options.scheduler_kills:
        with open(folder / "cluster.log", "a") as log:
            shared = {"stdout": log, "stderr": log, "env": os.environ | {"FOLDGAUSS_NUM_THREADS": "1"}}
            dask = [sys.executable, "-m", "distributed.cli.dask_scheduler", "--host", "127.0.0.1", "--no-dashboard"]
            scheduler = subprocess.Popen([*dask, "--port", str(port)], **shared)
            time.sleep(3)
            words = [sys.executable, "-m", "distributed.cli.dask_worker", address, "--nthreads", "1", "--no-dashboard"]
            crew = [subprocess.Popen(words, **shared) for _ in range(2)]
            try:
                process = subprocess.Popen(fit_words(clip, out, "--scheduler", address, *how), stdout=log, stderr=log)
                if killed < options.scheduler_kills:
                    time.sleep(rng.uniform(12, 30))
                    scheduler.kill()
                    killed += 1
                    console.print(f"killed the cluster's scheduler, {killed} in all")
                else:
                    killed += 1  # the last round is left in peace
                codes.append(process.wait(timeout=1800))
            finally:
                for one in (scheduler, *crew):
                    one.terminate()
                for one in (scheduler, *crew):
                    one.wait(timeout=60)
    same = out.exists() and out.read_bytes() == whole_model
    row = {"where": "cluster", "killed": {"worker": 0, "scheduler": options.scheduler_kills}, "started": len(codes)}
    return row | {"exit": codes[-1], "exits": codes, "same": same}


def kills(options: argparse.Namespace, folder: Path) -> dict[str, Any]:
    clip = made_clip(folder / "long.mp4", options.frames, options.size, "bunny", "bikes")
    how = ("--steps", options.steps, "--gaussians", options.gaussians, "--segment-seconds", options.seconds)
    how += ("--checkpoint-seconds", 1)
    reference = folder / "undisturbed.safetensors"
    subprocess.run(fit_words(clip, reference, "--workers", 2, *how), check=True, capture_output=True)
    whole_model = reference.read_bytes()
    console.print(f"undisturbed: {len(load_video_model(reference).segments)} segments")
    rows = [work(options, folder, clip, how, whole_model) for work in (local_kills, cluster_kills)]
    table = Table("where", "workers killed", "schedulers killed", "starts", "exit", "bit-identical")
    for row in rows:
        figures = row["killed"]["worker"], row["killed"]["scheduler"], row["started"], row["exit"]
        table.add_row(row["where"], *map(str, figures), "yes" if row["same"] else "NO")
    console.print(table)
    return {"rows": rows}


# -------------------------------------------------------------------------------------------------- seams


def seams(options: argparse.Namespace, folder: Path) -> dict[str, Any]:
    """Whether it shows where segments meet: their scores there, and how much what is shown changes from frame to frame
    besides what the clip does."""
    rows = []
    for name in ("bunny", "bikes", "carphone"):
        path, out = folder / f"{name}.mp4", folder / f"{name}.safetensors"
        frames = read_video(sample_clip(name), size=options.size).frames
        write_video(path, frames, FPS)
        clip = read_video(path)
        how = ("--workers", 2, "--threads", 1, "--steps", options.steps, "--segment-seconds", options.seconds)
        subprocess.run(fit_words(path, out, *how), check=True, capture_output=True)
        video = load_video_model(out)
        pictures = np.stack(list(video.frames()))
        scores = np.array([psnr(*pair) for pair in zip(clip.frames, pictures, strict=True)])
        pairs = zip(video.segments[:-1], video.segments[1:], strict=True)
        fades = [(after.first, before.stop) for before, after in pairs if after.first < before.stop]
        error = pictures.astype(np.float32) - clip.frames
        flicker = np.abs(np.diff(error, axis=0)).mean(axis=(1, 2, 3))  # of each step to the next frame
        at_seams = np.zeros(len(flicker), bool)
        for first, stop in fades:
            at_seams[first - 1 : stop] = True
        drops = seam_drops(scores, fades)
        rows.append(
            {
                "clip": name,
                "segments": len(video.segments),
                "fades": len(fades),
                "psnr": round(float(scores.mean()), 2),
                "drop": round(float(drops.mean()), 3) if fades else None,
                "worst_drop": round(float(drops.max()), 3) if fades else None,
                "flicker_in_fades": round(float(flicker[at_seams].mean()), 3) if fades else None,
                "flicker_elsewhere": round(float(flicker[~at_seams].mean()), 3),
            }
        )
        console.print(rows[-1])
    table = Table("clip", "segments", "fades", "PSNR", "drop in fades (dB)", "worst", "flicker in fades", "elsewhere")
    for row in rows:
        table.add_row(*map(str, row.values()))
    console.print(table)
    return {"rows": rows}


# --------------------------------------------------------------------------------------------------- many


def many(options: argparse.Namespace, folder: Path) -> dict[str, Any]:
    """Small clips of three kinds, some broken in three ways: models, reasons and exit code."""
    clips, rng = folder / "clips", np.random.default_rng(options.seed)
    clips.mkdir()
    bunny = read_video(sample_clip("bunny"), size=(48, 96)).frames
    for k in range(options.clips):
        first = int(rng.integers(0, len(bunny) - 8))
        write_video(clips / f"clip{k:02}.mp4", bunny[first : first + 8], FPS)
    names = sorted(clips.iterdir())
    names[7].write_bytes(b"")
    names[19].write_bytes(b"No video at all.\n" * 100)
    names[33].write_bytes(names[33].read_bytes()[: names[33].stat().st_size // 3])
    out = folder / "models"
    how = ["--steps", "100", "--gaussians", "300", "--workers", str(options.workers[-1]), "--threads", "1"]
    words = [sys.executable, "-m", "foldgauss", "fit-many", str(clips), "--out", str(out), *how]
    seconds, codes = [], []
    for _ in range(2):  # the second finds all done
        begun = time.perf_counter()
        codes.append(subprocess.run(words, capture_output=True).returncode)
        seconds.append(round(time.perf_counter() - begun, 1))
    summary = json.loads((out / "summary.json").read_text())
    models = len(list(out.glob("*.safetensors")))
    reasons = [row["failure"] for row in summary["each"] if "failure" in row]
    for reason in reasons:
        console.print(reason, soft_wrap=True)
    table = Table("clips", "models", "failed", "exit codes", "seconds", "seconds, all done")
    table.add_row(*map(str, (options.clips, models, len(reasons), codes, *seconds)))
    console.print(table)
    return {"models": models, "reasons": reasons, "codes": codes, "seconds": seconds}


# -------------------------------------------------------------------------------------------------- hours


def hours(options: argparse.Namespace, folder: Path) -> dict[str, Any]:
    """What one process does for the whole clip, by its length: the pass through it, and joining the segments."""
    model = fit(read_video(sample_clip("bunny"), size=(32, 64), frames=(0, 24)).frames, FitConfig(steps=20)).model
    part, rows = save_video_model(folder / "part.safetensors", model), []
    for num in options.lengths:
        clip = made_clip(folder / f"{num}.mp4", num, options.size, "bunny", "bikes")
        process, begun = psutil.Process(), time.perf_counter()
        index = index_video(clip)
        reading = time.perf_counter() - begun
        spans = plan_segments(num, index.cuts, length=round(options.seconds * FPS), overlap=8)
        begun = time.perf_counter()
        index.save(folder / "index.npz")
        saving = time.perf_counter() - begun
        count = num // 24
        begun = time.perf_counter()
        joined = join_segments(folder / "joined.safetensors", [(24 * k, part) for k in range(count)])
        joining = time.perf_counter() - begun
        begun = time.perf_counter()
        opened = load_video_model(joined)
        opening = time.perf_counter() - begun
        assert isinstance(opened, SegmentedVideo)
        rows.append(
            {
                "num_frames": num,
                "frames_per_second": round(num / reading, 1),
                "segments": len(spans),
                "index_bytes": (folder / "index.npz").stat().st_size,
                "index_seconds": round(saving, 3),
                "joined": count,
                "join_ms_each": round(1000 * joining / count, 2),
                "join_mb_per_second": round(joined.stat().st_size / 1e6 / joining, 1),
                "open_ms": round(1000 * opening, 1),
                "rss_mib": process.memory_info().rss >> 20,
            }
        )
    table = Table(title=f"frames of {options.size[0]}x{options.size[1]}, in one process")
    for name in ("frames", "indexed a second", "segments", "index", "joined", "ms each", "MB/s", "opened in", "memory"):
        table.add_column(name, justify="right")
    for row in rows:
        table.add_row(
            f"{row['num_frames']:,}",
            f"{row['frames_per_second']:,.0f}",
            str(row["segments"]),
            f"{row['index_bytes'] / 1e3:,.0f} kB",
            str(row["joined"]),
            f"{row['join_ms_each']:.1f}",
            f"{row['join_mb_per_second']:.0f}",
            f"{row['open_ms']:.0f} ms",
            f"{row['rss_mib']} MiB",
        )
    console.print(table)
    return {"rows": rows}


PARTS = {"workers": workers, "seams": seams, "kills": kills, "many": many, "hours": hours}
#: Of each part, what is asked unless said otherwise.
DEFAULTS: dict[str, dict[str, Any]] = {
    "workers": {"frames": 2000, "size": (160, 320), "steps": 1000, "seconds": 10.32},
    "seams": {"frames": 0, "size": (136, 240), "steps": 1000, "seconds": 2.0},
    "kills": {"frames": 2000, "size": (80, 160), "steps": 400, "seconds": 10.0},
    "many": {"frames": 8, "size": (48, 96), "steps": 100, "seconds": 10.0},
    "hours": {"frames": 0, "size": (160, 320), "steps": 20, "seconds": 10.0},
}


def main(arguments: list[str] | None = None) -> None:
    made = parser(__doc__)
    made.add_argument("part", choices=PARTS)
    made.add_argument("--frames", type=whole, help="of the clip")
    made.add_argument("--size", type=size, metavar="HxW", help="of its frames")
    made.add_argument("--steps", type=whole, help="of each segment")
    made.add_argument("--seconds", type=float, help="of each segment's frames")
    made.add_argument("--workers", type=whole, nargs="+", default=[1, 2, 4], help="how many, one after the other")
    made.add_argument("--gaussians", type=whole, default=4000, help="of each segment, for kills")
    made.add_argument("--kills", type=whole, default=10, help="of workers")
    made.add_argument("--scheduler-kills", type=whole, default=2, help="of the scheduler")
    made.add_argument("--between", type=float, nargs=2, default=(3.0, 10.0), help="seconds between two kills")
    made.add_argument("--clips", type=whole, default=50)
    made.add_argument("--lengths", type=whole, nargs="+", default=[500, 2000, 8000], help="in frames, for hours")
    made.add_argument("--seed", type=int, default=0)
    options = parse(made, arguments)
    for name, value in DEFAULTS[options.part].items():
        if getattr(options, name) is None:
            setattr(options, name, value)
    with tempfile.TemporaryDirectory() as folder:
        figures = PARTS[options.part](options, Path(folder))
    if options.json is not None:
        with atomic_path(options.json) as temporary:
            asked = {name: getattr(options, name) for name in ("frames", "size", "steps", "seconds", "seed")}
            temporary.write_text(json.dumps({"machine": describe_machine(), "asked": asked} | figures, indent=2) + "\n")


if __name__ == "__main__":
    main()
