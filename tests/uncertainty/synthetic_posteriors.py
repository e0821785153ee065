"""Synthetic posteriors of frame times: independent draws, without images and sampler."""

import numpy as np

from foldgauss.uncertainty import (
    FrameNoise,
    FrameTimeLogProb,
    FrameTimePosterior,
    LikelihoodProfiles,
    ProfileCurves,
    exact_posterior,
)


def posterior_about(times, std=0.02, *, concentration=1.0, shape=(4, 25, 10), seed=0) -> FrameTimePosterior:
    """Likelihoods of frames are Gaussians about `times` of standard deviation `std` frames (one, or one per frame)."""
    num = len(times)
    std = np.broadcast_to(np.asarray(std, float), num) / (num - 1)
    nodes = [np.unique(np.clip(np.concatenate([np.linspace(0, 1, 60), t + s * np.linspace(-7, 7, 57)]), 0, 1))
             for t, s in zip(times, std, strict=True)]  # fmt: skip
    values = [-0.5 * ((at - t) / s) ** 2 for at, t, s in zip(nodes, times, std, strict=True)]
    noise = FrameNoise(np.full(num, 0.02), np.full(num, 0.1))
    curves = ProfileCurves.from_nodes(nodes, values)
    profiles = LikelihoodProfiles(curves, noise, np.zeros(num), 0.7 ** np.arange(12.0), 100)
    exact = exact_posterior(curves, concentration)
    draws = exact.sample(int(np.prod(shape)), seed).reshape(*shape, num)
    ones = np.ones(num - 2)
    return FrameTimePosterior(
        FrameTimeLogProb(curves, concentration), profiles, exact, draws, np.full(shape[0], 0.3), 40 * ones,
        1.001 * ones, 1000 * ones, True, "Converged.",
    )  # fmt: skip
