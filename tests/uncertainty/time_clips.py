"""Helpers of the tests of frame times: curves with known posteriors, a small model and clips of it."""

import functools

import numpy as np
from soft_models import soft_model

from foldgauss.uncertainty import FrameNoise, Increments, ProfileCurves
from foldgauss.uncertainty.likelihood.residuals import Residuals

SIZE, NUM_FRAMES, SCALE = (24, 32), 10, 0.02


def parabolas(means, widths, num_nodes: int = 201) -> ProfileCurves:
    """Gaussian log-likelihoods of the times of all frames but the first and the last, which are flat."""
    nodes, flat = np.linspace(0, 1, num_nodes), np.zeros(num_nodes)
    inner = [-((nodes - m) ** 2) / (2 * w**2) for m, w in zip(means, widths, strict=True)]
    return ProfileCurves.from_nodes([nodes] * (len(inner) + 2), [flat, *inner, flat])


def free_times(num_frames: int, concentration: float = 1.0) -> Increments:
    return Increments(np.linspace(0, 1, num_frames), None, concentration)


def exact_cdfs(found):
    """The distribution functions of an `ExactPosterior`'s marginals."""
    for edges, masses in zip(found.edges, found.masses, strict=True):
        summed = np.append(0, np.cumsum(masses))
        yield lambda t, edges=edges, summed=summed: np.interp(t, edges, summed)


@functools.cache
def model():
    return soft_model(size=SIZE)


def uneven(num_frames: int = NUM_FRAMES, seed: int = 3) -> np.ndarray:
    """Times at uneven, but not tiny, steps."""
    steps = np.random.default_rng(seed).uniform(0.5, 1.5, num_frames - 1)
    return np.concatenate([[0.0], np.cumsum(steps) / steps.sum()]).clip(0, 1)


def clip(times, scale: float = SCALE, seed: int = 0, of=None) -> np.ndarray:
    """8-bit images of the model at `times`, with white noise."""
    of = model() if of is None else of
    residuals = Residuals(of, np.zeros((3, *of.size, 3), np.uint8))
    pictures = np.moveaxis(np.stack(list(residuals.render_at(times))), 1, -1)
    noisy = pictures + scale * np.random.default_rng(seed).standard_normal(pictures.shape)
    return np.clip(np.rint(255 * noisy), 0, 255).astype(np.uint8)


def white(scale: float = SCALE) -> FrameNoise:
    return FrameNoise(scale, 1.0)
