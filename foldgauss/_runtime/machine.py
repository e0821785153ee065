"""The facts that timings depend on: processor, cores, threads, load, and versions of packages."""

import importlib.metadata
import os
import platform
from pathlib import Path

from foldgauss._runtime.threads import available_cores, num_threads

_PACKAGES = ("jax", "jaxlib", "numba", "numpy", "optax")


def describe_machine() -> dict[str, object]:
    """Properties that timings depend on, without host or user names; `load_average` is that of the last minute."""
    return {
        "cpu": cpu_model(),
        "cores": available_cores(),
        "threads": num_threads(),
        "load_average": load_average(),
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
        **{name: importlib.metadata.version(name) for name in _PACKAGES},
    }


def load_average() -> float | None:
    return round(os.getloadavg()[0], 2) if hasattr(os, "getloadavg") else None


def cpu_model() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:  # not Linux
        return platform.processor() or "unknown"
    names = (line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    return next(names, "unknown")
