"""Validation of the parameters of `FoldedGaussianMixture`; all errors name the parameter."""

from numbers import Integral

import jax
import numpy as np

from foldgauss._runtime.checks import check_one_of, invalid, require, short_repr
from foldgauss.envelope import AbstractEnvelope, Constant, TimeLikelihood, as_envelope, check_peak

_ENVELOPES = {"constant": Constant, "time_likelihood": lambda: TimeLikelihood(power=1.0, floor=1e-3)}


def check_parameters(estimator) -> None:
    """Raise ValueError naming the first parameter that is out of its bounds."""
    estimator._validate_params()
    make_envelope(estimator.envelope)
    if estimator.devices > len(jax.devices()):
        expected, cure = f"at most {len(jax.devices())}", "See jax.devices()."
        raise invalid("devices", expected=expected, got=estimator.devices, cure=cure)
    initial = (estimator.weights_init, estimator.means_init, estimator.precisions_init)
    require(
        estimator.n_components != "auto" or all(value is None for value in initial),
        "n_components",
        expected="a number where initial values are given",
        got='"auto"',
        cure="Pass their number.",
    )


def check_sizes(num_columns: int, num_points: int, total: float, least: int) -> None:
    """Raise unless there are a time and a space column, positive weights, and at least `least` points."""
    require(
        num_columns >= 2,
        "X",
        expected="at least 2 columns",
        got=f"n_features = {num_columns}",
        cure="One column is time; at least one of space is needed.",
    )
    require(total > 0, "sample_weight", expected="a positive sum", got="0", cure="Rows of weight 0 are left out.")
    require(
        num_points >= least,
        "n_components",
        expected=f"at most the number of points (n_samples = {num_points})",
        got=least,
        cure='Fewer components, or n_components="auto".',
    )


def check_column(column, num_columns: int, names=None, parameter: str = "time_column") -> int:
    """The index of a column, not negative, given by index or by its name in a data frame with these `names`."""
    index = list(names).index(column) if names is not None and column in list(names) else column
    if not isinstance(index, Integral) or isinstance(index, bool) or not -num_columns <= index < num_columns:
        known = f", or one of {', '.join(names)}" if names is not None else ""
        cure = "-1 is the last." if names is not None or not isinstance(column, str) else "Names need a data frame."
        raise invalid(parameter, expected=f"a column of {num_columns}{known}", got=repr(column), cure=cure)
    return int(index) % num_columns


def check_real(name: str, X) -> None:
    """Raise if rows hold dates, durations or complex numbers, which other libraries convert or report at length."""
    of_list = np.asarray(X).dtype if isinstance(X, list | tuple) else None
    for kind in map(str, np.ravel(np.asarray(getattr(X, "dtypes", getattr(X, "dtype", of_list)), object))):
        require(
            not kind.lower().startswith(("date", "time", "duration", "complex")),
            name,
            expected="real numbers",
            got=kind,
            cure="Convert times to seconds, from an origin near them. Complex data not supported: pass two columns.",
        )


def check_array(name: str, value, shape: tuple[int, ...]) -> np.ndarray:
    """`value` as a finite float64 array of this shape."""
    value = np.asarray(value, np.float64)
    require(np.isfinite(value).all(), name, expected="finite numbers", got="NaN or infinity")
    require(
        value.shape == shape,
        name,
        expected=f"shape {shape}",
        got=f"shape {value.shape}",
        cure="One entry per component.",
    )
    return value


def make_envelope(envelope) -> AbstractEnvelope:
    """The envelope itself, that of a function, or the one with this name. Raises ValueError for anything else."""
    if isinstance(envelope, str):
        check_one_of("envelope", envelope, tuple(_ENVELOPES))
        return _ENVELOPES[envelope]()
    if isinstance(envelope, type) or not (callable(envelope) or isinstance(envelope, AbstractEnvelope)):
        expected = f"an envelope, a function (t, time_loc, time_scale) -> log a, or one of {', '.join(_ENVELOPES)}"
        raise invalid("envelope", expected=expected, got=short_repr(envelope))
    envelope = as_envelope(envelope)
    check_peak(envelope, 0.0, 1.0)
    return envelope
