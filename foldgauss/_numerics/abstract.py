"""The interface that all distributions and mixtures share."""

from abc import abstractmethod
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

from foldgauss._numerics.batch import BatchModule, as_event, as_sample_shape, batch_shape_of, ranked_leaves


class AbstractDistribution(BatchModule):
    """A distribution with leading batch dimensions, of points with the shape `event_shape`.

    A class defines `_log_prob` and `_sample`, whose arguments are checked, and `moments`. Components of a mixture also
    have `marginal`, `condition` and `log_evidence`.
    """

    has_rsample: ClassVar[bool] = True  #: draws are differentiable in the parameters

    @property
    @abstractmethod
    def event_shape(self) -> tuple[int, ...]:
        """The shape of one point, (d,)."""

    @property
    def batch_shape(self) -> tuple[int, ...]:
        """Broadcast leading dimensions of all leaves."""
        return batch_shape_of(ranked_leaves(self))

    @property
    def dtype(self):
        return jax.tree.leaves(self)[0].dtype

    def log_prob(self, value: Float[Array, "..."]) -> Float[Array, "*#batch"]:
        """The log-density, finite or -inf, and never NaN for finite values.

        **Shapes:** value (*sample, *batch, *event), time (if any) last -> (*sample, *batch). **Units:** log of
        1 / (space^(d-1) time).

        **Example:** `dist.log_prob(jnp.array([0.1, -0.2, 0.5]))`

        **Raises:** ValueError if the last dimension of value is not that of the event shape.
        """
        return self._log_prob(self._checked(value))

    def pdf(self, value: Float[Array, "..."]) -> Float[Array, "*#batch"]:
        """The density, shapes as in `log_prob`."""
        return jnp.exp(self.log_prob(value))

    def sample(self, key: Key[Array, ""], sample_shape: int | tuple[int, ...] = ()) -> Float[Array, "..."]:
        """Random samples, differentiable in the parameters if `has_rsample`.

        **Shapes:** -> (*sample_shape, *batch, *event), time last; a number n as `sample_shape` is (n,).

        **Example:** `dist.sample(jax.random.key(0), 1000)`
        """
        return self._sample(key, as_sample_shape(sample_shape))

    @abstractmethod
    def moments(self) -> tuple[Float[Array, "*batch n"], Float[Array, "*batch n n"]]:
        """Mean and covariance matrix."""

    @property
    def mean(self) -> Float[Array, "..."]:
        """E x, as `moments`."""
        return self.moments()[0]

    @property
    def covariance_matrix(self) -> Float[Array, "*batch n n"]:
        """Cov x of all coordinates jointly, as `moments`."""
        return self.moments()[1]

    @property
    def variance(self) -> Float[Array, "..."]:
        """Var x per coordinate, as `moments`."""
        return jnp.diagonal(self.covariance_matrix, axis1=-2, axis2=-1)

    @property
    def stddev(self) -> Float[Array, "..."]:
        """Standard deviations of the coordinates."""
        return jnp.sqrt(self.variance)

    def log_evidence(self, indices: tuple[int, ...], values: Array, rest: "AbstractDistribution") -> Array:
        """The log-density of the values of these coordinates; `rest` is the distribution given them."""
        order = np.argsort(indices)  # puts time last
        return self.marginal(np.asarray(indices)[order]).log_prob(values[..., order])

    def _checked(self, value, name: str = "value") -> Array:
        return as_event(name, value, self.dtype, self.event_shape)

    def _sample_from(self, key: Key[Array, ""], sample_shape: tuple[int, ...], component: Array) -> Array:
        """A sample of one of the components, which are the last batch axis: here of those that all are drawn from."""
        every = self.sample(key, sample_shape)
        return jnp.take_along_axis(every, component[..., None, None], axis=component.ndim).squeeze(component.ndim)
