"""Fine-tuning: fits a model again where it is not rounded, to compensate for what is."""

from collections.abc import Callable

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float32

from foldgauss._numerics.random_streams import Stream, make_generator
from foldgauss.render import cpu
from foldgauss.video.fitting.config import FitConfig
from foldgauss.video.fitting.state import FitState, update_rows
from foldgauss.video.models.conditioning import backpropagate, condition, update_windows
from foldgauss.video.models.prepared import PreparedModel
from foldgauss.video.models.row_layout import columns, unpack
from foldgauss.video.models.video_model import VideoModel

#: Learning rates decay exponentially between these fractions of a fit's first ones: the model is near its optimum.
FIRST_RATE, LAST_RATE = 0.4, 0.12

#: The planes (3, height, width) that frame k should match in a step, and the background color (3,).
Target = Callable[[int, int], tuple[Float32[np.ndarray, "3 height width"], Float32[np.ndarray, "3"]]]


def finetune_model(
    model: VideoModel,
    target: Target,
    passes: int,
    *,
    fixed: dict[str, Bool[np.ndarray, " num"]] | None = None,
    seed: int = 0,
    on_pass: Callable[[], None] = lambda: None,
) -> VideoModel:
    """The model after `passes` over its frames in random order: Adam with the fit's rates, mean squared error.

    Frame times do not change, nor do those leaves of `FoldedSplats` of the Gaussians that `fixed` marks. The degree of
    each Gaussian's fold does not rise.
    `target(k, step)` returns what frame k is compared with. Deterministic.
    """
    prepared = PreparedModel(model, model.size)
    rows, window, spec = prepared.rows, prepared.window, prepared.spec
    rates, config = np.zeros(rows.shape[1], np.float32), FitConfig()
    free = np.ones(rows.shape, np.float32)
    powers = np.repeat(np.arange(1, model.degree + 1), 2)
    free[:, columns(model.degree)["coefficients"]] = powers <= model.splats.degrees[:, None]
    for name, place in columns(model.degree).items():
        rates[place] = getattr(config.rates, name)
        if fixed:
            free[:, place] *= ~fixed[name][:, None]
    state = FitState.create(rows, model.frame_times.logits)
    grad, times = np.zeros_like(rows), np.asarray(model.frame_times.times())
    steps = passes * model.num_frames
    for step in range(steps):
        if step % model.num_frames == 0:
            order = make_generator(Stream.FINE_TUNING_ORDER, step, seed=seed).permutation(model.num_frames)
            on_pass()
        k = int(order[step % model.num_frames])
        wanted, background = target(k, step)
        done = condition(rows, window, times[k], spec)
        if not len(done.alive):
            continue
        leaves = done.mean, done.factor, done.opacity, done.color, background
        trace = cpu.forward(*leaves, model.size, compositing=model.compositing, options=model.options)
        by_image = (trace.image - wanted) * np.float32(2 / wanted.size)
        backpropagate(rows, done, cpu.backward(trace, by_image), spec, grad)
        grad[done.alive] *= free[done.alive]  # Adam does not move what never had a gradient
        rate = np.float32(FIRST_RATE * (LAST_RATE / FIRST_RATE) ** (step / steps))
        update_rows(state, grad, done.alive, rates * rate, units=config.rate_units)
        update_windows(rows, done.alive, window, spec)
    return eqx.tree_at(lambda m: m.splats, model, unpack(rows, model.degree, model.splats.envelope, model.splats.paths))
