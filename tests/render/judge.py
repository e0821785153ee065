"""The judge of all engines: `reference` in double precision, compiled once for all scenes and options."""

import dataclasses
import math
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np

from foldgauss.render import Splats2D
from foldgauss.render.footprint import pixel_centers
from foldgauss.render.reference import render_reference, splat_alpha

#: What every scene is made up to: by splats that are nowhere visible, black channels, and pixels that are cut off.
NUM, CHANNELS, CANVAS = 150, 11, (50, 70)
NAMES = ("mean", "factor", "opacity", "color", "background")


def _numbers(options):
    """Options as numbers that compiled code takes."""
    own = {name: getattr(options, name) for name in ("alpha_cutoff", "alpha_ceiling", "low_pass", "transmittance_stop")}
    own["support_radius"] = math.inf if options.support_radius is None else options.support_radius
    return {name: np.float64(value) for name, value in own.items()}


def _padded(leaves):
    mean, factor, opacity, *colors = (np.asarray(leaf, np.float64) for leaf in leaves)
    more, others = NUM - len(opacity), CHANNELS - colors[0].shape[1]
    factor = np.concatenate([factor, np.tile(np.eye(2), (more, 1, 1))])
    colors = [np.pad(one, [(0, more)] * (one.ndim - 1) + [(0, others)]) for one in colors]
    return np.pad(mean, [(0, more), (0, 0)]), factor, np.pad(opacity, (0, more)), *colors


@jax.jit
def _alphas(leaves, numbers):
    centers = pixel_centers(CANVAS, jnp.float64)
    return jax.lax.map(lambda one: splat_alpha(one, centers, SimpleNamespace(**numbers)), Splats2D(*leaves))


def alphas(leaves, size, options):
    """Of every splat at every pixel, (num, *size); leaves are mean, factor, opacity, color."""
    with jax.enable_x64(True):
        return np.asarray(_alphas(_padded(leaves), _numbers(options)))[: len(leaves[2]), : size[0], : size[1]]


def near_a_threshold(leaves, size, options):
    """Pixels where an alpha is so near to where it is dropped, capped or stopped that float32 may fall either way."""
    raw = alphas(leaves, size, dataclasses.replace(options, alpha_cutoff=1e-8, alpha_ceiling=1.0, support_radius=None))
    near = np.abs(raw / options.alpha_cutoff - 1) < 1e-4
    if options.support_radius is not None:
        edge = np.asarray(leaves[2], np.float64)[:, None, None] * np.exp(-(options.support_radius**2) / 2)
        with np.errstate(divide="ignore", invalid="ignore"):
            near |= np.abs(raw / edge - 1) < 1e-4
    if options.alpha_ceiling < 1:
        near |= np.abs(raw / options.alpha_ceiling - 1) < 1e-5
    light = np.cumprod(1 - alphas(leaves, size, options), axis=0)
    # With stop 0 the light never falls to it but where an alpha is 1 exactly, which both sides see.
    stop = options.transmittance_stop
    return (near | (np.abs(light - stop) < 1e-3 * stop)).any(axis=0)


@jax.jit(static_argnames="compositing")
def _grads_and_picture(leaves, weights, numbers, compositing):
    def loss(leaves):
        options = SimpleNamespace(**numbers)
        picture = render_reference(Splats2D(*leaves[:4]), CANVAS, leaves[4], compositing=compositing, options=options)
        return jnp.sum(picture * weights), picture

    return jax.grad(loss, has_aux=True)(leaves)


def grads_and_picture(leaves, size, weights, compositing, options):
    """Gradients of <picture, weights>, and the picture; leaves are mean, factor, opacity, color, background."""
    num, channels = np.shape(leaves[3])
    more = [(0, whole - own) for whole, own in zip((*CANVAS, CHANNELS), np.shape(weights), strict=True)]
    weights = np.pad(np.asarray(weights, np.float64), more)
    with jax.enable_x64(True):
        grads, picture = _grads_and_picture(_padded(leaves), weights, _numbers(options), compositing)
    *geometry, color, background = map(np.asarray, grads)
    grads = [*(leaf[:num] for leaf in geometry), color[:num, :channels], background[:channels]]
    return grads, np.asarray(picture)[: size[0], : size[1], :channels]


def check(grads, picture, avoid, true_grads, truth, *, tolerance=2e-5, band=math.inf):
    """Assert that pictures and gradients agree; at the pixels to avoid, the picture within the band."""
    difference = np.abs(np.asarray(picture) - truth)
    assert difference[~avoid].max(initial=0) <= 1e-5 * max(1.0, np.abs(truth).max())
    assert difference[avoid].max(initial=0) <= band
    for name, one, other in zip(NAMES, jax.tree.leaves(grads), true_grads, strict=True):
        size_of = max(1.0, np.abs(other).max(initial=0))
        np.testing.assert_allclose(one / size_of, other / size_of, atol=tolerance, err_msg=name)
