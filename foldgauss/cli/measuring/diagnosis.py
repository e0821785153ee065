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
from foldgauss._numerics.random_streams import Stream, make_generator
from foldgauss._runtime import threads
from foldgauss._runtime.device import default_platform
from foldgauss._runtime.machine import cpu_model
from foldgauss._runtime.threads import available_cores, num_threads
from foldgauss.io.media.reading import memory_limit
from foldgauss.render import ENGINES, RenderOptions, Splats2D, render
from foldgauss.render.api import choose_engine
from foldgauss.video.fitting.config import FitConfig
from foldgauss.video.fitting.loop import fit
from foldgauss.video.models.metrics import psnr

NAME = "foldgauss"
#: Scene and image size of the trials, largest difference between engines, the fit and its lowest PSNR in dB.
NUM_SPLATS, SIZE, MAX_DIFFERENCE = 60, (48, 64), 5e-3
TINY = FitConfig(num_gaussians=150, degree=2, steps=40)
MIN_PSNR = 20.0
#: The extras that are reported, by what they are for.
EXTRAS = {
    "samples": "sample clips",
    "plot": "plots of densities and fits",
    "uncertainty": "uncertainty of frame times",
    "sklearn": "the estimator",
    "numpyro": "to_numpyro",
    "distributed": "fits with several processes or a cluster",
}


class Trial(NamedTuple):
    """The result of a trial, as text in `message`, and its duration; compilation took `first_seconds` more."""

    name: str
    ok: bool
    seconds: float
    first_seconds: float
    message: str
    cure: str = ""


def collect_facts() -> dict[str, Any]:
    """The installed versions, the machine and the engines. An error is reported under "unknown"."""
    parts = {"versions": find_versions, "extras": find_extras, "machine": describe_machine, "engines": find_engines}
    return {name: _find_or_explain(find) for name, find in parts.items()}


def _find_or_explain(find: Callable[[], Any]) -> Any:
    try:
        return find()
    except Exception as error:
        return {"unknown": _short(error)}


def _short(error: BaseException) -> str:
    text = " ".join(str(error).split())[:300]
    return f"{type(error).__name__}: {text}" if text else type(error).__name__


def find_version(distribution: str) -> str | None:
    try:
        return importlib.metadata.version(distribution)
    except importlib.metadata.PackageNotFoundError:
        return None


def find_versions() -> dict[str, str | None]:
    """Versions of Python, of this package and of its dependencies; None: missing."""
    needed = {name for name, extra in _requirements() if extra is None} | {"jaxlib"}
    return {"python": platform.python_version(), NAME: __version__} | {
        name: find_version(name) for name in sorted(needed)
    }


def find_extras() -> dict[str, dict[str, str | None]]:
    """The packages of each optional extra with their versions; None: missing."""
    found: dict[str, dict[str, str | None]] = {}
    for name, extra in _requirements():
        if extra in EXTRAS:
            found.setdefault(extra, {})[name] = find_version(name)
    return found


def _requirements() -> Iterator[tuple[str, str | None]]:
    """Distributions that this package depends on, each with the extra that requires it, or None."""
    for line in importlib.metadata.requires(NAME) or ():
        name = re.match(r"[\w.-]+", line)[0]
        extra = re.search(r"extra == ['\"](\w+)['\"]", line)
        if name != NAME:
            yield name, extra and extra[1]


def describe_machine() -> dict[str, Any]:
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
        return "set by set_num_threads"
    if os.environ.get("FOLDGAUSS_NUM_THREADS") is not None:
        return "set by FOLDGAUSS_NUM_THREADS"
    return "one for each core that this process may use; see FOLDGAUSS_NUM_THREADS"


def _memory() -> tuple[float | None, float | None]:
    """Total and free memory in GiB; None if the system does not report it."""
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
    """The vector instructions that kernels are compiled for, by the names of LLVM."""
    from llvmlite import binding

    features = binding.get_host_cpu_features()
    known = ("avx512f", "avx2", "fma", "avx", "sse4.2", "sve", "neon")
    return " ".join(name for name in known if features.get(name)) or "unknown"


