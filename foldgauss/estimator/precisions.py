"""Precision matrices in scikit-learn's conventions: given ones to covariances, and covariances to precisions."""

import numpy as np
from jaxtyping import Float

from foldgauss._runtime.checks import invalid
from foldgauss.estimator.parameter_checks import check_array

__all__ = ["factor_precisions", "invert_precisions"]


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


def factor_precisions(covariances: Float[np.ndarray, "k d d"]) -> Float[np.ndarray, "k d d"]:
    """Upper-triangular U with U U^T the inverses of the covariances. Raises LinAlgError for singular ones."""
    inverse = np.linalg.inv(np.linalg.cholesky(covariances))  # lower triangular up to rounding, by some LAPACK
    return np.tril(inverse).swapaxes(-1, -2)
