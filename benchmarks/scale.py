"""Long clips in segments: what workers bring, what kills cost, where segments meet.

    python -m benchmarks.scale workers --json workers.json    2,000 frames by 1, 2 and 4 workers of one thread each
    python -m benchmarks.scale seams --json seams.json        whether it shows where segments meet, on three clips
    python -m benchmarks.scale kills --json kills.json        SIGKILLs of workers and of the scheduler

Clips are made of the sample clips, forwards and backwards in turn: of Bunny, which has no cuts, for `workers`, of Bunny
and bikes otherwise. `workers` wants a quiet machine.
"""

import argparse
import json
import os
import random
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
import psutil

from benchmarks import _common
from benchmarks._common import console
from foldgauss.io import load_video_model, read_video, write_video
from foldgauss.io.datasets import sample_clip
from foldgauss.video import psnr

FPS = 25.0
#: Frames on either side of an overlap that it is compared with.
BESIDE = 8


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
    how = ("--threads", 1, "--steps", options.steps, "--segment-seconds", options.seconds)
    rows, files = [], set()
    for count in options.workers:
        out = folder / f"by-{count}.safetensors"
        begun = time.perf_counter()
        words = fit_words(clip, out, "--workers", count, *how)
        told = subprocess.run(words, check=True, capture_output=True, text=True).stdout
        rows.append({"workers": count, "seconds": round(time.perf_counter() - begun, 1), **done_event(told)})
        files.add(out.read_bytes())
    columns = "workers", "num_segments", "seconds", "mean_psnr", "peak_mib"
    title = f"{options.frames} frames of {options.size[0]}x{options.size[1]}, {options.steps} steps each"
    _common.print_table(title, columns, ([row.get(name, "") for name in columns] for row in rows))
    console.print("The files are the same." if len(files) == 1 else "THE FILES DIFFER.")
    return {"rows": rows, "same_bytes": len(files) == 1}


# -------------------------------------------------------------------------------------------------- kills


def start(words: list[str], log: Path) -> subprocess.Popen:
    with open(log, "a") as file:
        return subprocess.Popen(words, stdout=file, stderr=file)


def kill_worker(pid: int, rng: random.Random) -> bool:
    """SIGKILL one of the workers of a command, processes that were spawned; False where there is none yet."""
    try:
        children = psutil.Process(pid).children(recursive=True)
        rng.choice([one for one in children if any("spawn_main" in word for word in one.cmdline())]).kill()
    except (psutil.Error, IndexError):
        return False
    return True


def local_kills(options: argparse.Namespace, folder: Path, clip: Path, how: tuple, whole_model: bytes) -> dict:
    """Workers, and the process that has the scheduler, killed at random moments."""
    rng, out, log = random.Random(options.seed), folder / "killed.safetensors", folder / "killed.log"
    words = fit_words(clip, out, "--workers", 2, *how)
    process, starts = start(words, log), 1
    events, killed = ["worker"] * options.kills + ["scheduler"] * options.scheduler_kills, {"worker": 0, "scheduler": 0}
    rng.shuffle(events)
    while events:
        time.sleep(rng.uniform(*options.between))
        if process.poll() is not None:
            console.print(f"ended with {process.returncode} before {len(events)} kills", style="red")
            break
        if events[0] == "scheduler":
            process.kill()
            process.wait()
            process, starts = start(words, log), starts + 1
        elif not kill_worker(process.pid, rng):
            continue
        killed[events[0]] += 1
        console.print(f"killed a {events.pop(0)}, {sum(killed.values())} in all")
    code = process.wait(timeout=1800)
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
    shown = ((row["where"], *row["killed"].values(), row["started"], row["exit"], row["same"]) for row in rows)
    columns = "where", "workers killed", "schedulers killed", "starts", "exit", "bit-identical"
    _common.print_table("Kills", columns, shown)
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
        beside = [np.r_[scores[max(first - BESIDE, 0) : first], scores[stop : stop + BESIDE]] for first, stop in fades]
        drops = [near.mean() - scores[first:stop].mean() for near, (first, stop) in zip(beside, fades, strict=True)]
        rows.append(
            {
                "clip": name,
                "segments": len(video.segments),
                "PSNR": round(float(scores.mean()), 2),
                "drop in fades": round(float(np.mean(drops)), 3) if fades else None,
                "flicker in fades": round(float(flicker[at_seams].mean()), 3) if fades else None,
                "flicker elsewhere": round(float(flicker[~at_seams].mean()), 3),
            }
        )
    _common.print_table("Where segments meet", rows[0], (row.values() for row in rows))
    return {"rows": rows}


PARTS = {"workers": workers, "seams": seams, "kills": kills}
#: Of each part, what is asked unless said otherwise.
DEFAULTS: dict[str, dict[str, Any]] = {
    "workers": {"frames": 2000, "size": (160, 320), "steps": 1000, "seconds": 10.32},
    "seams": {"frames": 0, "size": (136, 240), "steps": 1000, "seconds": 2.0},
    "kills": {"frames": 2000, "size": (80, 160), "steps": 400, "seconds": 10.0},
}


def main(arguments: list[str] | None = None) -> None:
    made = _common.parser(__doc__)
    made.add_argument("part", choices=PARTS)
    made.add_argument("--frames", type=_common.whole, help="of the clip")
    made.add_argument("--size", type=_common.parse_size, metavar="HxW", help="of its frames")
    made.add_argument("--steps", type=_common.whole, help="of each segment")
    made.add_argument("--seconds", type=_common.positive, help="of each segment's frames")
    made.add_argument("--workers", type=_common.whole, nargs="+", default=[1, 2, 4], help="one after the other")
    made.add_argument("--gaussians", type=_common.whole, default=4000, help="of each segment, for kills")
    made.add_argument("--kills", type=_common.whole, default=10, help="of workers")
    made.add_argument("--scheduler-kills", type=_common.whole, default=2, help="of the scheduler")
    made.add_argument("--between", type=float, nargs=2, default=(3.0, 10.0), help="seconds between two kills")
    made.add_argument("--seed", type=int, default=0)
    options = _common.parse(made, arguments)
    for name, value in DEFAULTS[options.part].items():
        if getattr(options, name) is None:
            setattr(options, name, value)
    with tempfile.TemporaryDirectory() as folder:
        found = PARTS[options.part](options, Path(folder))
    asked = {name: getattr(options, name) for name in ("frames", "size", "steps", "seconds", "seed")}
    _common.finish(options.json, {}, asked=asked, **found)


if __name__ == "__main__":
    main()
