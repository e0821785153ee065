"""The CPU engine by itself: channels, ceilings, support radius, statistics, several frames."""

import dataclasses

import judge
import numpy as np
import pytest
from scenes import scene

from foldgauss.render import RenderOptions, cpu
from foldgauss.render import _cpu_kernels as kernels


def leaves_of(kind, channels=3, *, dtype=np.float32, change=None):
    """(mean, factor, opacity, color, background) in NumPy, and the picture's size."""
    splats, size = scene(kind)
    rng = np.random.default_rng(4)
    leaves = [np.asarray(leaf) for leaf in (splats.mean, splats.factor, splats.opacity)]
    leaves += [rng.uniform(size=(len(splats.opacity), channels)), rng.uniform(size=channels)]
    leaves = [np.array(leaf, np.float32) for leaf in leaves]
    if change is not None:
        change(leaves)
    return [leaf.astype(dtype) for leaf in leaves], size


def assert_agrees(leaves, size, compositing="over", options=None):
    """Picture and gradients against the judge, the pixels near a threshold aside."""
    options = RenderOptions() if options is None else options
    weights = np.random.default_rng(1).normal(size=(leaves[4].size, *size)).astype(np.float32)
    avoid = judge.near_a_threshold(leaves[:4], size, options)
    assert avoid.mean() < 0.5
    weights[:, avoid] = 0
    true_grads, truth = judge.grads_and_picture(leaves, size, np.moveaxis(weights, 0, -1), compositing, options)
    trace = cpu.forward(*leaves, size, compositing=compositing, options=options)
    grads = *cpu.backward(trace, weights), cpu.background_gradient(trace, weights)
    judge.check(grads, np.moveaxis(trace.image, 0, -1), avoid, true_grads, truth)


@pytest.mark.parametrize("compositing", ["over", "sum"])
@pytest.mark.parametrize("channels", [4, *(pytest.param(num, marks=pytest.mark.slow) for num in (1, 2))])
def test_channels(channels, compositing):
    assert_agrees(*leaves_of("plain", channels), compositing)


@pytest.mark.parametrize("compositing", ["over", "sum"])
@pytest.mark.parametrize("ceiling", [0.5, pytest.param(0.9999, marks=pytest.mark.slow), 1.0])
@pytest.mark.parametrize("kind", ["opaque", "curtain"])
def test_any_ceiling(kind, ceiling, compositing):
    assert_agrees(*leaves_of(kind), compositing, RenderOptions(alpha_ceiling=ceiling, transmittance_stop=1e-6))


def opaque(leaves):
    """Splats of opacity 1, some with their center on a pixel's: there alpha is 1 to the bit."""
    leaves[2][:] = 1
    leaves[0][::2] = np.floor(leaves[0][::2]) + 0.5


@pytest.mark.parametrize("stop", [0.0, 1e-4])
def test_alpha_of_one(stop):
    """No light passes a splat of alpha 1: what lies behind gets no gradient, what lies before gets a finite one."""
    leaves, size = leaves_of("plain", change=opaque)
    options = RenderOptions(alpha_ceiling=1.0, transmittance_stop=stop)
    assert (cpu.forward(*leaves, size, options=options).transmittance == 0).any()
    assert_agrees(leaves, size, "over", options)


def above_one(leaves):
    """Opacities on both sides of 1."""
    leaves[2] *= 3


@pytest.mark.parametrize("compositing", ["over", "sum"])
@pytest.mark.parametrize("ceiling", [0.99, 1.0])
def test_opacity_above_one(ceiling, compositing):
    """Where alpha would exceed the ceiling it has no gradient, with a ceiling of 1 as with any other."""
    leaves, size = leaves_of("plain", change=above_one)
    assert leaves[2].min() < 1 < leaves[2].max()
    assert_agrees(leaves, size, compositing, RenderOptions(alpha_ceiling=ceiling))


@pytest.mark.parametrize("kind", ["plain", "opaque", "needles", "huge", "none"])
def test_exact_options(kind):
    assert_agrees(*leaves_of(kind), "over", dataclasses.replace(RenderOptions.exact(), low_pass=0.05))


@pytest.mark.parametrize("radius", [0.5, pytest.param(2.0, marks=pytest.mark.slow), 3.0])
@pytest.mark.parametrize("kind", ["plain", "needles"])
def test_support_radius(kind, radius):
    options = RenderOptions(support_radius=radius)
    leaves, size = leaves_of(kind)
    assert_agrees(leaves, size, "over", options)
    if radius < 3:
        assert cpu.forward(*leaves, size, options=options).num_pairs < cpu.forward(*leaves, size).num_pairs


