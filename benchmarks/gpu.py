"""A GPU's figures: rendering and its gradients, a fit against time, playback. Those measured: docs/gpu.md.

    python -m benchmarks.gpu [--json FILE] [--only engines quality playback] [--engines xla pallas cpu] [--minutes M]
                             [--gaussians N] [--looks N] [--rounds N]
    python -m benchmarks.gpu --anyway --tiny   # on a processor: whether it runs, no more

* *engines*: `pallas` and `xla`, 100k and 500k random splats (`_common.random_scene`) at 640x1280 and 1080x1920: wall
  milliseconds of a whole picture, listing included, and of a picture with its gradients, from arrays on the device to
  arrays there, median over rounds that run all engines in turn. Divided by the *pairs* (a pixel of a 16x16 tile times a
  Gaussian that the engine `cpu` lists there) they are ns per pair. Beside them the floor: the larger one of what the
  bytes take at the device's bandwidth and what the operations take at its peak, by the counts below.
* *quality*: the Bunny clip, 640x1280, all 132 frames, with each engine, `cpu` too if `--engines` names it: mean PSNR of
  all frames as they are shown, against seconds of the fit, which looking does not count among.
* *playback*: frames a second of the model that came out, conditioning included, as bytes on the device, a whole pass in
  one call.

Without a GPU that JAX sees nothing is measured, unless `--anyway` says so, for which `--tiny` makes everything small.
"""

import argparse
import functools
import statistics
import time

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks import _common
from benchmarks._common import Scene, Task, interleaved, random_scene
from benchmarks.rasterizer import num_boxes
from foldgauss.io import read_video
from foldgauss.io.datasets import sample_clip
from foldgauss.render import RenderOptions, Splats2D, cpu, pallas, render, tiles, xla
from foldgauss.video.fitting.config import FitConfig
from foldgauss.video.fitting.loop import fit_steps
from foldgauss.video.fitting.state import to_model
from foldgauss.video.models.metrics import evaluate
from foldgauss.video.models.video_model import VideoModel

ENGINES = {"xla": xla.TILE_SIZE, "pallas": pallas.TILE_SIZE}  # with the sides of their tiles
PARTS = ("engines", "quality", "playback")
SCENES = [(num, size) for num in (100_000, 500_000) for size in ((640, 1280), (1080, 1920))]
TINY_SCENES = [(200, (24, 40))]
SIZE = (640, 1280)
FRAMES = (0, 132)
MINUTES = 10.0
GAUSSIANS = 620_000
BATCH = 1
LOOKS = 10  # of a fit, evenly spaced in time; each renders all frames on the CPU
#: Peak float32 operations and exponentials a second, and bytes a second, by the device's name. NVIDIA's data sheets;
#: exponentials: 16 a cycle on each of 132 multiprocessors at 1.83 GHz.
PEAKS = {"H100": (67e12, 3.9e12, 3.35e12), "H200": (67e12, 3.9e12, 4.8e12)}
#: Float32 operations of a pair: offsets 2, whitened ones 5, exponent 4, comparisons 4, light 2, three colors 6; with
#: gradients the same once more, and of the way back gain 7, slope 5, nine products and sums over pixels 18.
OPERATIONS = {"forward": 23, "both": 23 + 23 + 30}
EXPONENTIALS = {"forward": 1, "both": 2}
#: Bytes of a splat's leaves (10 numbers) and fields (9); of a slot of the lists: its key is sorted in four passes, each
#: of which reads and writes it, and its fields are gathered (9 numbers read, written and read again).
SPLAT_BYTES = 4 * (10 + 9)
SLOT_BYTES = 4 * (2 * 4 + 3 * 9)
#: With gradients, also: the sums of a slot written and read (9 numbers), those of a splat written (10).
SPLAT_BYTES_BACK = 4 * (9 + 10)
SLOT_BYTES_BACK = 4 * 2 * 9


