"""Some leaves of a model fitted anew while the others stay: what rounding cost is made up for by what is still free."""

from collections.abc import Callable, Collection

import equinox as eqx
import numpy as np
from jaxtyping import Float32, Int32

from foldgauss.render import cpu
from foldgauss.video.fitting.adam import sparse_adam
from foldgauss.video.fitting.codebook import Codebook
from foldgauss.video.fitting.config import UNIT_TIME, LearningRates
from foldgauss.video.models.conditioning import apply_scale_cutoff, backpropagate, condition, update_windows
from foldgauss.video.models.prepared import PreparedModel
from foldgauss.video.models.row_layout import columns, unpack
from foldgauss.video.models.sparse_storage import find_kinds
from foldgauss.video.models.video_model import VideoModel

#: Rates fall exponentially from and to these shares of a fit's first ones: the model is near its best.
FIRST_RATE, LAST_RATE = 0.3, 0.02
PATH_AND_COLOR, COLOR = ("loc", "coefficients", "color_dc"), ("color_dc",)

#: Planes (3, height, width) that frame k is to look like, and the colour (3,) behind it.
Target = Callable[[int, int], tuple[Float32[np.ndarray, "3 height width"], Float32[np.ndarray, "3"]]]


def refitted(
    model: VideoModel,
    target: Target,
    passes: int,
    *,
    free: Collection[str] | None = None,
    shared: Int32[np.ndarray, " num"] | None = None,
    seed: int = 0,
    on_pass: Callable[[], None] = lambda: None,
) -> VideoModel:
    """The model after `passes` over its frames in random order, by least squares; only leaves `free` change.

    `target(k, step)` gives what frame k is compared with. `free` None: all. Frame times stay.
    `shared`: the number of each Gaussian's colour, where those of a number stay alike. Deterministic; Adam as in the
    fit.
    """
    stage = PreparedModel(model, model.size)
    rows, window, shape = stage.rows, stage.window, stage.spec
    rates, own = np.zeros(rows.shape[1], np.float32), LearningRates()
    for name, place in columns(model.degree).items():
        rates[place] = getattr(own, name) if free is None or name in free else 0.0
    first, second, grad = np.zeros_like(rows), np.zeros_like(rows), np.zeros_like(rows)
    kinds = find_kinds(rows, model.degree)  # what a Gaussian has not got stays away
    palette, colors = Codebook.of(shared, 3), columns(model.degree)["color_dc"]  # what is shared learns as one
    counts, times = np.zeros(len(rows), np.int32), np.asarray(model.frame_times.times())
    drawn = {"compositing": model.compositing, "options": model.options}
    steps = passes * model.num_frames
    for step in range(steps):
        if step % model.num_frames == 0:
            order = np.random.default_rng([seed, step]).permutation(model.num_frames)
            on_pass()
        k = int(order[step % model.num_frames])
        wanted, behind = target(k, step)
        done = condition(rows, window, times[k], shape)
        if not len(done.alive):
            continue
        trace = cpu.forward(done.mean, done.factor, done.opacity, done.color, behind, model.size, **drawn)
        by_image = (trace.image - wanted) * np.float32(2 / wanted.size)
        backpropagate(rows, done, cpu.backward(trace, by_image)[:4], shape, grad)
        rate = np.float32(FIRST_RATE * (LAST_RATE / FIRST_RATE) ** (step / steps))
        palette.step(rows[:, colors], grad[:, colors], done.alive, rate * rates[colors])
        sparse_adam(rows, grad, first, second, counts, done.alive, rates * rate, kinds=kinds, unit_time=UNIT_TIME)
        if free is None:
            update_windows(rows, done.alive, window)
            if model.scale_cutoff > 0:
                near = window[done.alive]
                apply_scale_cutoff(rows[done.alive], near, shape, model.scale_cutoff)
                window[done.alive] = near
    return eqx.tree_at(lambda m: m.splats, model, unpack(rows, model.degree, model.splats.envelope))
