"""Online EM: decaying averages of the sufficient statistics of all batches, relative to the current components.

**Source:** Cappé and Moulines 2009, On-line expectation-maximization algorithm for latent data models (a = 1 only:
then statistics relative to one set of components can be converted to any other).
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from foldgauss._numerics.regression import hermite_to_powers
from foldgauss.estimator.em.cholesky import inverse_lower
from foldgauss.estimator.em.components import Parameters, change_variable, to_powers
from foldgauss.estimator.em.m_step import Model, update_components
from foldgauss.estimator.em.statistics import SufficientStatistics

__all__ = ["FORGETTING", "change_reference", "update_online"]

#: A batch is weighted by its fraction of all weight so far to this power; EM converges for values in (1/2, 1].
FORGETTING = 0.7


@eqx.filter_jit
def update_online(
    params: Parameters, sums: SufficientStatistics, new: SufficientStatistics, model: Model, fraction: Float[Array, ""]
) -> tuple[Parameters, SufficientStatistics]:
    """Average in a batch's statistics with weight `fraction` (both per unit of weight), and update the components.

    Separate from the sums of a batch, so that this is compiled once for batches of all sizes.
    """
    unit = lambda sums: jax.tree.map(lambda z: z / sums.mass.sum(), sums)  # noqa: E731
    sums = jax.tree.map(lambda old, new: (1 - fraction) * old + fraction * new, unit(sums), unit(new))
    after, _ = update_components(params, sums, model)
    return after, change_reference(sums, params, after)


def change_reference(sums: SufficientStatistics, here: Parameters, there: Parameters) -> SufficientStatistics:
    """Convert statistics relative to components `here` to components `there`: a linear map of (basis, residual)."""
    size, dim = here.degree + 1, here.tril.shape[-1]
    # v' = shift + ratio v
    shift = (there.time_loc - here.time_loc) / there.time_scale
    ratio = here.time_scale / there.time_scale
    to_hermite = jnp.asarray(np.linalg.inv(hermite_to_powers(here.degree)), shift.dtype)
    in_hermite = lambda powers: jnp.einsum("ij,kjc->kic", to_hermite, powers)  # noqa: E731
    eye = jnp.broadcast_to(jnp.eye(size, dtype=shift.dtype)[None], (len(shift), size, size))
    basis = in_hermite(change_variable(to_powers(eye), shift, ratio))  # column j: He_j(v') in Hermite polynomials of v
    offset = in_hermite(here.curve - change_variable(there.curve, shift, ratio))
    whitening = inverse_lower(there.tril)
    change = jnp.zeros((len(shift), size + dim, size + dim), shift.dtype)
    change = change.at[:, :size, :size].set(jnp.swapaxes(basis, 1, 2))
    change = change.at[:, size:, :size].set(jnp.einsum("kab,kjb->kaj", whitening, offset))
    change = change.at[:, size:, size:].set(jnp.einsum("kab,kbc->kac", whitening, here.tril))
    return sums._replace(
        first=shift * sums.mass + ratio * sums.first,
        second=shift**2 * sums.mass + 2 * shift * ratio * sums.first + ratio**2 * sums.second,
        gram=jnp.einsum("kab,okbc,kdc->okad", change, sums.gram, change),
    )
