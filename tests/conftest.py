"""House rules of the whole suite: promotion raises, so a shape or dtype slip is a failing test."""

import signal
import threading
from pathlib import Path

import jax
import pytest

# A shell starts what runs in its background without Ctrl-C, and our tests of Ctrl-C are heirs to that.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN and threading.current_thread() is threading.main_thread():
    signal.signal(signal.SIGINT, signal.default_int_handler)

#: Resident bytes of a worker beyond which it forgets what it compiled.
MOST_RESIDENT = 2 << 30

jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_numpy_dtype_promotion", "strict")


@pytest.fixture(autouse=True, scope="module")
def _forget_compiled_code():
    """What all modules compile comes to gigabytes in each worker; some of it serves several."""
    yield
    if _resident() > MOST_RESIDENT:
        jax.clear_caches()


def _resident() -> float:
    """Bytes of this process in memory; infinite where only Linux would tell."""
    status = Path("/proc/self/status")
    if not status.exists():
        return float("inf")
    return 1024 * int(next(line for line in status.read_text().splitlines() if line.startswith("VmRSS")).split()[1])
