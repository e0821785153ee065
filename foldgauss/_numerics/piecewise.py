"""Piecewise linear functions of time, given by their values at knots."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int


def locate(
    times: Float[Array, "*batch knots"], t: Float[Array, "*batch"]
) -> tuple[Int[Array, "*batch"], Int[Array, "*batch"], Float[Array, "*batch"]]:
    """The knots before and after each t, and the fraction in [0, 1] of the way between them.

    `times` do not decrease; where several are equal, t there is at the last. Outside of them the fraction is that of
    the nearer end. NumPy arrays if both are.
    """
    xp = np if isinstance(times, np.ndarray) and isinstance(t, np.ndarray) else jnp
    last = times.shape[-1] - 1
    before = xp.clip((times <= t[..., None]).sum(-1, dtype=np.int32) - 1, 0, max(last - 1, 0))
    after = xp.minimum(before + 1, last)
    begun, ended = (xp.take_along_axis(times, k[..., None], -1)[..., 0] for k in (before, after))
    return before, after, _fraction(xp, t, begun, ended)


def locate_in_rows(
    times: Float[np.ndarray, "rows knots"], row: Int[np.ndarray, "*batch"], t: Float[np.ndarray, "*batch"]
) -> tuple[Int[np.ndarray, "*batch"], Int[np.ndarray, "*batch"], Float[np.ndarray, "*batch"]]:
    """`locate(times[row], t)`, without an array of (*batch, knots)."""
    row, t = np.broadcast_arrays(row, t)
    last, before = times.shape[-1] - 1, np.empty(t.shape, np.int32)
    for number in np.unique(row):
        here = row == number
        before[here] = np.searchsorted(times[number], t[here], side="right") - 1
    before = np.clip(before, 0, max(last - 1, 0))
    after = np.minimum(before + 1, last)
    begun, ended = times[row, before], times[row, after]
    return before, after, _fraction(np, t, begun, ended)


def _fraction(xp, t, begun, ended):
    """The fraction of the way from `begun` to `ended`; where they are equal, 0 before them and 1 from them on."""
    span = ended - begun
    inside = xp.clip((t - begun) / xp.where(span > 0, span, 1), 0, 1)
    return xp.where(span > 0, inside, (t >= ended).astype(inside.dtype))
