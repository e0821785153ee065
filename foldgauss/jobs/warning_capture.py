"""`WarningCapture`: collects warnings by the thread that issues them."""

import threading
import warnings
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from typing import Any


class WarningCapture:
    """Collects warnings by thread: a worker may run two jobs at once, but `warnings.showwarning` is global."""

    def __init__(self) -> None:
        self._lock, self._installed, self._texts = threading.Lock(), ExitStack(), {}

    @contextmanager
    def capture(self) -> Iterator[list[str]]:
        """A list of the warnings that this thread issues within the block; other threads' are shown as usual."""
        number, texts = threading.get_ident(), []
        with self._lock:
            if not self._texts:
                self._installed.enter_context(warnings.catch_warnings())
                warnings.simplefilter("always")
                warnings.showwarning = partial(self._collect, warnings.showwarning)
            self._texts[number] = texts
        try:
            yield texts
        finally:
            with self._lock:
                del self._texts[number]
                if not self._texts:
                    self._installed.close()

    def _collect(self, show: Callable[..., Any], message: Warning | str, *where: Any, **more: Any) -> None:
        texts = self._texts.get(threading.get_ident())
        if texts is None:
            show(message, *where, **more)
        else:
            texts.append(" ".join(str(message).split()))
