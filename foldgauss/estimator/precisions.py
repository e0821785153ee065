"""Initial values and precision matrices in scikit-learn's conventions."""

import numpy as np

from foldgauss._runtime.checks import require
from foldgauss.envelope import Constant
from foldgauss.estimator.em.components import Parameters
from foldgauss.estimator.em.initialization import params_from_gaussians
from foldgauss.estimator.em.scaling import Scaling, to_mixture
from foldgauss.estimator.parameter_checks import check_array


def replace_initial(estimator, params: Parameters, scaling: Scaling, degree: int) -> Parameters:
    """Replace the initial values that `weights_init`, `means_init` and `precisions_init` of the estimator define."""
    given = (estimator.weights_init, estimator.means_init, estimator.precisions_init)
    if all(z is None for z in given):
        return params
    num, dtype = len(params.time_loc), params.curve.dtype
    mixture = to_mixture(params, scaling, Constant())
    means, covariances = (np.asarray(z, np.float64) for z in mixture.components.moments())
    weights = np.exp(np.asarray(params.log_weights, np.float64))
    dim = means.shape[1]
    order = estimator._order_columns(dim)
    if estimator.weights_init is not None:
        weights = check_array("weights_init", estimator.weights_init, (num,))
        require(
            (weights >= 0).all() and np.isclose(weights.sum(), 1),
            "weights_init",
            expected="weights with sum 1",
            got=weights.tolist(),
            cure="Divide by the sum.",
        )
    if estimator.means_init is not None:
        means = check_array("means_init", estimator.means_init, (num, dim))[:, order]
    if estimator.precisions_init is not None:
        covariances = _invert_precisions(estimator.precisions_init, estimator.covariance_type, num, dim)
        covariances = covariances[:, order][:, :, order]
    scale = scaling.scale
    return params_from_gaussians(
        weights, (means - scaling.shift) / scale, covariances / (scale[:, None] * scale), degree, dtype
    )


def _invert_precisions(precisions, kind: str, num: int, dim: int) -> np.ndarray:
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
    require(
        symmetric and (np.linalg.eigvalsh(precisions) > 0).all(),
        "precisions_init",
        expected="symmetric and positive definite",
        got="others",
        cure="Invert covariances.",
    )
    return np.linalg.inv(precisions)
