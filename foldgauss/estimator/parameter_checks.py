"""Validation of the parameters of `FoldedGaussianMixture`; all errors name the parameter."""

import jax
import numpy as np

from foldgauss._runtime.checks import check_one_of, is_integer, require, short_repr
from foldgauss.envelope import AbstractEnvelope, Constant, TimeLikelihood, as_envelope, check_peak
from foldgauss.fold import PolynomialFold
from foldgauss.mixture import FoldedMixture

_ENVELOPES = {"constant": Constant, "time_likelihood": lambda: TimeLikelihood(power=1.0, floor=1e-3)}


def check_parameters(estimator) -> None:
    """Raise ValueError naming the first parameter that is out of its bounds."""
    estimator._validate_params()
    make_envelope(estimator.envelope)
    most = len(jax.devices())
    require(
        estimator.devices <= most,
        "devices",
        expected=f"at most {most}",
        got=estimator.devices,
        cure="See jax.devices().",
    )


def check_start(start, n_components, degree: int, num_columns: int) -> None:
    """Raise unless EM can start from this mixture."""
    require(
        isinstance(start, FoldedMixture)
        and start.logits.ndim == 1
        and isinstance(start.components.fold, PolynomialFold),
        "start",
        expected="one FoldedMixture with polynomial folds",
        got=short_repr(start),
        cure="Such as `to_mixture()` of an earlier fit.",
    )
    num, dim, own = start.num_components, start.event_shape[0], start.components.fold.degree
    require(
        n_components in ("auto", num) and dim == num_columns and own <= degree,
        "start",
        expected=f"{n_components} components of {num_columns} coordinates, of at most degree {degree}",
        got=f"{num} of {dim} coordinates, of degree {own}",
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
    known = "" if names is None else f", or one of {', '.join(names)}"
    require(
        is_integer(index, -num_columns) and index < num_columns,
        parameter,
        expected=f"a column of {num_columns}{known}",
        got=repr(column),
        cure="-1 is the last. Names need a data frame.",
    )
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


def make_envelope(envelope) -> AbstractEnvelope:
    """The envelope itself, that of a function, or the one with this name. Raises ValueError for anything else."""
    if isinstance(envelope, str):
        check_one_of("envelope", envelope, tuple(_ENVELOPES))
        return _ENVELOPES[envelope]()
    require(
        isinstance(envelope, AbstractEnvelope) or (callable(envelope) and not isinstance(envelope, type)),
        "envelope",
        expected=f"an envelope, a function (t, time_loc, time_scale) -> log a, or one of {', '.join(_ENVELOPES)}",
        got=short_repr(envelope),
    )
    envelope = as_envelope(envelope)
    check_peak(envelope, 0.0, 1.0)
    return envelope
