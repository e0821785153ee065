"""Evaluation of a fitted mixture at rows of X, in a form that can be sent to workers."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Int

from foldgauss.envelope import AbstractEnvelope
from foldgauss.estimator.em.components import Parameters, evaluate_densities
from foldgauss.estimator.em.scaling import Scaling
from foldgauss.estimator.em.statistics import Points, enable_dtype, make_blocks, map_chunks

__all__ = ["FittedParameters", "predict_components", "predict_log_prob", "predict_responsibilities"]


class FittedParameters(NamedTuple):
    """A fitted mixture in NumPy arrays."""

    params: Parameters
    envelope: AbstractEnvelope
    scaling: Scaling
    order: Int[np.ndarray, " d"]


def predict_log_prob(fitted: FittedParameters, x: np.ndarray) -> np.ndarray:
    value = _evaluate_rows(_log_densities, fitted, x)
    return (value if len(x) else value[:, 0]) - value.dtype.type(fitted.scaling.log_volume)


def predict_responsibilities(fitted: FittedParameters, x: np.ndarray) -> np.ndarray:
    return _evaluate_rows(_responsibilities, fitted, x)


def predict_components(fitted: FittedParameters, x: np.ndarray) -> np.ndarray:
    return predict_responsibilities(fitted, x).argmax(1)


def _evaluate_rows(function, fitted: FittedParameters, x: np.ndarray) -> np.ndarray:
    """Apply a compiled function of points to rows of X, in blocks of few shapes, so that all chunks share programs."""
    y = fitted.scaling.apply(x[:, fitted.order].astype(np.result_type(x, fitted.params.curve)))
    num = len(fitted.params.time_loc)
    with enable_dtype(y.dtype):
        params = Parameters(*(jnp.asarray(z, y.dtype) for z in fitted.params))
        blocks = make_blocks([(y, np.ones(len(y), y.dtype))], len(y), num)
        values = [np.asarray(function(params, fitted.envelope, block)) for block in blocks]
    return np.concatenate(values)[: len(y)] if values else np.zeros((0, num), y.dtype)


def _over_points(function):
    """The compiled function of points from one of the log-densities (n, k) of a chunk and the log-weights (k,)."""

    @eqx.filter_jit
    def of_points(params: Parameters, envelope: AbstractEnvelope, points: Points):
        def of_chunk(x):
            return function(evaluate_densities(params, envelope, x).log_density, params.log_weights)

        value = map_chunks(of_chunk, points.x)
        return value.reshape(-1, *value.shape[3:])

    return of_points


@_over_points
def _log_densities(log_density, log_weights):
    return jax.nn.logsumexp(log_density, axis=-1)


@_over_points
def _responsibilities(log_density, log_weights):
    """P(component | x); the weights where all densities underflow."""
    total = jax.nn.logsumexp(log_density, axis=-1, keepdims=True)
    reached = jnp.isfinite(total)
    responsibilities = jnp.exp(log_density - jnp.where(reached, total, 0))
    return jnp.where(reached, responsibilities, jnp.exp(log_weights)[None])
