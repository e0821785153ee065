"""Precision matrices in scikit-learn's conventions: given ones to covariances, fitted components to precisions."""

import numpy as np
from jaxtyping import Float, Int

from foldgauss._runtime.checks import invalid
from foldgauss.estimator.parameter_checks import check_array

__all__ = ["invert_precisions", "unfolded_precisions"]


def invert_precisions(precisions, kind: str, num: int, dim: int) -> np.ndarray:
    """Covariances (k, d, d) from precisions in scikit-learn's shape for each kind of covariance."""
    shape = {"full": (num, dim, dim), "tied": (dim, dim), "diag": (num, dim), "spherical": (num,)}[kind]
    precisions = check_array("precisions_init", precisions, shape)
    eye = np.eye(dim)
    if kind == "spherical":
        precisions = precisions[:, None, None] * eye
    if kind == "diag":
        precisions = precisions[:, :, None] * eye
    precisions = np.broadcast_to(precisions, (num, dim, dim))
    symmetric = np.allclose(precisions, precisions.swapaxes(-1, -2))
    if not (symmetric and (np.linalg.eigvalsh(precisions) > 0).all()):
        raise invalid(
            "precisions_init", expected="symmetric and positive definite", got="others", cure="Invert covariances."
        )
    return np.linalg.inv(precisions)


def unfolded_precisions(
    space_factor: Float[np.ndarray, "k d-1 d-1"],
    time_scale: Float[np.ndarray, " k"],
    order: Int[np.ndarray, " d"],
    kind: str,
) -> tuple[np.ndarray, np.ndarray]:
    """(P, U), P = U U^T, of the block-diagonal covariances (L L^T, time_scale^2), given L^-1, in the columns of X.

    **Shapes:** (k, d, d) each with U upper-triangular; (k, d) for the kinds "diag" and "spherical".
    """
    num, dim = len(time_scale), len(order)
    factor = np.zeros((num, dim, dim), space_factor.dtype)
    # The space columns keep their order, and time is a block of its own: U stays triangular wherever time is.
    factor[:, order[:-1, None], order[:-1]] = space_factor.swapaxes(-1, -2)
    factor[:, order[-1], order[-1]] = 1 / time_scale
    if kind in ("diag", "spherical"):
        factor = np.diagonal(factor, axis1=1, axis2=2).copy()
        return factor**2, factor
    return factor @ factor.swapaxes(-1, -2), factor
