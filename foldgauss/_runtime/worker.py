"""Setup of a local worker process. dask imports this module by name; it imports nothing else of the package."""

import signal


def dask_setup(worker: object) -> None:
    """Ignore Ctrl-C, which a terminal sends to all processes: the main process handles it and stops its workers."""
    del worker
    signal.signal(signal.SIGINT, signal.SIG_IGN)
