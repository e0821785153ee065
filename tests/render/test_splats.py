"""Model space to pixels."""

import jax.numpy as jnp
import numpy as np
import pytest

from foldgauss.render import Splats2D, pixels_per_unit


@pytest.mark.parametrize(
    ("size", "aspect", "unit"),
    [
        ((160, 320), 0.5, 320),  # the frame's own shape: the longer side is 1
        ((320, 160), 2.0, 320),
        ((320, 320), 0.5, 640),  # a square picture of a wide frame: its height fills the picture
        ((100, 400), 0.5, 400),  # a flatter picture: its width does
    ],
)
def test_pixels_per_unit(size, aspect, unit):
    assert pixels_per_unit(size, aspect=aspect) == unit


def test_to_pixels_keeps_the_centre_and_scales_all_lengths():
    factor = jnp.asarray([[[0.1, 0.02], [0.0, 0.05]]])
    splats = Splats2D(jnp.asarray([[0.25, -0.125]]), factor, jnp.ones(1), jnp.ones((1, 3)))
    pixels = splats.to_pixels((160, 320))
    np.testing.assert_allclose(pixels.mean, [[160 + 80, 80 - 40]])
    np.testing.assert_allclose(pixels.factor, factor * 320)
