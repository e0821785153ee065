"""What `doctor` reports: facts about the installation, and trials of rendering and fitting."""

import importlib.metadata
import os
import platform
import re
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from foldgauss import __version__
from foldgauss._runtime import threads
from foldgauss._runtime.machine import cpu_model
from foldgauss._runtime.threads import available_cores, num_threads
from foldgauss.io.media.resizing import memory_limit
from foldgauss.render import ENGINES, Splats2D, render
from foldgauss.video.fitting.config import FitConfig
from foldgauss.video.fitting.loop import fit
from foldgauss.video.models.metrics import psnr

NAME = "foldgauss"
#: Scene and image size of the trials, largest difference between engines, and the fit.
NUM_SPLATS, SIZE, ALIKE = 60, (48, 64), 5e-3
TINY = FitConfig(num_gaussians=150, degree=2, steps=40)
LEAST_PSNR = 20.0


class Trial(NamedTuple):
    """What was tried, whether it went well, and how long it took; `first_seconds` more went into compilation."""

    name: str
    ok: bool
    seconds: float
    first_seconds: float
    told: str
    cure: str = ""


def facts() -> dict[str, Any]:
    """What is installed and what this machine has. Never raises: what cannot be found out is told so."""
    asked = {
        "versions": versions,
        "extras": extras,
        "machine": machine,
        "engines": engines,
    }
    return {name: _told(find) for name, find in asked.items()}


def _told(find: Callable[[], Any]) -> Any:
    try:
        return find()
    except Exception as error:
        return {"unknown": _short(error)}


def _short(error: BaseException) -> str:
    text = " ".join(str(error).split())[:300]
    return f"{type(error).__name__}: {text}" if text else type(error).__name__


def version_of(distribution: str) -> str | None:
    try:
        return importlib.metadata.version(distribution)
    except importlib.metadata.PackageNotFoundError:
        return None


def versions() -> dict[str, str | None]:
    """Python's, this package's, and those of all that it cannot do without; None: missing."""
    needed = {name for name, extra in _requirements() if extra is None} | {"jaxlib"}
    return {"python": platform.python_version(), NAME: __version__} | {
        name: version_of(name) for name in sorted(needed)
    }


def extras() -> dict[str, dict[str, str | None]]:
    """Of each extra that users want, its packages."""
    found: dict[str, dict[str, str | None]] = {}
    for name, extra in _requirements():
        if extra in ("samples", "plot", "uncertainty", "numpyro", "sklearn"):
            found.setdefault(extra, {})[name] = version_of(name)
    return found


def _requirements() -> Iterator[tuple[str, str | None]]:
    """Distributions that this package asks for, each with the extra that asks, or None."""
    for line in importlib.metadata.requires(NAME) or ():
        name = re.match(r"[\w.-]+", line)[0]
        extra = re.search(r"extra == ['\"](\w+)['\"]", line)
        if name != NAME:
            yield name, extra and extra[1]


def machine() -> dict[str, Any]:
    total, free = _memory()
    return {
        "system": platform.platform(),
        "processor": cpu_model(),
        "instructions": _instructions(),
        "cores_present": os.cpu_count(),
        "cores_usable": available_cores(),
        "threads": num_threads(),
        "threads_because": _why_threads(),
        "memory_gib": total,
        "memory_free_gib": free,
        "largest_clip_gib": round(memory_limit() / 2**30, 1),
    }


def _why_threads() -> str:
    if threads._num_threads is not None:
        return "set_num_threads said so"
    if os.environ.get("FOLDGAUSS_NUM_THREADS") is not None:
        return "FOLDGAUSS_NUM_THREADS says so"
    return "one for each core that this process may use; FOLDGAUSS_NUM_THREADS changes it"


def _memory() -> tuple[float | None, float | None]:
    """GiB of memory, and of it what is free now, where the system tells."""
    try:
        lines = Path("/proc/meminfo").read_text().splitlines()
        sizes = {line.partition(":")[0]: int(line.split()[1]) / 2**20 for line in lines}
        return round(sizes["MemTotal"], 1), round(sizes["MemAvailable"], 1)
    except (OSError, KeyError, ValueError, IndexError):
        pass
    try:
        return round(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30, 1), None
    except (AttributeError, ValueError, OSError):
        return None, None


