"""Folded-Gaussians as numpyro objects. This is not the |X| folded normal of scipy and numpyro.

Their `foldnorm` and `FoldedDistribution` reflect a variable at 0. Here a Gaussian's *center* is bent along a curve
in time, and nothing is reflected. numpyro is imported when it is asked for.
"""

import functools
from typing import TYPE_CHECKING, Any, ClassVar

from foldgauss._runtime.optional_imports import import_optional
from foldgauss.analysis.divergence import kl_divergence

if TYPE_CHECKING:
    import numpyro

__all__ = ["to_numpyro"]


def to_numpyro(dist: Any, *, validate_args: bool | None = None) -> "numpyro.distributions.Distribution":
    """`dist` as a numpyro distribution, differentiable in its parameters: for models, NUTS and SVI.

    For anything here with `log_prob`, `sample`, `batch_shape`, `event_shape` and `has_rsample`. Parameters may be
    traced, so it can be built inside a model out of other sample sites; pass `validate_args=False` to the distribution
    there if its factor is assembled from them. As a *latent* site a time likelihood makes a funnel (space narrows as
    time moves away), which is hard for NUTS: sample a normal z there and use `dist.normal_to_fold(z)`.

    **Shapes:** `batch_shape` and `event_shape` are those of `dist`; the support is all of R^d. Draws of mixtures are
    not reparametrized (`has_rsample` is False).

    `validate_args` warns of values out of the support; None is numpyro's own setting (`numpyro.enable_validation`).
    Parameters are checked where `dist` is constructed.
    The methods `entropy`, `cdf`, `icdf` and `mode` call those of `dist`.
    If it has none, they raise NotImplementedError, by which numpyro's own distributions say so.
    `numpyro.distributions.kl_divergence` of two of them is `foldgauss.analysis.divergence.kl_divergence`.

    **Example:**

        def model(x):
            bend = numpyro.sample("bend", numpyro.distributions.Normal(0.0, 1.0))
            fold = PolynomialFold(bend[None, None])
            dist = FoldedGaussian([0.0], [[0.2]], time_loc=0.5, time_scale=0.3, fold=fold)
            numpyro.sample("x", to_numpyro(dist), obs=x)

    **Source:** eq:foldgauss. **Raises:** ImportError that names the extra if numpyro is missing.
    """
    distributions = import_optional("numpyro", "numpyro").distributions
    return _make_class(distributions)(dist, validate_args=validate_args)


@functools.cache
def _make_class(distributions) -> type:
    from numpyro.distributions.batch_util import promote_batch_shape
    from numpyro.distributions.kl import kl_divergence as numpyro_divergence
    from numpyro.distributions.util import validate_sample

    class NumpyroDistribution(distributions.Distribution):
        """A foldgauss distribution with numpyro's interface. It has no list of parameters, which `base` has checked."""

        pytree_data_fields = ("base",)
        arg_constraints: ClassVar[dict] = {}

        def __init__(self, base, *, validate_args=None):
            self.base = base
            super().__init__(base.batch_shape, base.event_shape, validate_args=validate_args)

        def __reduce__(self):
            return _blank_numpyro, (), self.__dict__  # the class is local, which pickle cannot find

        @property
        def has_rsample(self):
            return getattr(self.base, "has_rsample", False)

        @property
        def support(self):
            return distributions.constraints.real_vector

        def sample(self, key, sample_shape=()):
            return self.base.sample(key, sample_shape)

        @validate_sample
        def log_prob(self, value):
            return self.base.log_prob(value)

        @property
        def mean(self):
            return self.base.mean

        @property
        def variance(self):
            return self.base.variance

        @property
        def mode(self):
            return _part(self.base, "mode")

        def entropy(self):
            return _part(self.base, "entropy")

        def cdf(self, value):
            return _part(self.base, "cdf", value)

        def icdf(self, q):
            return _part(self.base, "icdf", q)

    @promote_batch_shape.register(NumpyroDistribution)
    def _(dist):
        return NumpyroDistribution(dist.base)

    @numpyro_divergence.register(NumpyroDistribution, NumpyroDistribution)
    def _(p, q):
        try:
            return kl_divergence(p.base, q.base)
        except ValueError as error:
            raise NotImplementedError(str(error)) from error  # numpyro then estimates by samples

    return NumpyroDistribution


def _blank_numpyro():
    """An instance without state, for pickle."""
    made = _make_class(import_optional("numpyro", "numpyro").distributions)
    return made.__new__(made)


def _part(dist: Any, name: str, *arguments):
    """A property, or the result of a method. Where `dist` has none, raises as numpyro's distributions do."""
    try:
        found = getattr(dist, name)
        return found(*arguments) if callable(found) else found
    except (AttributeError, ValueError) as error:
        told = f"{name}: expected a distribution that has one, got {type(dist).__name__}. {error}"
        raise NotImplementedError(told) from error  # numpyro's signal that a distribution lacks a method
