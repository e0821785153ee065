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


def touch(leaves):
    """Each ellipse reaches a pixel's center by so little that its alpha there is 1.0002 times the cutoff."""
    rng, num = np.random.default_rng(5), len(leaves[2])
    root = np.linalg.cholesky(leaves[1] @ leaves[1].swapaxes(1, 2) + 0.3 * np.eye(2))
    angle, deviations = rng.uniform(0, 2 * np.pi, num), np.sqrt(2 * np.log(leaves[2] * 255 / 1.0002))
    offset = np.einsum("nij,jn->ni", root, deviations * [np.cos(angle), np.sin(angle)])
    leaves[0][:] = rng.integers(0, [70, 50], (num, 2)) + 0.5 - offset


def reached_squares(leaves, size, side, slack):
    """Whether ellipses reach squares of pixels, (num, rows, columns), and rows of them, (num, rows); in NumPy.

    A square is reached if one of its columns of pixel centers is, on any line between its first and last pixel's.
    """
    (x, y), cov = np.float64(leaves[0]).T - 0.5, np.float64(leaves[1]) @ np.float64(leaves[1]).swapaxes(1, 2)
    level, (xx, xy, _, yy) = (
        2 * np.log(leaves[2] * 255.0) * (1 + slack) + slack,
        (cov + 0.3 * np.eye(2)).reshape(-1, 4).T,
    )
    (rx, ry), columns, found = np.sqrt(level * [xx, yy]), np.arange(size[1]), []
    for top in range(0, size[0], side):
        last = min(top + side, size[0]) - 1
        lines = np.broadcast_arrays(*np.linspace(top, last, 16), y, y + xy / xx * rx, y - xy / xx * rx)
        dy = np.clip(lines, top, last) - y
        square, center = (level - dy * dy / yy) * (xx - xy * xy / yy), x + xy / yy * dy
        half = np.sqrt(np.where(square >= 0, square, np.nan))
        left, right = np.fmin.reduce(center - half)[:, None], np.fmax.reduce(center + half)[:, None]
        seen = (x + rx > -0.5) & (x - rx < size[1] - 0.5) & (y + ry >= top) & (y - ry <= last)
        row = seen & (np.ceil(np.clip(y - ry, top, last)) <= np.floor(np.clip(y + ry, top, last)))
        found.append((np.logical_or.reduceat((columns >= left) & (columns <= right), columns[::side], axis=1), row))
    return (np.stack(own, 1) for own in zip(*found, strict=True))


@pytest.mark.parametrize(
    ("kind", "change"), [("plain", None), ("plain", touch), ("needles", touch), ("tiny", touch), ("tiny", None)]
)
def test_lists_hold_the_splats_that_reach_a_tile_and_its_cells(kind, change):
    """No cell is missing; a listed cell is reached by the ellipse when that is enlarged by 0.3%."""
    leaves, size = leaves_of(kind, change=change)
    trace, num, (down, across) = cpu.forward(*leaves, size), len(leaves[2]), np.ceil(np.divide(size, 16)).astype(int)
    (start, listed, *_), (_, entries, first_slot, _) = trace.lists[0], trace.buckets
    tiles, cells = np.zeros((num, down, across), bool), np.zeros((num, down, 4, across, 4), bool)
    for tile, (row, column) in enumerate(np.ndindex(down, across)):
        own = listed[start[tile] : start[tile + 1]]
        tiles[entries[own], row, column] = True
        for part in (own[k : k + kernels.BLOCK] for k in range(0, len(own), kernels.BLOCK)):
            block, (first, end) = np.empty(16 * kernels.BLOCK, np.float32), np.full((2, 4, kernels.BLOCK), 9, np.int32)
            place = np.float32(column * cpu.TILE), np.float32(row * cpu.TILE), block, first.ravel(), end.ravel()
            kernels._load_block(trace.geometry, trace.inputs[2], trace.constants[0], entries, part, *place)
            for k in range(4):
                cells[entries[part], row, :, column, k] = ((first <= k) & (k < end))[:, : len(part)].T
            assert not end[:, len(part) :].any()
    in_tile = tiles.repeat(4, 1).repeat(4, 2)
    (least, least_rows), (most, most_rows) = (reached_squares(leaves, size, cpu.TILE, slack) for slack in (0, 0.003))
    (least_cells, _), (most_cells, _) = (
        reached_squares(leaves, (16 * down, 16 * across), 4, slack) for slack in (0, 0.003)
    )
    for name, low, found, high in (
        ("tiles", least, tiles, most),
        ("cells", least_cells & in_tile, cells.reshape(in_tile.shape), most_cells & in_tile),
        ("rows", least_rows.sum(1), np.diff(first_slot), most_rows.sum(1)),
    ):
        assert ((low <= found) & (found <= high)).all(), name
        assert high.sum() < 1.1 * low.sum(), name


