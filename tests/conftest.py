"""House rules of the whole suite: promotion raises, so a shape or dtype slip is a failing test."""

import gc
import os
import shutil
import signal
import sys
import tempfile
import threading
from importlib.metadata import version
from pathlib import Path

# What is compiled is kept for the run, for all its processes: most modules compile the same small functions. It must be
# set before JAX is imported; the workers of pytest-xdist inherit it.
_CACHE = "JAX_COMPILATION_CACHE_DIR"
_own_cache = None if _CACHE in os.environ else os.environ.setdefault(_CACHE, tempfile.mkdtemp(prefix="foldgauss-jax-"))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
# Most of the time goes into XLA's compilation, which takes a quarter less like this. `.ci/slow` runs with optimization.
os.environ.setdefault("JAX_DISABLE_MOST_OPTIMIZATIONS", "1")
# XLA's older code generator compiles in half the time. A flag that it does not know ends the process, so only here.
if os.environ["JAX_DISABLE_MOST_OPTIMIZATIONS"] == "1" and version("jaxlib").startswith("0.10."):
    _flags, _own_flags = os.environ.get("XLA_FLAGS", ""), "--xla_cpu_use_fusion_emitters=false"
    if _own_flags not in _flags:  # the workers inherit them
        os.environ["XLA_FLAGS"] = f"{_flags} {_own_flags} --xla_cpu_parallel_codegen_split_count=1".strip()
# The suite has a process for each core already: further threads of BLAS only wait for each other.
for _name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")
# Many tests start processes of Python, which would compile the package anew where bytecode is not written.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
sys.dont_write_bytecode = False

import jax  # noqa: E402
import pytest  # noqa: E402
from hypothesis import settings  # noqa: E402

from foldgauss._numerics import batch  # noqa: E402

# A shell starts what runs in its background without Ctrl-C, and our tests of Ctrl-C are heirs to that.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN and threading.current_thread() is threading.main_thread():
    signal.signal(signal.SIGINT, signal.default_int_handler)

# Tracing makes many objects that live on: collecting them as often as by default takes a twentieth of the time.
gc.freeze()
gc.set_threshold(200_000, 50, 50)

jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_numpy_dtype_promotion", "strict")
# The same examples in every run, so that a test fails by a change and not by its draw. `.ci/slow` draws others.
settings.register_profile("same", derandomize=True)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "same"))


@pytest.fixture(scope="module")
def optimized():
    """Compiled as for users from here to the end of the module, for what depends on the last bits."""
    _clear_caches()
    before = jax.config.read("jax_disable_most_optimizations")
    jax.config.update("jax_disable_most_optimizations", False)
    yield
    jax.config.update("jax_disable_most_optimizations", before)
    _clear_caches()


@pytest.fixture
def x64():
    with jax.enable_x64(True):
        yield


def _clear_caches():
    jax.clear_caches()
    batch._compile_flat.cache_clear()


#: The files that take longest. They are begun first, so that no process works on one of them when all others are done.
LONGEST = (
    "video/test_rate.py",
    "test_distribution_conditional.py",
    "test_guides.py",
    "io/test_wild_videos.py",
    "test_estimator.py",
    "test_batch_shapes.py",
    "render/test_engines.py",
    "io/test_frame_index.py",
    "video/test_follow_camera.py",
    "video/test_resuming.py",
    "test_tradeoff.py",
    "test_distribution_moments.py",
    "video/test_fit.py",
    "video/test_extremes.py",
    "test_reliability_threads.py",
    "video/test_own_parts.py",
    "io/test_player_chunks.py",
)


def pytest_collection_modifyitems(items):
    place = {Path(__file__).parent / name: number for number, name in enumerate(LONGEST)}
    items.sort(key=lambda item: place.get(item.path, len(LONGEST)))


def pytest_unconfigure():
    if _own_cache is not None:
        shutil.rmtree(_own_cache, ignore_errors=True)


@pytest.fixture(autouse=True, scope="module")
def _forget_compiled_code():
    """What one module compiled the next hardly needs (7% of it): kept, it comes to gigabytes in each worker."""
    yield
    _clear_caches()
