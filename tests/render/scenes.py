"""Random splats of every temper, for the engines to agree on; and what their gradients must be."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from foldgauss.render import Splats2D, render
from foldgauss.render.camera import THICKNESS, Gaussians3D

#: name: (number, smallest and largest standard deviation in px, lowest and highest opacity, picture size). Most are of
#: one number and size, so that they are compiled once.
KINDS = {
    "plain": (150, (1.0, 6.0), (0.05, 1.0), (50, 70)),
    "tiny": (150, (0.01, 0.5), (0.2, 1.0), (48, 64)),  # whole tiles
    "huge": (150, (40.0, 400.0), (0.01, 0.12), (50, 70)),
    "needles": (150, (0.2, 40.0), (0.1, 1.0), (50, 70)),
    "opaque": (150, (3.0, 12.0), (0.97, 1.0), (50, 70)),
    "faint": (150, (1.0, 6.0), (0.0, 0.02), (50, 70)),
    "one pixel": (20, (1.0, 6.0), (0.05, 1.0), (1, 1)),
    "one row": (40, (1.0, 6.0), (0.05, 1.0), (1, 65)),
    "curtain": (150, (20.0, 60.0), (0.9, 1.0), (50, 70)),  # all light is taken early: lists are cut
    "giant": (150, (1e6, 1e8), (0.005, 0.03), (50, 70)),
    "one": (1, (3.0, 4.0), (0.8, 0.9), (17, 16)),
    "none": (0, (1.0, 2.0), (0.1, 1.0), (20, 30)),
}


def scene(kind: str = "plain", *, seed: int = 0, dtype=np.float32) -> tuple[Splats2D, tuple[int, int]]:
    num, scales, opacities, (height, width) = KINDS[kind]
    rng = np.random.default_rng([seed, list(KINDS).index(kind)])
    mean = rng.uniform(-0.1, 1.1, (num, 2)) * [width, height]
    scale = np.exp(rng.uniform(*np.log(scales), (num, 1, 2)))
    angle = rng.uniform(0, 2 * np.pi, num)
    cos, sin = np.cos(angle), np.sin(angle)
    turn = np.stack([np.stack([cos, -sin], -1), np.stack([sin, cos], -1)], -2)
    leaves = mean, turn * scale, rng.uniform(*opacities, num), rng.uniform(0, 1, (num, 3))
    return Splats2D(*(jnp.asarray(leaf, dtype) for leaf in leaves)), (height, width)


@jax.jit
def from_scale_angle(mean, scale, angle, opacity, color, *, thickness=THICKNESS) -> Gaussians3D:
    """Flat Gaussians by MiraGe's parameters, F = R(angle) diag(s1, s2, thickness) (VeGaS eq:mirage)."""
    cos, sin = jnp.cos(angle), jnp.sin(angle)
    turn = jnp.stack([jnp.stack([cos, -sin], -1), jnp.stack([sin, cos], -1)], -2)
    return Gaussians3D.from_flat(Splats2D(mean, turn * scale[..., None, :], opacity, color), thickness=thickness)


#: A picture as one compiled program.
draw = jax.jit(render, static_argnames=("size", "compositing", "engine", "options", "return_alpha", "return_depth"))


def check_slopes(loss, splats: Splats2D, leaves: tuple[str, ...], *, rtol: float) -> None:
    """The gradient of a loss by each of the leaves, along a random direction, against finite differences."""
    value_and_gradient = jax.jit(jax.value_and_grad(loss))
    _, gradient = value_and_gradient(splats)
    for name in leaves:
        own, leaf = (np.asarray(getattr(tree, name)) for tree in (gradient, splats))
        direction = np.random.default_rng(3).normal(size=own.shape)
        above, below = (
            value_and_gradient(dataclasses.replace(splats, **{name: jnp.asarray(leaf + step * direction)}))[0]
            for step in (1e-5, -1e-5)
        )
        np.testing.assert_allclose(np.sum(own * direction), (above - below) / 2e-5, rtol=rtol, err_msg=name)
