"""Where a step of the fit spends its time, beside the splats.

    python -m benchmarks.step [--json FILE] [--gaussians 200000] [--size 160x320] [--steps 24]

The real fit (`foldgauss.video.fit_steps`) runs on the sample clip Bunny, degree 3, one frame a step;
every function it calls is wrapped in a clock that waits for the result. The total is the time of a whole
step, its own bookkeeping included; "target" (bytes to floats) is timed on its own, side by side; "other" is
what remains of the total. All times are medians over the steps after the warm-up, which compiles.

Figures: `rendering_ms` (forward and backward), `ssim_ms` (the loss with its gradient), `rest_ms` (total less
both: conditioning, optimiser, frame times, target, bookkeeping), `rest_over_rendering_and_ssim` (at most 2),
and for comparison `naive_adam_ms`: optax's Adam in XLA on all Gaussians, dead or alive, without buffer
donation.
"""

import contextlib
import importlib
import statistics
import time
import types
from collections.abc import Callable, Iterator
from unittest import mock

import jax
import jax.numpy as jnp
import numpy as np
import optax

from benchmarks import _common
from benchmarks._common import console
from foldgauss.envelope import TimeLikelihood
from foldgauss.io import read_video
from foldgauss.io.datasets import sample_clip
from foldgauss.render import cpu
from foldgauss.video.fitting.loop import FitConfig, FitState, fit_steps
from foldgauss.video.models.row_layout import unpack

#: The module, which the function `fit` of the package hides.
stepper_module = importlib.import_module("foldgauss.video.fitting.steppers.cpu_stepper")
WARMUP = 5  # steps: the first compiles, and the optimiser's pages are touched for the first time
#: What is timed, in the order of a step.
PARTS = {
    "frame times": "frame times t_k and their Adam (JAX)",
    "target": "target, bytes to floats",
    "condition": "conditioning, forward",
    "raster forward": "raster, forward",
    "loss": "L1 + SSIM, with gradient",
    "raster backward": "raster, backward",
    "pull back": "conditioning, backward",
    "adam": "sparse Adam and windows of time",
    "other": "other",
}
RENDERING, LOSS = ("raster forward", "raster backward"), ("loss",)


class Clock:
    """Seconds by part, of one step."""

    def __init__(self):
        self.seconds = dict.fromkeys(PARTS, 0.0)

    def timed(self, part: str, function: Callable) -> Callable:
        """`function`, timed until its result is there."""

        def wrapped(*arguments, **options):
            begun = time.perf_counter()
            result = function(*arguments, **options)
            if part == "frame times":
                jax.block_until_ready(result)
            self.seconds[part] += time.perf_counter() - begun
            return result

        return wrapped


@contextlib.contextmanager
def wrapped_fit(clock: Clock) -> Iterator[None]:
    """The functions that `foldgauss.video.fit` calls, timed while the block runs."""
    kernels = types.SimpleNamespace(
        forward=clock.timed("raster forward", cpu.forward),
        backward=clock.timed("raster backward", cpu.backward),
        raise_screen_gradients=cpu.raise_screen_gradients,
    )
    parts = {
        "frame_times": "frame times",
        "update_frame_times": "frame times",
        "condition": "condition",
        "image_loss": "loss",
        "backpropagate": "pull back",
        "update_rows": "adam",
        "update_windows": "adam",
    }
    with contextlib.ExitStack() as stack:
        stack.enter_context(mock.patch.object(stepper_module, "cpu", kernels))
        for name, part in parts.items():
            timed = clock.timed(part, getattr(stepper_module, name))
            stack.enter_context(mock.patch.object(stepper_module, name, timed))
        yield


def measure(frames: np.ndarray, config: FitConfig, num_steps: int) -> tuple[list[dict], FitState, float]:
    """Seconds by part and in total, for each step after the warm-up; the state; the mean number alive."""
    planes, records, alive = np.ascontiguousarray(np.moveaxis(frames, -1, 1)), [], []
    clock = Clock()
    with wrapped_fit(clock):
        steps = fit_steps(frames, config)
        state, _ = next(steps)
        for k in range(WARMUP + num_steps):
            clock.seconds = dict.fromkeys(PARTS, 0.0)
            begun = time.perf_counter()
            state, info = next(steps)
            total = time.perf_counter() - begun
            begun = time.perf_counter()
            np.multiply(planes[k % len(planes)], np.float32(1 / 255), dtype=np.float32)
            parts = clock.seconds | {"target": time.perf_counter() - begun}
            parts["other"] = max(total - sum(parts.values()), 0.0)
            if k >= WARMUP:
                records.append(parts | {"total": total})
                alive.append(info.num_alive)
    return records, state, statistics.mean(alive)