def test_transmittance_is_the_weight_of_the_background():
    leaves, size = leaves_of("plain")
    white = cpu.forward(*leaves[:3], np.zeros_like(leaves[3]), np.ones(3, np.float32), size)
    np.testing.assert_array_equal(white.image[1], white.transmittance)
    assert white.transmittance.min() < 0.5 < white.transmittance.max()


@pytest.mark.parametrize(("size", "expected"), [((2, 2), [5, 0, 13]), ((6, 8), [np.sqrt(288), 0, np.sqrt(1696)])])
def test_screen_gradients(size, expected):
    """In units of half the image; splat 2 does not reach it, and what was larger stays."""
    mean = np.float32([[1, 1], [1, 1], [1e6, 1], [1, 1], [1, 1]])
    shapes, color = np.broadcast_to(np.eye(2, dtype=np.float32), (5, 2, 2)), np.ones((5, 3), np.float32)
    trace = cpu.forward(mean, shapes, np.full(5, 0.5, np.float32), color, np.zeros(3, np.float32), size)
    d_mean = np.float32([[3, 4], [0, 0], [7, 7], [-5, 12], [3, 4]])
    largest = np.float32([-1, -1, 40, -1, -1, -1])
    cpu.raise_screen_gradients(largest, trace, d_mean, np.array([5, 1, 0, 3, 2]))
    np.testing.assert_array_equal(largest[[5, 1, 3]], np.float32(expected))
    np.testing.assert_array_equal(largest[[0, 2, 4]], np.float32([-1, 40, -1]))


def test_the_end_of_a_list_keeps_the_gradient():
    """Behind the last light nothing is composited, and nothing is lost: the gradient is that of the whole list."""
    leaves, size = leaves_of("curtain")
    weights = np.ones((3, *size), np.float32)
    trace = cpu.forward(*leaves, size)
    used = max(int((stop - start[:-1]).max()) for start, _, stop, _ in trace.lists)  # the longest list
    assert used < len(leaves[0])
    seen = cpu.backward(trace, weights)
    assert not seen[3][-1].any()
    first = sum(seen[3].any(axis=1))
    short = cpu.backward(cpu.forward(*(leaf[: 2 * first] for leaf in leaves[:4]), leaves[4], size), weights)
    for one, other in zip(seen, short, strict=True):
        np.testing.assert_array_equal(one[:first], other[:first])


@pytest.mark.parametrize("shift", [2, 4])
def test_nan_reaches_no_square(shift):
    """No such geometry is made, but an index made of it would write anywhere."""
    nan, num = np.float32(np.nan), kernels.BLOCK
    first, end = np.full((2, num), -7, np.int32)
    how = np.float32(1), np.float32(1), np.float32(64), np.int32(shift), first, end
    for column in range(8):
        block = np.ones((8, num), np.float32)
        block[column] = nan
        kernels._find_squares(num, block.ravel(), *how)
        assert 0 <= first.min() <= end.max() <= 64 >> shift
        assert (first <= end).all()
    kernels._find_squares(num, np.full(8 * num, nan), *how)
    np.testing.assert_array_equal(first, end)


def forward(changed=None, wrong=None, size=(16, 16), **how):
    """A scene of 200, of which one array is another."""
    leaves = [np.zeros(shape, np.float32) for shape in ((200, 2), (200, 2, 2), (200,), (200, 3), (3,))]
    if changed is not None:
        leaves[changed] = wrong(leaves[changed])
    return cpu.forward(*leaves, size, **how)


ARRAYS = "mean, factor, opacity, color, background"
WRONG = [
    (lambda: forward(options=RenderOptions(tile_size=8)), r"options.tile_size.*other sizes"),
    (lambda: forward(size=(0, 10)), "size"),
    (lambda: forward(3, lambda leaf: leaf[:, :0]), r"color, background: expected .* 1 to 4 channels"),
    (lambda: forward(3, lambda leaf: leaf[:, :2]), r"color, background: expected .* 1 to 4 channels"),
    (lambda: forward(4, lambda leaf: leaf[:0]), r"color, background: expected .* 1 to 4 channels"),
    *((lambda k=k: forward(k, lambda leaf: leaf.astype(np.float64)), ARRAYS) for k in range(5)),
    *((lambda k=k: forward(k, lambda leaf: np.float32(1)), ARRAYS) for k in range(5)),
    *((lambda k=k: forward(k, lambda leaf: leaf[:1]), ARRAYS) for k in range(4)),
    *(
        (
            lambda shape=shape: cpu.backward(forward(), np.zeros(shape, np.float32)),
            r"^grad_image: expected .*\(3, 16, 16\)",
        )
        for shape in ((2, 16, 16), (3, 16, 15), (16, 16, 3), (16, 16))
    ),
]


@pytest.mark.parametrize(("call", "message"), WRONG)
def test_mismatched_arrays_raise(call, message):
    """The kernels check no bounds."""
    with pytest.raises(ValueError, match=message):
        call()
