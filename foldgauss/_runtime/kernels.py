"""How kernels are compiled: serial, without the GIL, kept on disk where that is possible."""

import contextlib
from collections.abc import Callable

import numba as nb
from numba.core.caching import FunctionCache

# Not "fast": NaN and infinity keep their meaning; sums may be reordered, which vector sums need.
_OPTIONS = {"error_model": "numpy", "fastmath": {"nsz", "contract", "reassoc", "arcp"}}

#: For small functions used inside kernels.
inline = nb.njit(inline="always", **_OPTIONS)


def kernel(function: Callable) -> Callable:
    """Compile `function` at its first call and keep the code beside its source, or in NUMBA_CACHE_DIR.

    Numba looks at the function's own file to tell whether kept code is stale: a constant from another module must be
    handed in as an argument. Where nothing can be written, or the disk is full, code is compiled anew by every process.
    """
    return _compiled(function, _OPTIONS)


def exact_kernel(function: Callable) -> Callable:
    """As `kernel`, but every operation is rounded as IEEE 754 says, in the order written: the same bits everywhere."""
    return _compiled(function, {"error_model": "numpy"})


class _Kept(FunctionCache):
    """Numba's own, but what cannot be written, on a disk that is full by now, is not kept, and that is all."""

    def save_overload(self, *compiled: object) -> None:
        with contextlib.suppress(OSError):
            super().save_overload(*compiled)


def _compiled(function: Callable, options: dict) -> Callable:
    dispatcher = nb.njit(nogil=True, **options)(function)
    with contextlib.suppress(RuntimeError):  # no place to keep it: a read-only installation with no home
        dispatcher._cache = _Kept(function)
    return dispatcher
