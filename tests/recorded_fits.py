"""Three tiny fits and their recorded digests: plain, growing and published.

The digests changed with the defaults; those of the growing and the published fit also with the uniform starts, and with
what the gradient of m_t clones. The plain fit is without the interpolated frames that are the default since.

python tests/recorded_fits.py   prints what test_recorded_fits.py compares with, as JSON
"""

import hashlib
import json
import platform
from importlib.metadata import version
from pathlib import Path

import jax
import numpy as np
from threadpoolctl import threadpool_info

from foldgauss.video import FitConfig, Growth, Views, compress, evaluate, fit

SIZE, NUM_FRAMES = (32, 48), 5
#: The default when the bits were recorded; of the radius in pixels nothing is pruned by default now.
GROWTH = Growth(prune_radius=20.0)
CONFIGS = {
    "plain": FitConfig(num_gaussians=120, steps=60, seed=2, views=Views(interpolation_fraction=0.0)),
    "growing": FitConfig.preset(
        "paper",
        num_gaussians=80,
        steps=120,
        seed=2,
        degree=3,
        **{"strategy.growth": GROWTH, "rates.final": 1.0},
        initialization="static",
    ),
    "published": FitConfig.preset("paper", num_gaussians=200, steps=150, **{"strategy.growth": GROWTH}),
    "compact": FitConfig(num_gaussians=120, steps=60, seed=2, views=Views(interpolation_fraction=0.0), quality=60),
}


def clip() -> np.ndarray:
    """A disc that moves over a slanted pattern, uint8 (num_frames, height, width, 3); no decoder takes part."""
    y, x = np.mgrid[: SIZE[0], : SIZE[1]].astype(np.int64)
    frames = []
    for k in range(NUM_FRAMES):
        ground = np.stack([(5 * x + 2 * k) % 256, (7 * y + x) % 256, (3 * x + 3 * y) % 256], axis=-1)
        inside = (x - 12 - 5 * k) ** 2 + (y - 16) ** 2 < 64
        frames.append(np.where(inside[..., None], np.array([240, 200, 40]), ground))
    return np.stack(frames).astype(np.uint8)


def digest(tree) -> str:
    """blake2b over all leaves: dtype, shape and bits."""
    state = hashlib.blake2b(digest_size=16)
    for leaf in jax.tree.leaves(tree):
        array = np.ascontiguousarray(leaf)
        state.update(f"{array.dtype}{array.shape}".encode() + array.tobytes())
    return state.hexdigest()


def machine() -> dict[str, str]:
    """What the bits of a fit depend on besides the code."""
    cpu = next((line for line in Path("/proc/cpuinfo").read_text().splitlines() if line.startswith("flags")), "")
    packages = {
        name: version(name)
        for name in ("jax", "jaxlib", "numba", "llvmlite", "numpy", "opencv-contrib-python-headless")
    }
    flags = hashlib.blake2b(cpu.encode(), digest_size=8).hexdigest()
    return {"cpu_flags": flags, "machine": platform.machine(), "python": platform.python_version(), **packages}


def record() -> dict:
    frames = clip()
    models = {name: fit(frames, config).model for name, config in CONFIGS.items()}
    models["compressed"] = compress(models["plain"], frames, quality=70, steps=60).model
    return {
        "machine": machine(),
        "blas": sorted(one["architecture"] for one in threadpool_info() if one["user_api"] == "blas"),
        "digests": {name: digest(model) for name, model in models.items()},
        "psnr": {name: round(evaluate(model, frames).mean_psnr, 3) for name, model in models.items()},
    }


if __name__ == "__main__":
    print(json.dumps(record(), indent=1))