def find_engines() -> dict[str, Any]:
    devices = [f"{device.platform} {device.device_kind}" for device in jax.devices()]
    return {
        "engines": [name for name in ENGINES if name != "auto"],
        "jax_devices": sorted(set(devices)),
        "auto": choose_engine(RenderOptions(), np.dtype(np.float32)),
        "gpu": any(device.platform != "cpu" for device in jax.devices()),
    }


def moving_blob() -> np.ndarray:
    """Six frames of a bright spot that moves across the image, uint8 RGB."""
    height, width = SIZE
    y, x = np.mgrid[0:height, 0:width]
    t = np.linspace(0.25, 0.75, 6)[:, None, None]
    blob = np.exp(-((x - t * width) ** 2 + (y - height / 2) ** 2) / 60)
    return np.stack([255 * blob, 90 + 0 * blob, 200 - 150 * blob], -1).astype(np.uint8)


def run_trials() -> Iterator[Trial]:
    """Small trials of rendering and fitting. An error makes a trial fail."""
    images: dict[str, np.ndarray] = {}
    on_gpu = ("pallas",) if default_platform() == "gpu" else ()
    for engine in ("reference", "xla", "cpu", *on_gpu):
        yield _run_trial(f"render an image, engine {engine}", lambda engine=engine: _render(engine, images))
    yield _run_trial("fit a clip of 6 frames", _fit)


def _run_trial(name: str, attempt: Callable[[], str]) -> Trial:
    """Run twice: the first run compiles."""
    begun = time.perf_counter()
    try:
        attempt()
        again = time.perf_counter()
        message = attempt()
        seconds = time.perf_counter() - again
        return Trial(name, True, round(seconds, 3), round(max(again - begun - seconds, 0.0), 3), message)
    except _Failed as failed:
        return Trial(name, False, round(time.perf_counter() - begun, 3), 0.0, failed.message, failed.cure)
    except Exception as error:
        return Trial(name, False, round(time.perf_counter() - begun, 3), 0.0, _short(error), _REINSTALL)


_REINSTALL = (
    "Reinstall: pip install --force-reinstall foldgauss. If that does not help, report it with `doctor --json`."
)


class _Failed(Exception):
    def __init__(self, message: str, cure: str):
        super().__init__(message)
        self.message, self.cure = message, cure


def _scene() -> Splats2D:
    rng = make_generator(Stream.DIAGNOSIS)
    mean = rng.uniform(0, 1, (NUM_SPLATS, 2)) * [SIZE[1], SIZE[0]]
    factor = rng.normal(size=(NUM_SPLATS, 2, 2)) * 3 + 2 * np.eye(2)
    leaves = mean, factor, rng.uniform(0.2, 0.9, NUM_SPLATS), rng.uniform(0, 1, (NUM_SPLATS, 3))
    return Splats2D(*(jnp.asarray(leaf, jnp.float32) for leaf in leaves))


def _render(engine: str, images: dict[str, np.ndarray]) -> str:
    images[engine] = image = np.asarray(render(_scene(), SIZE, engine=engine))
    if not np.isfinite(image).all() or image.max() < 0.1:
        raise _Failed("the image is empty or not finite", _REINSTALL)
    if engine == "reference" or "reference" not in images:
        return "rendered"
    difference = float(np.abs(image - images["reference"]).max())
    if difference > MAX_DIFFERENCE:
        raise _Failed(
            f"expected a difference from engine reference of at most {MAX_DIFFERENCE:g}, got {difference:.2g}",
            _REINSTALL,
        )
    return f"as engine reference, to {difference:.1g}"


def _fit() -> str:
    frames = moving_blob()
    model = fit(frames, TINY).model
    got = float(np.mean([psnr(*pair) for pair in zip(frames, model.frames(), strict=True)]))
    if got < MIN_PSNR:
        raise _Failed(f"expected at least {MIN_PSNR:g} dB, got {got:.1f}", _REINSTALL)
    return f"{TINY.steps} steps, {got:.1f} dB"
