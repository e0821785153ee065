"""What a worker of this machine does first. dask imports it by name, so it brings nothing else."""

import signal


def dask_setup(worker: object) -> None:
    """Leave Ctrl-C, which a terminal sends to all processes, to the one that gave out the jobs: it asks for an end."""
    del worker
    signal.signal(signal.SIGINT, signal.SIG_IGN)