def floors(num: int, size: tuple[int, int], pairs: int, device: str) -> dict[str, float]:
    """Least milliseconds of a picture, "forward", and with its gradients, "both"; none for devices not in `PEAKS`."""
    peaks = next((own for name, own in PEAKS.items() if name in device), None)
    if peaks is None:
        return {}
    operations, exponentials, bandwidth = peaks
    slots, pixels, out = pairs / cpu.PIXELS, size[0] * size[1], {}
    moved = {"forward": SPLAT_BYTES * num + SLOT_BYTES * slots + 4 * 4 * pixels}
    moved["both"] = moved["forward"] + SPLAT_BYTES_BACK * num + SLOT_BYTES_BACK * slots + 4 * 8 * pixels
    for what, count in moved.items():
        computed = max(pairs * OPERATIONS[what] / operations, pairs * EXPONENTIALS[what] / exponentials)
        out[what] = 1e3 * max(count / bandwidth, computed)
    return out


def engine_tasks(scene: Scene) -> dict[str, Task]:
    """A picture, and one with gradients, by each engine, from arrays on the device."""
    leaves = jax.device_put(scene.leaves)
    grad = jax.device_put(np.moveaxis(scene.grad_image, 0, -1))
    tasks = {}
    for engine, tile in ENGINES.items():
        num_tiles = -(-scene.size[0] // tile) * -(-scene.size[1] // tile)
        capacity = max(min(num_boxes(scene, tile), tiles.MAX_SLOTS), num_tiles)
        how = {"engine": engine, "options": RenderOptions(list_capacity=capacity)}

        def drawn(leaves, how=how):
            return render(Splats2D(*leaves[:4]), scene.size, background=leaves[4], **how)

        forward = jax.jit(drawn)
        both = jax.jit(jax.grad(lambda leaves, grad, drawn=drawn: jnp.sum(drawn(leaves) * grad)))
        tasks[f"{engine} forward"] = Task(functools.partial(_waited, forward, leaves))
        tasks[f"{engine} both"] = Task(functools.partial(_waited, both, leaves, grad))
    return tasks


def _waited(function, *arrays):
    return jax.block_until_ready(function(*arrays))


def measure_engines(scenes: list[tuple[int, tuple[int, int]]], rounds: int) -> dict[str, float]:
    figures, device = {}, jax.devices()[0].device_kind
    rows = []
    for num, size in scenes:
        scene = random_scene(num, size)
        pairs = cpu.forward(*scene.leaves, size).num_pairs
        least = floors(num, size, pairs, device)
        seconds = interleaved(engine_tasks(scene), rounds)
        name = f"{num // 1000}k_{size[0]}x{size[1]}" if num >= 1000 else f"{num}_{size[0]}x{size[1]}"
        figures[f"{name}_pairs"] = pairs
        for task, own in seconds.items():
            engine, what = task.split()
            median, floor = statistics.median(own), least.get(what)
            figures |= {f"{name}_{engine}_{what}_ms": 1e3 * median, f"{name}_{engine}_{what}_ns": 1e9 * median / pairs}
            if floor is not None:
                figures[f"{name}_{what}_floor_ms"] = floor
            beside = ("", "") if floor is None else (f"{floor:.3f}", f"{1e3 * median / floor:.1f}")
            rows.append((name, engine, what, f"{1e3 * median:.3f}", f"{1e9 * median / pairs:.4f}", *beside))
        for what in ("forward", "both"):
            ratio = figures[f"{name}_xla_{what}_ms"] / figures[f"{name}_pallas_{what}_ms"]
            figures[f"{name}_xla_over_pallas_{what}"] = ratio
    columns = "scene", "engine", "pass", "ms", "ns/pair", "floor (ms)", "by floor"
    _common.print_table("Engines", columns, rows)
    return figures


def measure_quality(frames: np.ndarray, config: FitConfig, looks: int) -> tuple[dict[str, float], VideoModel]:
    """PSNR against the seconds of a fit, and the model."""
    figures, courses = {}, []
    begun = time.perf_counter()
    for state, info in fit_steps(frames, config):
        if not courses:
            figures["compile_and_start_seconds"] = time.perf_counter() - begun
        share = state.seconds / (60 * config.minutes) if config.minutes else info.progress
        if share * looks >= len(courses) + 1 or info.stopped_by:
            model = to_model(state, config, frames.shape[1:3], 25.0)
            courses.append((state.seconds, evaluate(model, frames).mean_psnr))
    figures |= {f"after_{seconds:.0f}_s_psnr": value for seconds, value in courses}
    figures |= {"psnr": courses[-1][1], "seconds": state.seconds, "steps": info.step}
    figures |= {"gaussians": state.num_gaussians, "ms_per_step": 1e3 * state.seconds / info.step}
    return figures, to_model(state, config, frames.shape[1:3], 25.0)


@functools.partial(jax.jit, static_argnums=(1, 2))
def played(model, engine: str, size: tuple[int, int]):
    """All frames of a model's arrays, uint8 (num_frames, height, width, 3), one after another in one program."""
    splats, times, options, compositing = model

    def picture(t):
        drawn = splats.at(t).to_pixels(size)
        image = render(drawn, size, engine=engine, options=options.value, compositing=compositing.value)
        return jnp.clip(jnp.round(image * 255), 0, 255).astype(jnp.uint8)

    return jax.lax.map(picture, times)


@functools.partial(jax.tree_util.register_dataclass, data_fields=[], meta_fields=["value"])
class Setting:
    """What a program is compiled for, among its arrays."""

    def __init__(self, value: object):
        self.value = value


def measure_playback(model: VideoModel, rounds: int) -> dict[str, float]:
    arrays = jax.device_put((model.splats, model.frame_times.times()))
    given = *arrays, Setting(model.options), Setting(model.compositing)
    tasks = {
        engine: Task(lambda engine=engine: jax.block_until_ready(played(given, engine, model.size)))
        for engine in ENGINES
    }
    seconds = interleaved(tasks, rounds)
    return {f"{engine}_fps": model.num_frames / statistics.median(own) for engine, own in seconds.items()}


def main(arguments: list[str] | None = None) -> None:
    made = _common.parser(__doc__)
    made.add_argument("--only", nargs="+", choices=PARTS, default=PARTS, help="what to measure; default: all")
    made.add_argument("--engines", nargs="+", choices=(*ENGINES, "cpu"), default=tuple(ENGINES), help="of the fits")
    made.add_argument("--minutes", type=float, default=MINUTES, help="of each fit")
    made.add_argument("--gaussians", type=_common.whole, default=GAUSSIANS, help="of each fit")
    made.add_argument("--batch-size", type=_common.whole, default=BATCH, help="of each fit")
    made.add_argument("--looks", type=_common.whole, default=LOOKS, help="at each fit, evenly spaced in time")
    made.add_argument("--rounds", type=_common.whole, default=7)
    made.add_argument("--anyway", action="store_true", help="also without a GPU; with --tiny")
    made.add_argument("--tiny", action="store_true", help="small scenes, a short fit: whether it runs")
    options = _common.parse(made, arguments)
    if jax.default_backend() == "cpu" and not (options.anyway and options.tiny):
        made.error("expected a GPU that JAX sees, got none. --anyway --tiny tells whether this runs, on a processor.")
    _common.finish(options.json, measured(options), facts=facts())


def measured(options: argparse.Namespace) -> dict[str, float]:
    figures = {}
    if "engines" in options.only:
        scenes, rounds = (TINY_SCENES, 1) if options.tiny else (SCENES, options.rounds)
        figures |= {f"engines_{name}": value for name, value in measure_engines(scenes, rounds).items()}
    if {"quality", "playback"} & set(options.only):
        size, span = ((32, 64), (0, 3)) if options.tiny else (SIZE, FRAMES)
        frames = read_video(sample_clip("bunny"), frames=span, size=size).frames
        for engine in options.engines:
            if options.tiny:
                config = FitConfig(num_gaussians=60, steps=4, engine=engine)
            else:
                how = {"minutes": options.minutes, "views.batch_size": options.batch_size}
                config = FitConfig().replace(num_gaussians=options.gaussians, engine=engine, **how)
            found, model = measure_quality(frames, config, options.looks)
            figures |= {f"quality_{engine}_{name}": value for name, value in found.items()}
        if "playback" in options.only:
            rounds = 1 if options.tiny else options.rounds
            figures |= {f"playback_{name}": value for name, value in measure_playback(model, rounds).items()}
    return figures


def facts() -> dict[str, object]:
    devices = jax.local_devices()
    return {"device": devices[0].device_kind, "devices": len(devices)}


if __name__ == "__main__":
    main()
