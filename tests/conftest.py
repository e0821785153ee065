"""House rules of the whole suite: promotion raises, so a shape or dtype slip is a failing test."""

import jax
import pytest

jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_numpy_dtype_promotion", "strict")


@pytest.fixture(autouse=True, scope="module")
def _forget_compiled_code():
    """What one module compiled the next does not need: kept, it comes to gigabytes in each worker."""
    yield
    jax.clear_caches()
