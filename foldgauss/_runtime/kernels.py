"""Compilation of Numba kernels: serial, without the GIL, cached on disk where possible."""

import contextlib
from collections.abc import Callable

import numba as nb
from numba.core.caching import FunctionCache

# Not "fast": NaN and infinity keep their meaning; sums may be reordered, which vectorized sums need.
_OPTIONS = {"error_model": "numpy", "fastmath": {"nsz", "contract", "reassoc", "arcp"}}

#: For functions used inside kernels. (A kernel that calls another has a copy of it, which LLVM optimizes in its place:
#: which copy runs, and with it the last bits of sums, depends on whether kernels are compiled or loaded.)
inline = nb.njit(inline="always", **_OPTIONS)


def kernel(function: Callable) -> Callable:
    """Compile `function` at its first call and cache the code beside its source, or in NUMBA_CACHE_DIR.

    Numba checks only the function's own file for changes: a constant from another module must be passed as an argument.
    Where the cache cannot be written, every process compiles again.
    """
    return _compile(function, _OPTIONS)


def exact_kernel(function: Callable) -> Callable:
    """As `kernel`, but operations follow IEEE 754 in the order written: the same bits on every machine."""
    return _compile(function, {"error_model": "numpy"})


class _TolerantCache(FunctionCache):
    """Numba's cache, ignoring errors of writing, such as a full disk."""

    def save_overload(self, *compiled: object) -> None:
        with contextlib.suppress(OSError):
            super().save_overload(*compiled)


def _compile(function: Callable, options: dict) -> Callable:
    dispatcher = nb.njit(nogil=True, **options)(function)
    with contextlib.suppress(RuntimeError):  # no place for the cache: a read-only installation without a home directory
        dispatcher._cache = _TolerantCache(function)
    return dispatcher
