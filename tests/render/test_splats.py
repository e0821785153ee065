"""Model space to pixels, and options."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from foldgauss.render import RenderOptions, Splats2D, pixels_per_unit


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


def test_to_pixels_keeps_the_center_and_scales_lengths():
    factor = jnp.asarray([[[0.1, 0.02], [0.0, 0.05]]])
    splats = Splats2D(jnp.asarray([[0.25, -0.125]]), factor, jnp.ones(1), jnp.ones((1, 3)))
    pixels = splats.to_pixels((160, 320))
    np.testing.assert_allclose(pixels.mean, [[160 + 80, 80 - 40]])
    np.testing.assert_allclose(pixels.factor, factor * 320)


@pytest.mark.parametrize("size", [(0, 5), (5,), (5, 5, 3), (2.5, 5), 5, None, "55"])
def test_invalid_image_sizes_raise(size):
    splats = Splats2D(jnp.zeros((1, 2)), jnp.eye(2)[None], jnp.ones(1), jnp.ones((1, 3)))
    for call in (splats.to_pixels, lambda size: pixels_per_unit(size, aspect=1.0)):
        with pytest.raises(ValueError, match=r"^size: expected \(height, width\)"):
            call(size)


@pytest.mark.parametrize(
    "shapes",
    [
        ((4, 2), (4, 2, 2), (3,), (4, 3)),
        ((4, 2), (4, 2), (4,), (4, 3)),
        ((4, 3), (4, 2, 2), (4,), (4, 3)),
        ((4, 2), (4, 2, 2), (4,), (4,)),
        ((2,), (2, 2), (), ()),
        ((), (2, 2), (), (3,)),
    ],
)
def test_mismatched_shapes_raise(shapes):
    expected = r"shapes \(num, 2\), \(num, 2, 2\), \(num,\), \(num, channels\)"
    with pytest.raises(ValueError, match=f"^mean, factor, opacity, color: expected {expected}, got "):
        Splats2D(*map(jnp.zeros, shapes))


@pytest.mark.parametrize("batch", [(), (4,), (2, 4), (0,)])
def test_matching_shapes_are_accepted(batch):
    Splats2D(*(jnp.zeros((*batch, *shape)) for shape in ((2,), (2, 2), (), (3,))))


@pytest.mark.parametrize("field", ["alpha_cutoff", "alpha_ceiling", "low_pass", "transmittance_stop", "support_radius"])
@pytest.mark.parametrize("value", [-1.0, float("nan"), "much", float("inf")])
def test_invalid_options_raise(field, value):
    with pytest.raises(ValueError, match=field):
        RenderOptions(**{field: value})


@pytest.mark.parametrize(
    "change",
    [
        {"tile_size": 3},
        {"tile_size": 8.0},
        {"list_capacity": 0},
        {"list_capacity": 2**30 - 1},
        {"list_capacity": True},
        {"alpha_ceiling": 1.1},
        {"support_radius": 1e200},
        {"support_radius": 0.05},
    ],
)
def test_options_out_of_bounds_raise(change):
    with pytest.raises(ValueError, match=f"RenderOptions.{next(iter(change))}"):
        RenderOptions(**change)


def test_options_are_stored_as_python_numbers():
    options = RenderOptions(
        low_pass=np.float32(0.25), support_radius=3, tile_size=np.int32(8), list_capacity=np.int64(2**30 - 2)
    )
    assert options == RenderOptions(low_pass=0.25, support_radius=3.0, tile_size=8, list_capacity=2**30 - 2)
    assert [type(value) for value in dataclasses.astuple(options)] == [float] * 5 + [int] * 2


@pytest.mark.parametrize("aspect", [0, -0.5, np.inf, np.nan, "wide"])
def test_invalid_aspects_raise(aspect):
    splats = Splats2D(jnp.zeros((1, 2)), jnp.eye(2)[None], jnp.ones(1), jnp.ones((1, 3)))
    for call in (splats.to_pixels, pixels_per_unit):
        with pytest.raises(ValueError, match=r"^aspect: expected a frame's height / width"):
            call((5, 5), aspect=aspect)


def test_presets():
    assert RenderOptions.standard() == RenderOptions()
    assert RenderOptions.exact().alpha_ceiling == 1.0
    assert RenderOptions.exact().transmittance_stop == 0.0
    assert RenderOptions.fast().alpha_cutoff > RenderOptions().alpha_cutoff
