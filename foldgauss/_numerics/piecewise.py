"""Piecewise linear functions of time, given by their values at knots."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int


def locate(
    times: Float[Array, "rows knots"], row: Int[Array, "*batch"], t: Float[Array, "*batch"]
) -> tuple[Int[Array, "*batch"], Int[Array, "*batch"], Float[Array, "*batch"]]:
    """The knots of a row of `times` before and after each t, and the fraction in [0, 1] of the way between them.

    `times` do not decrease; where several are equal, t there is at the last. Outside of them the fraction is that of
    the nearer end. NumPy arrays if `times` and t are.
    """
    last = times.shape[-1] - 1
    if isinstance(times, np.ndarray) and isinstance(t, np.ndarray):
        xp, before = np, np.empty(np.broadcast_shapes(np.shape(row), t.shape), np.int32)
        row, t = np.broadcast_to(row, before.shape), np.broadcast_to(t, before.shape)
        for number in np.unique(row):  # without the knots of every element, of which there may be thousands
            here = row == number
            before[here] = np.searchsorted(times[number], t[here], side="right") - 1
    else:
        xp, before = jnp, (times[row] <= t[..., None]).sum(-1, dtype=np.int32) - 1
    before = xp.clip(before, 0, max(last - 1, 0))
    after = xp.minimum(before + 1, last)
    begun, ended = times[row, before], times[row, after]
    span = ended - begun
    inside = xp.clip((t - begun) / xp.where(span > 0, span, 1), 0, 1)
    # Where two knots are equal: 0 before them and 1 from them on.
    return before, after, xp.where(span > 0, inside, (t >= ended).astype(inside.dtype))
