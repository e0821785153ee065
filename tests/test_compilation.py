"""Compiled programs: few for many distributions and batch sizes, since each holds memory maps, and takes seconds."""

import os
import subprocess
import sys
import tracemalloc
from collections.abc import Callable
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array, Float

from foldgauss._numerics.batch import BatchModule, _compile_flat, map_over_batch
from foldgauss.distribution import FoldedGaussian
from foldgauss.fold import PolynomialFold

MAPS = Path("/proc/self/maps")


def _dist(degree, dim):
    fold = PolynomialFold(np.linspace(-0.5, 0.5, degree * dim, dtype=np.float32).reshape(degree, dim))
    scale = np.full(dim, 0.3, np.float32)
    return FoldedGaussian(np.zeros(dim, np.float32), scale=scale, time_loc=0.4, time_scale=0.3, fold=fold)


def _num_maps() -> int:
    return MAPS.read_text().count("\n")


@pytest.mark.skipif(not MAPS.exists(), reason="memory maps are read from /proc, which this system lacks")
def test_densities_of_many_structures_need_few_memory_maps():
    """A process may have 65,530; the kernels of an eager density would need about 110 for each structure."""
    structures = [_dist(degree, dim) for degree in (1, 2, 3) for dim in (1, 2)]
    structures[0].log_prob(np.zeros(2, np.float32))
    before = _num_maps()
    for i, dist in enumerate(structures):
        dist.log_prob(np.zeros((100 + i, *dist.event_shape), np.float32))
    assert (_num_maps() - before) / len(structures) < 40


COUNT_MAPS = """
import numpy as np
from pathlib import Path
from foldgauss.distribution import FoldedGaussian
from foldgauss.envelope import TimeLikelihood

def entropy(floor):
    dist = FoldedGaussian(np.zeros(2), np.eye(2), time_loc=0.4, time_scale=0.3, envelope=TimeLikelihood(floor=floor))
    return dist.entropy().block_until_ready()

entropy(0.0)
before = Path("/proc/self/maps").read_text().count("\\n")
entropy(0.1)
print(Path("/proc/self/maps").read_text().count("\\n") - before)
"""


@pytest.mark.slow
@pytest.mark.skipif(not MAPS.exists(), reason="memory maps are read from /proc, which this system lacks")
def test_a_program_of_an_integral_needs_few_memory_maps():
    """In a process of a user, without this suite's settings of XLA. By XLA's default this integral needs 200."""
    own = {name: x for name, x in os.environ.items() if name not in ("XLA_FLAGS", "JAX_DISABLE_MOST_OPTIMIZATIONS")}
    found = subprocess.run([sys.executable, "-c", COUNT_MAPS], env=own, capture_output=True, text=True, check=True)
    assert int(found.stdout) < 130


def test_integrals_of_an_envelope_share_a_program():
    """Whatever the fold, and the number of coordinates: neither is in E[log a]."""
    _compile_flat.cache_clear()
    for degree, dim in ((1, 1), (2, 3), (4, 2)):
        dist = _dist(degree, dim)
        eqx.tree_at(lambda dist: dist.envelope.floor, dist, jnp.full_like(dist.envelope.floor, 0.1)).entropy()
    assert _compile_flat.cache_info().currsize == 1


def _square(x):
    _square.traced.append(x.shape)
    return x**2


@pytest.mark.parametrize("shape", [(), (0,), (1,), (7,), (64,), (65,), (3, 50)])
def test_batches_of_any_size_are_mapped(shape):
    """Eagerly and traced; the padding adds nothing to values and gradients."""
    _square.traced = []
    x = jnp.arange(np.prod(shape, dtype=int), dtype=jnp.float32).reshape(shape)
    np.testing.assert_array_equal(map_over_batch(_square, (x, 0)), x**2)
    total = lambda x: map_over_batch(_square, (x, 0)).sum()  # noqa: E731
    np.testing.assert_array_equal(jax.jit(jax.grad(total))(x), 2 * x)
    assert all(traced == () for traced in _square.traced)


def _cube(x):
    _cube.traced.append(x.shape)
    return x**3


def test_few_programs_serve_all_batch_sizes():
    _cube.traced = []
    for size in range(1, 200, 6):
        map_over_batch(_cube, (np.ones(size, np.float32), 0))
    assert len(_cube.traced) == 3


def _scaled(table, x):
    return table[: len(x)] * x


def test_programs_that_are_not_used_any_more_are_dropped():
    """A process that makes many distributions, each with integrals of its own, would run out of memory maps."""
    for length in range(1, 40):
        map_over_batch(_scaled, (np.ones(100, np.float32), 1), (np.ones(length, np.float32), 1))
    kept = _compile_flat.cache_info()
    assert kept.currsize == kept.maxsize < 40


def _lookup(table, x):
    return table[0] + x


def test_what_a_batch_shares_is_not_copied_for_each_element():
    """Such as the path of a camera, which the Gaussians of a video share."""
    table, x = np.ones((1, 20_000), np.float32), np.arange(1000, dtype=np.float32)
    map_over_batch(_lookup, (table, 1), (x, 0))  # compiled
    tracemalloc.start()
    try:
        np.testing.assert_array_equal(map_over_batch(_lookup, (table, 1), (x, 0)), x + 1)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < 0.3 * table.nbytes * len(x)


class _Slanted(BatchModule):
    """A module with a function that may close over tracers."""

    x: Float[Array, "*batch"]
    function: Callable = eqx.field(static=True)


def _apply(module):
    return module.function(module.x)


@pytest.mark.parametrize("size", [5, 100])
def test_mapped_functions_may_close_over_tracers(size):
    total = lambda slope: map_over_batch(_apply, _Slanted(jnp.ones(size), lambda x: slope * x)).sum()  # noqa: E731
    assert jax.grad(total)(0.7) == size
