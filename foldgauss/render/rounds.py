"""The rounds of the JAX engines `xla` and `pallas`, forward and backward: each composites as many splats as fit into
its lists, and continues from the transmittance reached.

The backward pass takes the rounds from back to front. The lists of the last one, mostly the only one, are kept; of the
others only some of their starts are stored, and the rest is recomputed.
"""

import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from foldgauss.render.tiles import (
    COLOR,
    MOMENTS,
    Plan,
    gradients_from_sums,
    initial_transmittance,
    join_tiles,
    make_lists,
    pack_fields,
    project,
    split_tiles,
)

#: Rounds at whose start the backward pass stores the transmittance; of more rounds, every n-th.
STORED_ROUNDS = 8


class Engine(NamedTuple):
    """One round of an engine. Planes are (tiles, pixels), in the order of `tiles.join_tiles`.

    `composite(plan, lists, fields, transmittance, planes)` returns the transmittance and the colors' planes after the
    round, and what `pull_back` needs of it; `find_needed(plan, lists, fields, transmittance)` only that.
    `pull_back(plan, lists, fields, needed, grad_planes, behind, sums)` returns `sums` with the gradient sums of the
    round's splats added, and `behind`, the color behind its splats per unit of transmittance times the incoming
    gradient, with the splats composited over it.
    """

    composite: Callable
    find_needed: Callable
    pull_back: Callable


@functools.partial(jax.custom_vjp, nondiff_argnums=(0, 1))
def _render(engine: Engine, plan: Plan, leaves: tuple[Array, ...]) -> Float[Array, "height width channels"]:
    """Render (mean, factor, opacity, color, background), all of one floating dtype."""
    return render_forward(engine, plan, leaves)[0]


def render_forward(engine: Engine, plan: Plan, leaves):
    """The image, and what the backward pass needs; its last entry is the number of rounds until no splat or no
    unfinished pixel was left."""
    mean, factor, opacity, color, background = leaves
    projected = project(plan, mean, factor, opacity)
    fields = pack_fields(projected, mean, opacity, color)

    def more(carry):
        return (carry[1] < len(mean)) & jnp.any(carry[2] > plan.stop)

    def composite(carry):
        number, begin, transmittance, planes, *_ = carry
        lists, end = make_lists(plan, projected, mean, begin)
        return number + 1, end, *engine.composite(plan, lists, fields, transmittance, planes), lists

    transmittance = initial_transmittance(plan, mean.dtype)
    start = jnp.int32(0), jnp.int32(0), transmittance, (jnp.zeros_like(transmittance),) * color.shape[1]
    no_round = jax.tree.map(lambda like: jnp.zeros(like.shape, like.dtype), jax.eval_shape(composite, start)[4:])
    num, _, transmittance, planes, *last_round = jax.lax.while_loop(more, composite, (*start, *no_round))
    planes = [plane + transmittance * own for plane, own in zip(planes, background, strict=True)]
    return join_tiles(plan, jnp.stack(planes)), (leaves, transmittance, last_round, num)


def render_backward(engine: Engine, plan: Plan, residuals, grad_image):
    """The gradients of the leaves."""
    leaves, transmittance, last_round, num = residuals
    mean, factor, opacity, color, background = leaves
    projected = project(plan, mean, factor, opacity)
    fields = pack_fields(projected, mean, opacity, color)
    grad_planes = split_tiles(plan, grad_image)

    def attenuate(begin, transmittance):
        lists, end = make_lists(plan, projected, mean, begin)
        return end, engine.composite(plan, lists, fields[:, :COLOR], transmittance, ())[0]

    start_of = _checkpoint_rounds(initial_transmittance(plan, mean.dtype), num, attenuate)

    def replay(begin, transmittance):
        lists, _ = make_lists(plan, projected, mean, begin)
        return [engine.find_needed(plan, lists, fields[:, :COLOR], transmittance), lists]

    def backward_round(carry):
        number, sums, behind = carry
        needed, lists = jax.lax.cond(number == num - 1, lambda: last_round, lambda: replay(*start_of(number)))
        return number - 1, *engine.pull_back(plan, lists, fields, needed, grad_planes, behind, sums)

    # Without a row for empty slots: millions of zeros added to a single row took half of a step's time on a GPU.
    sums = jnp.zeros((len(mean), MOMENTS + color.shape[1]), mean.dtype)
    behind = jnp.sum(grad_planes * background[:, None, None], axis=0)
    _, sums, _ = jax.lax.while_loop(lambda carry: carry[0] >= 0, backward_round, (num - 1, sums, behind))
    d_background = jnp.sum(transmittance[None] * grad_planes, axis=(1, 2))
    return ((*gradients_from_sums(projected, sums, factor, opacity), d_background),)


_render.defvjp(render_forward, render_backward)
render_rounds = jax.jit(_render, static_argnums=(0, 1))


def _checkpoint_rounds(start: Float[Array, "tiles pixels"], num, attenuate: Callable) -> Callable:
    """Replay the transmittance of `num` rounds and store checkpoints; returns a function that maps the index of a round
    to its first splat and the transmittance there, replayed from the last checkpoint before it.

    `start`: transmittance before the first round. `attenuate(begin, transmittance)`: one round; returns the first splat
    that did not fit, and the transmittance behind it.
    """
    stride = jnp.maximum(-(-num // STORED_ROUNDS), 1)
    last = (num - 1) // stride

    def advance(count, begin, transmittance):
        return jax.lax.fori_loop(0, count, lambda _, state: attenuate(*state), (begin, transmittance))

    def store(k, carry):
        begins, stored, begin, transmittance = carry
        begins, stored = begins.at[k].set(begin), stored.at[k].set(transmittance)
        return begins, stored, *advance(jnp.where(k < last, stride, 0), begin, transmittance)

    # The arrays at the start of the first round: a single round needs no others.
    first = jnp.zeros(STORED_ROUNDS, jnp.int32), jnp.broadcast_to(start, (STORED_ROUNDS, *start.shape))
    begins, stored, *_ = jax.lax.fori_loop(0, jnp.where(num > 1, last + 1, 0), store, (*first, jnp.int32(0), start))
    return lambda number: advance(number % stride, begins[number // stride], stored[number // stride])