def naive_adam(state: FitState, config: FitConfig, rounds: int) -> float:
    """Median seconds of optax's Adam on the whole model."""
    splats = jax.device_put(unpack(state.rows, config.fold_degree, TimeLikelihood(power=np.float32(config.power))))
    rule = optax.adam(1e-3, eps=1e-15)

    @jax.jit
    def update(splats, moments, gradients):
        change, moments = rule.update(gradients, moments, splats)
        return optax.apply_updates(splats, change), moments

    gradients = jax.tree.map(lambda leaf: jnp.full_like(leaf, 1e-3), splats)
    held = [splats, rule.init(splats)]

    def run():
        held[:] = jax.block_until_ready(update(*held, gradients))

    return statistics.median(_common.interleaved({"naive": _common.Task(run)}, rounds, warmup=2)["naive"])


def median_ms(records: list[dict], parts: tuple[str, ...]) -> float:
    """Median over the steps of the sum of `parts`, in ms."""
    return statistics.median(sum(record[part] for part in parts) for record in records) * 1e3


def show(records: list[dict], naive: float, title: str) -> None:
    table = _common.table(title, "part of a step", "ms", "share")
    total = median_ms(records, ("total",))
    for part, words in PARTS.items():
        table.add_row(words, f"{median_ms(records, (part,)):.2f}", f"{median_ms(records, (part,)) / total:.0%}")
    table.add_section()
    rest = tuple(part for part in PARTS if part not in RENDERING + LOSS)
    for words, parts in (("rendering", RENDERING), ("L1 + SSIM", LOSS), ("the rest", rest)):
        table.add_row(words, f"{median_ms(records, parts):.2f}", f"{median_ms(records, parts) / total:.0%}")
    table.add_row("total", f"{total:.2f}", "100%")
    table.add_section()
    table.add_row("instead of sparse Adam: optax, all Gaussians, undonated", f"{naive * 1e3:.2f}", "")
    console.print(table)


def figures_of(records: list[dict], naive: float, num_alive: float) -> dict[str, float]:
    rendering, ssim = median_ms(records, RENDERING), median_ms(records, LOSS)
    rests = [record["total"] - sum(record[part] for part in RENDERING + LOSS) for record in records]
    rest, adam = statistics.median(rests) * 1e3, median_ms(records, ("adam",))
    return {
        "rendering_ms": rendering,
        "ssim_ms": ssim,
        "rest_ms": rest,
        "total_ms": median_ms(records, ("total",)),
        "rest_over_rendering_and_ssim": rest / (rendering + ssim),
        "sparse_adam_ms": adam,
        "naive_adam_ms": naive * 1e3,
        "naive_over_sparse_adam": naive * 1e3 / adam,
        "naive_adam_over_rendering_and_ssim": naive * 1e3 / (rendering + ssim),
        "alive": num_alive,
    }


def main(arguments: list[str] | None = None) -> None:
    parser = _common.parser(__doc__)
    parser.add_argument("--gaussians", type=_common.whole, default=200_000, help="Gaussians [200000]")
    parser.add_argument("--size", type=_common.size, default=(160, 320), metavar="HxW", help="frames [160x320]")
    parser.add_argument("--steps", type=_common.whole, default=24, help="steps that are timed [24]")
    options = _common.parse(parser, arguments)
    facts = _common.describe_machine()
    frames = read_video(sample_clip("bunny"), size=options.size).frames
    config = FitConfig(num_gaussians=options.gaussians, degree=3, steps=3000)
    records, state, num_alive = measure(frames, config, options.steps)
    naive = naive_adam(state, config, max(7, options.steps // 2))
    height, width = options.size
    show(
        records,
        naive,
        f"{options.gaussians:,} Gaussians ({num_alive:,.0f} alive), one frame of {height}x{width}",
    )
    _common.finish(options.json, figures_of(records, naive, num_alive), facts, steps=options.steps)


if __name__ == "__main__":
    main()
