"""Random splats of every temper, for the engines to agree on; and what their gradients must be."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from foldgauss.render import Splats2D

#: name: (number, smallest and largest standard deviation in px, lowest and highest opacity, picture size)
KINDS = {
    "plain": (150, (1.0, 6.0), (0.05, 1.0), (50, 70)),
    "tiny": (200, (0.01, 0.5), (0.2, 1.0), (33, 47)),
    "huge": (30, (40.0, 400.0), (0.05, 0.6), (40, 56)),
    "needles": (80, (0.2, 40.0), (0.1, 1.0), (64, 48)),
    "opaque": (300, (3.0, 12.0), (0.97, 1.0), (40, 40)),
    "faint": (100, (1.0, 6.0), (0.0, 0.02), (32, 32)),
    "one pixel": (20, (1.0, 6.0), (0.05, 1.0), (1, 1)),
    "one row": (40, (1.0, 6.0), (0.05, 1.0), (1, 65)),
    "curtain": (600, (20.0, 60.0), (0.9, 1.0), (40, 40)),  # all light is taken early: lists are cut
    "giant": (6, (1e6, 1e8), (0.1, 0.5), (20, 20)),
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


def check_slope(loss, splats: Splats2D, leaf: str, *, rtol: float) -> None:
    """The gradient of a loss by one leaf, along a random direction, against finite differences."""
    gradient = getattr(jax.grad(loss)(splats), leaf)
    direction = jnp.asarray(np.random.default_rng(3).normal(size=gradient.shape))

    def along(step):
        return loss(dataclasses.replace(splats, **{leaf: getattr(splats, leaf) + step * direction}))

    numeric = (along(1e-5) - along(-1e-5)) / 2e-5
    np.testing.assert_allclose(jnp.sum(gradient * direction), numeric, rtol=rtol)