def _instructions() -> str:
    """The widest that kernels are compiled for, by LLVM's names."""
    from llvmlite import binding

    features = binding.get_host_cpu_features()
    known = ("avx512f", "avx2", "fma", "avx", "sse4.2", "sve", "neon")
    return " ".join(name for name in known if features.get(name)) or "none that is told"


def engines() -> dict[str, Any]:
    devices = [f"{device.platform} {device.device_kind}" for device in jax.devices()]
    backend = jax.default_backend()
    return {
        "engines": [name for name in ENGINES if name != "auto"],
        "jax_devices": sorted(set(devices)),
        "auto": "cpu" if backend == "cpu" else "xla",
        "gpu": any(device.platform not in ("cpu",) for device in jax.devices()),
    }


def moving_blob(num_frames: int = 6) -> np.ndarray:
    """A bright spot on its way across a picture, uint8 RGB."""
    height, width = SIZE
    y, x = np.mgrid[0:height, 0:width]
    t = np.linspace(0.25, 0.75, num_frames)[:, None, None]
    blob = np.exp(-((x - t * width) ** 2 + (y - height / 2) ** 2) / 60)
    return np.stack([255 * blob, 90 + 0 * blob, 200 - 150 * blob], -1).astype(np.uint8)


def trials() -> Iterator[Trial]:
    """Small trials of rendering and fitting. An error makes a trial fail."""
    drawn: dict[str, np.ndarray] = {}
    for engine in ("reference", "xla", "cpu"):
        yield _tried(f"render an image, engine {engine}", lambda engine=engine: _draw(engine, drawn))
    yield _tried("fit a clip of 6 frames", _fit)


def _tried(name: str, attempt: Callable[[], str]) -> Trial:
    """Run twice: the first run compiles."""
    begun = time.perf_counter()
    try:
        attempt()
        again = time.perf_counter()
        told = attempt()
        seconds = time.perf_counter() - again
        return Trial(name, True, round(seconds, 3), round(max(again - begun - seconds, 0.0), 3), told)
    except _Failed as failed:
        return Trial(name, False, round(time.perf_counter() - begun, 3), 0.0, failed.told, failed.cure)
    except Exception as error:
        return Trial(name, False, round(time.perf_counter() - begun, 3), 0.0, _short(error), _REINSTALL)


_REINSTALL = "Reinstall: pip install --force-reinstall foldgauss. If that is no cure, report it with `doctor --json`."


class _Failed(Exception):
    def __init__(self, told: str, cure: str):
        super().__init__(told)
        self.told, self.cure = told, cure


def _scene() -> Splats2D:
    rng = np.random.default_rng(0)
    mean = rng.uniform(0, 1, (NUM_SPLATS, 2)) * [SIZE[1], SIZE[0]]
    factor = rng.normal(size=(NUM_SPLATS, 2, 2)) * 3 + 2 * np.eye(2)
    leaves = mean, factor, rng.uniform(0.2, 0.9, NUM_SPLATS), rng.uniform(0, 1, (NUM_SPLATS, 3))
    return Splats2D(*(jnp.asarray(leaf, jnp.float32) for leaf in leaves))


def _draw(engine: str, drawn: dict[str, np.ndarray]) -> str:
    drawn[engine] = picture = np.asarray(render(_scene(), SIZE, engine=engine))
    if not np.isfinite(picture).all() or picture.max() < 0.1:
        raise _Failed("the image is empty, or not finite", _REINSTALL)
    if engine == "reference" or "reference" not in drawn:
        return "rendered"
    apart = float(np.abs(picture - drawn["reference"]).max())
    if apart > ALIKE:
        raise _Failed(f"{apart:.2g} away from engine reference, at most {ALIKE:g} was expected", _REINSTALL)
    return f"as engine reference, to {apart:.1g}"


def _fit() -> str:
    frames = moving_blob()
    model = fit(frames, TINY).model
    got = float(np.mean([psnr(*pair) for pair in zip(frames, model.frames(), strict=True)]))
    if got < LEAST_PSNR:
        raise _Failed(f"{got:.1f} dB, at least {LEAST_PSNR:g} were expected", _REINSTALL)
    return f"{TINY.steps} steps, {got:.1f} dB"
