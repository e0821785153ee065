"""Evaluation of a fitted mixture at rows of X."""

import functools
import math
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from foldgauss._numerics.batch import compile_eager
from foldgauss.estimator.em.statistics import enable_dtype
from foldgauss.mixture import FoldedMixture

#: Rows are evaluated in blocks of a power of 2 from the first to the second, so that chunks of any size share programs.
_LEAST_ROWS = 2**8
_MOST_ROWS = 2**16
#: Blocks at least, where they are not the smallest: the last one is filled up.
_NUM_BLOCKS = 8


def evaluate_rows(method: Callable, mixture: FoldedMixture, y: Float[np.ndarray, "n d"]) -> np.ndarray:
    """Call a method of a mixture at scaled rows, in the dtype of the rows."""
    with enable_dtype(y.dtype):
        mixture = jax.tree.map(lambda z: jnp.asarray(z, y.dtype), mixture)
        return map_blocks(functools.partial(_call, method, mixture), y)


def map_blocks(function: Callable, y: Float[np.ndarray, "n d"]):
    """The arrays of a function of rows, called for blocks of them; the last block is filled up."""
    rows = min(max(2 ** math.ceil(math.log2(max(len(y) / _NUM_BLOCKS, 1))), _LEAST_ROWS), _MOST_ROWS)
    num_blocks = max(math.ceil(len(y) / rows), 1)
    blocks = np.split(np.pad(y, ((0, num_blocks * rows - len(y)), (0, 0))), num_blocks)
    parts = list(map(function, blocks))  # JAX returns before they are computed
    return jax.tree.map(lambda *parts: np.concatenate(parts)[: len(y)], *parts)


@compile_eager(static=("method",))
def _call(method: Callable, mixture: FoldedMixture, x: np.ndarray):
    """A method as one program, which is called with less overhead than its parts."""
    return method(mixture, x)
