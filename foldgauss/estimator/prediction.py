"""Evaluation of a fitted mixture at rows of X, in a form that can be sent to workers."""

from collections.abc import Iterable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Int

from foldgauss.envelope import AbstractEnvelope
from foldgauss.estimator.chunks import Piece
from foldgauss.estimator.em.components import Parameters, evaluate_densities
from foldgauss.estimator.em.scaling import Scaling
from foldgauss.estimator.em.statistics import Points, enable_dtype, log_densities, make_blocks

__all__ = [
    "FittedParameters",
    "compute_log_densities",
    "compute_responsibilities",
    "predict_components",
    "predict_log_prob",
    "predict_responsibilities",
    "sum_log_prob",
]


class FittedParameters(NamedTuple):
    """A fitted mixture in NumPy arrays."""

    params: Parameters
    envelope: AbstractEnvelope
    scaling: Scaling
    order: Int[np.ndarray, " d"]


def predict_log_prob(fitted: FittedParameters, x: np.ndarray) -> np.ndarray:
    value = _evaluate_rows(compute_log_densities, fitted, x)
    return (value if len(x) else value[:, 0]) - value.dtype.type(fitted.scaling.log_volume)


def predict_responsibilities(fitted: FittedParameters, x: np.ndarray) -> np.ndarray:
    return _evaluate_rows(compute_responsibilities, fitted, x)


def predict_components(fitted: FittedParameters, x: np.ndarray) -> np.ndarray:
    return predict_responsibilities(fitted, x).argmax(1)


def sum_log_prob(pieces: Iterable[Piece], fitted: FittedParameters) -> tuple[float, int]:
    """The sum of log p(x) over all pieces, and the number of their rows."""
    total, num = 0.0, 0
    for x, _ in pieces:
        total, num = total + float(predict_log_prob(fitted, x).sum(dtype=np.float64)), num + len(x)
    return total, num


def _evaluate_rows(function, fitted: FittedParameters, x: np.ndarray) -> np.ndarray:
    """Apply a compiled function of points to rows of X, in blocks of few shapes, so that all chunks share programs."""
    y = fitted.scaling.apply(x[:, fitted.order].astype(np.result_type(x, fitted.params.curve)))
    num = len(fitted.params.time_loc)
    with enable_dtype(y.dtype):
        params = Parameters(*(jnp.asarray(z, y.dtype) for z in fitted.params))
        blocks = make_blocks([(y, np.ones(len(y), y.dtype))], len(y), num)
        values = [np.asarray(function(params, fitted.envelope, block)) for block in blocks]
    return np.concatenate(values)[: len(y)] if values else np.zeros((0, num), y.dtype)


compute_log_densities = eqx.filter_jit(log_densities)


@eqx.filter_jit
def compute_responsibilities(params: Parameters, envelope: AbstractEnvelope, points: Points):
    """P(component | x) of every point, padding included; the weights where all densities underflow."""

    def of_chunk(x):
        log_density = evaluate_densities(params, envelope, x).log_density
        total = jax.nn.logsumexp(log_density, axis=-1, keepdims=True)
        reached = jnp.isfinite(total)
        responsibilities = jnp.exp(log_density - jnp.where(reached, total, 0))
        return jnp.where(reached, responsibilities, jnp.exp(params.log_weights)[None])

    responsibilities = lax.map(of_chunk, points.x.reshape(-1, *points.x.shape[2:]))
    return responsibilities.reshape(-1, responsibilities.shape[-1])
