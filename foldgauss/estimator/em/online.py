"""Online EM: sums of all batches so far, older ones forgotten slowly, kept in the frame of the present components.

**Source:** Cappé and Moulines 2009, On-line expectation-maximization algorithm for latent data models (a = 1 only:
there the sums are the sufficient statistics of every later frame too).
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from foldgauss._numerics.regression import hermite_to_powers
from foldgauss.envelope import Constant
from foldgauss.estimator.em.cholesky import inverse_lower
from foldgauss.estimator.em.components import Parameters, moved, to_powers
from foldgauss.estimator.em.statistics import Points, Statistics, accumulate
from foldgauss.estimator.em.updates import Model, updated

__all__ = ["FORGETTING", "batch_sums", "online_step", "seen_from"]

#: A batch counts for its share of all weight so far to this power: between 1/2 and 1 it converges.
FORGETTING = 0.7


@eqx.filter_jit
def batch_sums(params: Parameters, points: Points) -> Statistics:
    """The sums of one batch, as they stand."""
    return accumulate(params, Constant(), points)


@eqx.filter_jit
def online_step(
    params: Parameters, sums: Statistics, new: Statistics, model: Model, share: Float[Array, ""]
) -> tuple[Parameters, Statistics]:
    """A batch's sums weighed in with `share` (both are taken per unit of weight), and the components' update.

    Apart from `batch_sums`, so that this is compiled once, whatever the batches' sizes.
    """
    unit = lambda sums: jax.tree.map(lambda z: z / sums.mass.sum(), sums)  # noqa: E731
    sums = jax.tree.map(lambda old, new: (1 - share) * old + share * new, unit(sums), unit(new))
    after, _ = updated(params, sums, model)
    return after, seen_from(sums, params, after)


def seen_from(sums: Statistics, here: Parameters, there: Parameters) -> Statistics:
    """The same points' sums in the frame of other components: a linear map of (basis, residual)."""
    size, dim = here.degree + 1, here.tril.shape[-1]
    # v' = shift + ratio v
    shift = (there.time_loc - here.time_loc) / there.time_scale
    ratio = here.time_scale / there.time_scale
    to_hermite = jnp.asarray(np.linalg.inv(hermite_to_powers(here.degree)), shift.dtype)
    in_hermite = lambda powers: jnp.einsum("ij,kjc->kic", to_hermite, powers)  # noqa: E731
    eye = jnp.broadcast_to(jnp.eye(size, dtype=shift.dtype)[None], (len(shift), size, size))
    basis = in_hermite(moved(to_powers(eye), shift, ratio))  # column j: He_j(v') in Hermite polynomials of v
    apart = in_hermite(here.curve - moved(there.curve, shift, ratio))
    whitening = inverse_lower(there.tril)
    change = jnp.zeros((len(shift), size + dim, size + dim), shift.dtype)
    change = change.at[:, :size, :size].set(jnp.swapaxes(basis, 1, 2))
    change = change.at[:, size:, :size].set(jnp.einsum("kab,kjb->kaj", whitening, apart))
    change = change.at[:, size:, size:].set(jnp.einsum("kab,kbc->kac", whitening, here.tril))
    return sums._replace(
        first=shift * sums.mass + ratio * sums.first,
        second=shift**2 * sums.mass + 2 * shift * ratio * sums.first + ratio**2 * sums.second,
        gram=jnp.einsum("kab,okbc,kdc->okad", change, sums.gram, change),
    )
