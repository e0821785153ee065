"""House rules of the whole suite: promotion raises, so a shape or dtype slip is a failing test."""

import signal
import threading

import jax
import pytest

# A shell starts what runs in its background without Ctrl-C, and our tests of Ctrl-C are heirs to that.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN and threading.current_thread() is threading.main_thread():
    signal.signal(signal.SIGINT, signal.default_int_handler)

jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_numpy_dtype_promotion", "strict")


@pytest.fixture(autouse=True, scope="module")
def _forget_compiled_code():
    """What one module compiled the next hardly needs (7% of it): kept, it comes to gigabytes in each worker."""
    yield
    jax.clear_caches()
