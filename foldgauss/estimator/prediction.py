"""Evaluation of a fitted mixture at rows of X, in a form that can be sent to workers."""

import functools
import math
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from foldgauss._numerics.batch import compile_eager
from foldgauss.estimator.em.scaling import Scaling
from foldgauss.estimator.em.statistics import enable_dtype
from foldgauss.mixture import FoldedMixture

#: Rows are evaluated in blocks of a power of 2 from the first to the second, so that chunks of any size share programs.
_LEAST_ROWS = 2**8
_MOST_ROWS = 2**16
#: Blocks at least, where they are not the smallest: the last one is filled up.
_NUM_BLOCKS = 8


class FittedMixture(NamedTuple):
    """A mixture of scaled rows, in NumPy arrays, and how rows of X become such."""

    mixture: FoldedMixture
    scaling: Scaling
    order: Int[np.ndarray, " d"]


def predict_log_prob(fitted: FittedMixture, x: Float[np.ndarray, "n d"]) -> Float[np.ndarray, " n"]:
    value = _evaluate_rows(FoldedMixture.log_prob, fitted, x)
    return value - value.dtype.type(fitted.scaling.log_volume)


def predict_responsibilities(fitted: FittedMixture, x: Float[np.ndarray, "n d"]) -> Float[np.ndarray, "n k"]:
    return _evaluate_rows(FoldedMixture.responsibilities, fitted, x)


def predict_components(fitted: FittedMixture, x: Float[np.ndarray, "n d"]) -> Int[np.ndarray, " n"]:
    return predict_responsibilities(fitted, x).argmax(1)


def _evaluate_rows(method: Callable, fitted: FittedMixture, x: np.ndarray) -> np.ndarray:
    """A method of the mixture at rows of X."""
    y = fitted.scaling.apply(x[:, fitted.order].astype(np.result_type(x, fitted.mixture.logits)))
    with enable_dtype(y.dtype):
        mixture = jax.tree.map(lambda z: jnp.asarray(z, y.dtype), fitted.mixture)
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
