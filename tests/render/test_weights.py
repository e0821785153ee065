"""The weights written out make the picture that the engine draws."""

import numpy as np
import pytest

from foldgauss.render import RenderOptions, cpu
from foldgauss.render.cpu import build_weight_matrix

SIZE = 37, 52  # tiles cut off on both sides


def _splats(num, seed=0, channels=3):
    rng = np.random.default_rng(seed)
    mean = rng.uniform([-5, -5], [SIZE[1] + 5, SIZE[0] + 5], size=(num, 2))
    factor = rng.normal(size=(num, 2, 2)) * rng.uniform(1, 6, size=(num, 1, 1))
    leaves = mean, factor, rng.uniform(size=num), rng.uniform(size=(num, channels)), rng.uniform(size=channels)
    return tuple(np.asarray(leaf, np.float32) for leaf in leaves)


@pytest.mark.parametrize("compositing", ["over", "sum"])
@pytest.mark.parametrize("options", [RenderOptions(), RenderOptions.exact(), RenderOptions(support_radius=2.0)])
@pytest.mark.parametrize("num", [0, 1, 300, 2000])
def test_weights_times_colors_equal_the_image(num, options, compositing):
    leaves = _splats(num)
    trace = cpu.forward(*leaves, SIZE, compositing=compositing, options=options)
    found = build_weight_matrix(trace)
    assert found.shape == (SIZE[0] * SIZE[1], num)
    assert found.has_canonical_format
    picture = (found @ leaves[3]).T.reshape(3, *SIZE) + trace.transmittance * leaves[4][:, None, None]
    np.testing.assert_allclose(picture, trace.image, atol=1e-5 * max(1, np.abs(trace.image).max()))


def test_weights_equal_one_hot_channels():
    mean, factor, opacity, _, dark = _splats(3)
    trace = cpu.forward(mean, factor, opacity, np.eye(3, dtype=np.float32), 0 * dark, SIZE)
    np.testing.assert_allclose(build_weight_matrix(trace).toarray().T.reshape(3, *SIZE), trace.image, atol=1e-6)


def test_weights_do_not_depend_on_tasks():
    """Small pictures are one part, others one a row of tiles."""
    leaves = _splats(20000, seed=1)
    trace = cpu.forward(*leaves, SIZE)
    assert len(trace.parts) > 1
    picture = (build_weight_matrix(trace) @ leaves[3]).T.reshape(3, *SIZE) + trace.transmittance * leaves[4][
        :, None, None
    ]
    np.testing.assert_allclose(picture, trace.image, atol=1e-3)  # one step of the light's end, where rounding decides