@pytest.mark.parametrize("num", [1, 15, 16, 17, 64])
def test_blocks_are_padded_to_a_multiple_of_16_with_the_last_splat(num):
    geometry, which = np.random.default_rng(3).normal(size=(70, 8)).astype(np.float32), np.full(96, -1, np.int32)
    which[:num] = np.arange(num) + 5
    padded, block = [*which[:num], *[num + 4] * (-num % 16)], np.empty((8, kernels.BLOCK), np.float32)
    kernels._load_geometry(geometry, num, which, np.float32(3), np.float32(-2), block.ravel())
    np.testing.assert_array_equal(which, padded + [-1] * (96 - len(padded)))
    np.testing.assert_array_equal(block[:, : len(padded)].T, geometry[padded] - np.float32([3, -2, 0, 0, 0, 0, 0, 0]))


def test_an_alpha_of_exactly_the_cutoff_is_rendered_and_none_below_it():
    cutoff, drawn = np.float32(1 / 255), np.zeros((20, 30))
    leaves = np.float32([[8.5, 8.5], [24.5, 16.5]]), np.tile(np.eye(2, dtype=np.float32), (2, 1, 1))
    leaves += np.array([cutoff, np.nextafter(cutoff, np.float32(0))]), np.ones((2, 4), np.float32)
    trace, drawn[8, 8] = cpu.forward(*leaves, np.zeros(4, np.float32), (20, 30)), cutoff
    np.testing.assert_allclose(trace.image[0], drawn, rtol=1e-6)
    _, _, d_opacity, d_color = cpu.backward(trace, np.ones((4, 20, 30), np.float32))
    np.testing.assert_allclose([d_opacity, d_color[:, 0]], [[4, 0], [cutoff, 0]], rtol=1e-6)


def wide_splats(num, opacity, sigma):  # they cover an image of 16 x 32 pixels
    rng = np.random.default_rng(6)
    leaves = rng.uniform(0, 16, (num, 2)), np.tile(sigma * np.eye(2), (num, 1, 1)), np.full(num, opacity)
    return [np.float32(leaf) for leaf in (*leaves, rng.uniform(size=(num, 4)), [0.2, 0.4, 0.6, 0.8])]


@pytest.mark.parametrize(("opacity", "stop"), [(0.5, 0.5), (1.0, 0.0)])
def test_a_transmittance_equal_to_the_stop_ends_a_pixel(opacity, stop):
    # Alpha is the opacity on every pixel: image, list and gradients equal the ones of the first splat alone.
    leaves, options = wide_splats(130, opacity, 1e6), RenderOptions(alpha_ceiling=1.0, transmittance_stop=stop)
    whole, first = (
        cpu.forward(*(leaf[:num] for leaf in leaves[:4]), leaves[4], (16, 32), options=options) for num in (130, 1)
    )
    np.testing.assert_array_equal(whole.image, first.image)
    np.testing.assert_array_equal(whole.lists[0][2] - whole.lists[0][0][:-1], kernels.BLOCK)
    for one, other in zip(*(cpu.backward(trace, np.ones_like(trace.image)) for trace in (whole, first)), strict=True):
        np.testing.assert_array_equal(one, np.concatenate([other, np.zeros_like(one[1:])]))


def test_tiles_of_one_block_and_of_one_splat_more():
    leaves = wide_splats(65, 0.03, 20)
    leaves[0][-1], leaves[1][-1] = 8, np.eye(2)  # it reaches only the first of the two tiles
    np.testing.assert_array_equal(np.diff(cpu.forward(*leaves, (16, 32)).lists[0][0]), [65, 64])
    for size in ((16, 32), (16, 16)):
        assert_agrees(leaves, size)


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
