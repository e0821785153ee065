"""What `doctor` finds out: facts about this installation, and trials of what a user does first."""

import importlib.metadata
import os
import platform
import re
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import jax
import jax.numpy as jnp
import numpy as np
from numba.core.dispatcher import Dispatcher

from foldgauss import __version__
from foldgauss._runtime import threads
from foldgauss._runtime.machine import cpu_model
from foldgauss._runtime.threads import available_cores, num_threads
from foldgauss.io.datasets import sample_clip
from foldgauss.io.media.resizing import memory_limit
from foldgauss.io.media.video_reading import read_video
from foldgauss.io.media.video_writing import write_video
from foldgauss.io.models.video_model import load_video_model, save_video_model
from foldgauss.render import ENGINES, Splats2D, render
from foldgauss.video.fitting.config import FitConfig
from foldgauss.video.fitting.loop import fit
from foldgauss.video.models.metrics import psnr

NAME = "foldgauss"
#: Of each codec, the code that OpenCV knows it by and the ending of a file that holds it.
CODECS = {"VP9": ("vp09", ".mp4"), "VP8": ("VP80", ".webm"), "MPEG-4": ("mp4v", ".mp4"), "H.264": ("avc1", ".mp4")}
#: Of the trials: what they draw, how far engines may differ (float32; more at a splat's very edge), what they fit.
NUM_SPLATS, SIZE, ALIKE = 60, (48, 64), 5e-3
TINY = FitConfig(num_gaussians=150, degree=2, steps=40)
LEAST_PSNR, LEAST_CLIP_PSNR = 20.0, 25.0


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
        "kernels": kernels,
        "folders": folders,
        "codecs": codecs,
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


def kernels() -> dict[str, Any]:
    """Where compiled kernels are kept between runs, whether that can be written, and what is there."""
    modules = [module for name, module in list(sys.modules.items()) if name.startswith(f"{NAME}.")]
    known = [one for module in modules for one in vars(module).values() if isinstance(one, Dispatcher)]
    places = sorted({one.stats.cache_path for one in known if one.stats.cache_path})
    kept = [file for place in places for file in Path(place).glob("*.nbc")]
    return {
        "folders": {place: _writable(Path(place)) for place in places},
        "kept": len(kept),
        "bytes": sum(file.stat().st_size for file in kept),
    }


def folders() -> dict[str, str]:
    """Whether a file can be written where outputs and temporary files go: "writable", or why not."""
    return {
        name: _writable(place) for name, place in (("here", Path.cwd()), ("temporary", Path(tempfile.gettempdir())))
    }


def _writable(folder: Path) -> str:
    if not folder.is_dir():
        return "not there yet"
    try:
        with tempfile.TemporaryFile(dir=folder) as file:
            file.write(bytes(4096))
    except OSError as error:
        return f"{folder}: {error.strerror or error}"
    return "writable"


def codecs() -> dict[str, dict[str, bool | None]]:
    """Of each codec whether OpenCV writes it here, and whether it reads it; None: nothing to try that on."""
    found = {}
    with tempfile.TemporaryDirectory() as folder, _no_log():
        for name, (code, suffix) in CODECS.items():
            path = Path(folder) / f"{code}{suffix}"
            written = _wrote(path, code)
            found[name] = {"writes": written, "reads": _reads(path) if written else None}
        if found["H.264"]["reads"] is None:
            with suppress(FileNotFoundError):  # the samples are an extra
                found["H.264"]["reads"] = _reads(sample_clip("bunny"))
    return found


def _wrote(path: Path, code: str) -> bool:
    try:
        writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*code), 12.0, (64, 48))
        for picture in moving_blob(3):
            writer.write(np.ascontiguousarray(picture[..., ::-1]))
        writer.release()
    except cv2.error:
        return False
    return path.is_file() and _reads(path)


def _reads(path: Path) -> bool:
    capture = cv2.VideoCapture(str(path))
    try:
        return bool(capture.read()[0])
    finally:
        capture.release()


@contextmanager
def _no_log() -> Iterator[None]:
    """OpenCV and FFmpeg say on standard error what they cannot do; here that is the answer, and we tell it."""
    sys.stderr.flush()
    kept, nowhere = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 2)
    try:
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nowhere)


def moving_blob(num_frames: int = 6) -> np.ndarray:
    """A bright spot on its way across a picture, uint8 RGB."""
    height, width = SIZE
    y, x = np.mgrid[0:height, 0:width]
    t = np.linspace(0.25, 0.75, num_frames)[:, None, None]
    blob = np.exp(-((x - t * width) ** 2 + (y - height / 2) ** 2) / 60)
    return np.stack([255 * blob, 90 + 0 * blob, 200 - 150 * blob], -1).astype(np.uint8)


def trials() -> Iterator[Trial]:
    """What a user does first, small. None raises: an error is a trial that failed."""
    drawn: dict[str, np.ndarray] = {}
    for engine in ("reference", "xla", "cpu"):
        yield _tried(f"draw a picture, engine {engine}", lambda engine=engine: _draw(engine, drawn))
    frames, made = moving_blob(), []
    yield _tried("fit a clip of 6 frames", lambda: _fit(frames, made))
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        yield _tried("write a model and read it", lambda: _keep_model(Path(folder), made))
        yield _tried("write a clip and read it", lambda: _keep_clip(Path(folder), frames))


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
        raise _Failed("the picture is empty, or holds what is no number", _REINSTALL)
    if engine == "reference" or "reference" not in drawn:
        return "drawn"
    apart = float(np.abs(picture - drawn["reference"]).max())
    if apart > ALIKE:
        raise _Failed(f"{apart:.2g} away from engine reference, at most {ALIKE:g} was expected", _REINSTALL)
    return f"as engine reference, to {apart:.1g}"


def _fit(frames: np.ndarray, made: list) -> str:
    made[:] = [fit(frames, TINY).model]
    got = float(np.mean([psnr(*pair) for pair in zip(frames, made[0].frames(), strict=True)]))
    if got < LEAST_PSNR:
        raise _Failed(f"{got:.1f} dB, at least {LEAST_PSNR:g} were expected", _REINSTALL)
    return f"{TINY.steps} steps, {got:.1f} dB"


def _keep_model(folder: Path, made: list) -> str:
    if not made:
        raise _Failed("there is no model, since the fit failed", "See the fit, above.")
    path = save_video_model(folder / "model.safetensors", made[0])
    again = load_video_model(path)
    if not all(map(np.array_equal, made[0].frames(), again.frames())):
        raise _Failed("the model that was read draws other pictures", _REINSTALL)
    return f"{path.stat().st_size:,} bytes, the same pictures"


def _keep_clip(folder: Path, frames: np.ndarray) -> str:
    path = write_video(folder / "clip.mp4", frames, 12.0)
    clip = read_video(path)
    if clip.frames.shape != frames.shape:
        raise _Failed(f"shape {clip.frames.shape} was read, {frames.shape} was written", _CODEC)
    got = float(np.mean([psnr(*pair) for pair in zip(frames, clip.frames, strict=True)]))
    if got < LEAST_CLIP_PSNR:
        raise _Failed(f"{got:.1f} dB, at least {LEAST_CLIP_PSNR:g} were expected", _CODEC)
    return f"VP9, {got:.1f} dB"


_CODEC = "Write folders of images instead (a name without extension), or reinstall opencv-contrib-python-headless."
