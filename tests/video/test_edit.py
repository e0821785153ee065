"""Edits: what a folded model holds is baked exactly, all else acts where and when it should, and nowhere else."""

import dataclasses
import functools
from dataclasses import replace

import numpy as np
import pytest
from edit_cases import ALWAYS, BAKED, BETWEEN, MAPS, TIMES, TURN, apart, picture
from hypothesis import given, settings
from hypothesis import strategies as st
from path_models import path_model
from scipy.ndimage import map_coordinates, spline_filter
from soft_models import NUM, NUM_FRAMES, OBJECT, SIZE, assert_same, only, soft_model

from foldgauss.render import Camera, RenderOptions, cpu
from foldgauss.video import (
    Clock,
    EditedVideo,
    FrameTimes,
    SelectedGaussians,
    Selection,
    VideoModel,
    edit,
    layers,
    select,
)
from foldgauss.video.editing.chain import MAX_DISTANCE
from foldgauss.video.models.conditioning import PreparedModel
from foldgauss.video.models.frame_times import make_time_logits
from foldgauss.video.models.renderer import VideoRenderer

MODEL = soft_model()


def alone(video, mask) -> np.ndarray:
    """What the masked add to pictures: they white, all others black."""
    return edit(video).select(~mask).recolor(gain=0).select(mask).recolor(gain=0, offset=1).video()


# ------------------------------------------------------------------------------------------------- affine maps

MATRICES = {
    "move": (np.eye(2), (0.0, 0.0), (0.12, -0.05)),
    "scale": (1.4 * np.eye(2), (0.05, 0.1), (0, 0)),
    "scale two ways": (np.diag([1.5, 0.7]), (-0.1, 0.0), (0, 0)),
    "rotate": (np.array([[np.cos(TURN), -np.sin(TURN)], [np.sin(TURN), np.cos(TURN)]]), (0.1, 0.05), (0, 0)),
    "shear": (np.array([[1.1, 0.4], [-0.2, 0.8]]), (0, 0), (0.02, 0.03)),
    "mirror": (np.array([[-1, 0.1], [0, 1]]), (-0.1, 0.0), (0, 0)),
}


@pytest.mark.parametrize("when", [{}, ALWAYS], ids=["baked", "overlay"])
@pytest.mark.parametrize("name", MAPS)
def test_affine_edits_commute_with_rendering(name, when):
    """The picture of the edited model is the edited picture: sampled where A^-1 takes each pixel."""
    edited = MAPS[name](edit(MODEL), **when).video()
    assert isinstance(edited, EditedVideo if when else VideoModel)
    matrix, center, offset = MATRICES[name]
    y, x = np.mgrid[0 : SIZE[0], 0 : SIZE[1]] + 0.5
    point = (np.stack([x, y], -1) - np.array(SIZE[::-1]) / 2) / max(SIZE)
    source = (point - center - offset) @ np.linalg.inv(matrix).T + center
    at = (source * max(SIZE) + 1.5 * np.array(SIZE[::-1])) * FINER - 0.5
    inside = ((at > 4) & (at < np.array(SIZE[::-1]) * 3 * FINER - 5)).all(-1)
    assert inside.mean() > 0.95
    for t in (0.31, float(TIMES[4])):
        truth = [map_coordinates(c, [at[..., 1], at[..., 0]], prefilter=False) for c in splines_around(t)]
        got = picture(edited, t)
        assert np.abs(got - picture(MODEL, t)).max() > 0.05
        np.testing.assert_allclose(got[:, inside], np.stack(truth)[:, inside], atol=1e-3)


FINER = 4


@functools.cache
def splines_around(t):
    """The picture with as much of what lies around it on each side, as splines over finer pixels."""
    height, width = (FINER * n for n in SIZE)
    splats = PreparedModel(MODEL, (height, width)).splats(t)
    leaves = (splats.mean + np.float32([width, height]), splats.factor, splats.opacity, splats.color)
    image = cpu.forward(*leaves, np.zeros(3, np.float32), (3 * height, 3 * width), options=MODEL.options).image
    return [spline_filter(channel) for channel in image]


@pytest.mark.parametrize(
    "kind", ["Gaussian", "paths", *(pytest.param(kind, marks=pytest.mark.slow) for kind in ("floor", "short-lived"))]
)
@pytest.mark.parametrize("name", BAKED)
def test_what_is_baked_is_what_the_overlay_draws(name, kind):
    model = {"floor": soft_model(power=1.0, floor=0.1), "paths": path_model()}.get(kind, MODEL)
    if kind == "short-lived":  # masks are of the model, not of those alive
        short = MODEL.splats.log_time_scale - np.float32(2.2)
        model = dataclasses.replace(MODEL, splats=dataclasses.replace(MODEL.splats, log_time_scale=short))
        assert min(len(splats(model, t).opacity) for t in BETWEEN) < NUM / 2
    chain = edit(model).select(OBJECT)
    baked, laid_over = BAKED[name](chain).video(), BAKED[name](chain, **ALWAYS).video()
    assert isinstance(baked, VideoModel)
    assert isinstance(laid_over, EditedVideo)
    assert max(apart(baked, model, t) for t in BETWEEN) > 0.02
    for t in BETWEEN:
        assert apart(baked, laid_over, t) < 2e-5
    if name not in ("vanish", "multiply") and kind != "paths":  # of which there are others then
        assert_same(only(baked, ~OBJECT).splats, only(model, ~OBJECT).splats)  # others keep their bits


NOTHING = {
    "move": lambda e, **when: e.move((0, 0), **when),
    "scale": lambda e, **when: e.scale(1, **when),
    "rotate": lambda e, **when: e.rotate(0.0, about=(0.1, 0), **when),
    "transform": lambda e, **when: e.transform(np.eye(2), **when),
    "opacity": lambda e, **when: e.opacity(1, **when),
    "recolor": lambda e, **when: e.recolor(gain=1, offset=0, **when),
    "retime": lambda e, **when: e.retime(shift=0, stretch=1, **when),
    "place": lambda e, **when: e.place(**when),
    "camera": lambda e, **when: e.seen_from(None),
}


@pytest.mark.parametrize("when", [{}, {"frame": 2}, {"frames": (1, 5), "ease": 1}], ids=str)
@pytest.mark.parametrize("name", NOTHING)
def test_identity_edits_are_exact(name, when):
    video = NOTHING[name](edit(MODEL).select(OBJECT), **when).video()
    assert isinstance(video, VideoModel)
    assert_same(video, MODEL)


def test_functions_that_change_nothing_are_exact():
    video = edit(MODEL).apply(lambda g, t: g).video()
    assert isinstance(video, EditedVideo)
    assert apart(video, MODEL, 0.31) == 0
    np.testing.assert_array_equal(list(video.frames()), list(MODEL.frames()))


# ---------------------------------------------------------------------------------------------------- composition

points = st.tuples(st.floats(-0.5, 0.5), st.floats(-0.5, 0.5))


def splats(video, t=0.31):
    return PreparedModel(video, SIZE).splats(t)


def assert_same_splats(one, other, tolerance=1e-4):
    """In pixels; of covariances their square roots' size."""
    a, b = splats(one), splats(other)
    np.testing.assert_allclose(a.mean, b.mean, atol=tolerance * 64)
    cov_a, cov_b = (np.float64(s.factor) @ np.float64(s.factor).swapaxes(1, 2) for s in (a, b))
    size = np.trace(cov_b, axis1=1, axis2=2)[:, None, None]
    np.testing.assert_allclose(cov_a / size, cov_b / size, atol=tolerance)
    np.testing.assert_allclose(a.opacity, b.opacity, atol=1e-5)
    np.testing.assert_allclose(a.color, b.color, atol=1e-5)


@settings(max_examples=60, deadline=None)
@given(maps=st.tuples(*[st.tuples(st.tuples(*[st.floats(-2, 2)] * 4), points)] * 2), about=points)
def test_maps_compose(maps, about):
    """Two maps about one point are one; with the inverse as the second, none."""
    (first, one), (second, other) = ((np.reshape(entries, (2, 2)), np.array(offset)) for entries, offset in maps)
    if min(abs(first[0, 0] * first[1, 1] - first[0, 1] * first[1, 0]), abs(np.linalg.det(second))) < 0.1:
        return
    there = edit(MODEL).transform(first, one, about=about)
    both = edit(MODEL).transform(second @ first, second @ one + other, about=about)
    assert_same_splats(there.transform(second, other, about=about).video(), both.video(), 1e-3)
    inverse = np.linalg.inv(first)
    if np.abs(inverse @ one).max() <= MAX_DISTANCE:
        assert_same_splats(there.transform(inverse, -inverse @ one, about=about).video(), MODEL, 1e-3)


@pytest.mark.parametrize("name", ["rotate", "shear", "scale two ways"])
def test_no_way_through_nothing(name):
    """On the way to a map that does not mirror nothing is flat."""
    eased, still = MAPS[name](edit(MODEL), frames=(None, 6), ease=5).video(), edit(MODEL).apply(lambda g, t: g).video()
    for t in np.linspace(0, 1, 20):
        areas = np.linalg.det(eased.at(t).factor) / np.linalg.det(still.at(t).factor)
        assert areas.min() > 0.3


def test_edits_act_in_their_order():
    """An affine edit after an overlay of the same Gaussians must not slip in under it."""
    turned = edit(MODEL).select(OBJECT).rotate(0.8)  # about its own center: an overlay
    wide = np.diag([2.0, 0.5])
    both = turned.move((0.1, 0)).transform(wide, about=(0, 0)).video().at(0.31)
    before, middle = turned.video().at(0.31), np.array(SIZE[::-1]) / 2
    mean = (before.mean[OBJECT] + np.array([6.4, 0]) - middle) @ wide + middle
    np.testing.assert_allclose(both.mean[OBJECT], mean, atol=1e-3)
    np.testing.assert_allclose(both.factor[OBJECT], wide @ before.factor[OBJECT], atol=1e-3)
    other = edit(MODEL).select(OBJECT).scale(1.5).select(~OBJECT).move((0.1, 0)).video()
    assert len(other.layers[0].overlays) == 1  # others of its Gaussians are free to be baked


# --------------------------------------------------------------------------------------------------- spans of time


ONE_FRAME = {
    "recolor": lambda e: e.recolor((1, 0, 1), frame=3),
    "move": lambda e: e.move((0.2, 0), frame=3),
    "scale": lambda e: e.scale(2, frame=3),
    "vanish": lambda e: e.vanish(frame=3),
    "multiply": lambda e: e.multiply([(0, 0.05)], frame=3, originals=True),
    "retime": lambda e: e.retime(shift=0.5, frame=3),
    "place": lambda e: e.place(depth=-0.3, rotate=(0, 1, 0), frame=3),
}


@pytest.mark.parametrize("name", ONE_FRAME)
def test_a_single_frame_and_no_other(name):
    """The edited frame differs where the selection reaches, by decibels, and nowhere else; no other frame does."""
    model = soft_model(options=RenderOptions())
    chain = ONE_FRAME[name](edit(model).select(OBJECT))
    before, after = np.stack(list(model.frames())), np.stack(list(chain.video().frames()))
    others = np.arange(NUM_FRAMES) != 3
    np.testing.assert_array_equal(before[others], after[others])
    object_before = picture(alone(model, OBJECT), TIMES[3])[0]
    reached = (object_before > 0) | (picture(alone(chain.video(), chain.selection.mask), TIMES[3])[0] > 0)
    assert 0.1 < reached.mean() < 0.9
    np.testing.assert_array_equal(before[3][~reached], after[3][~reached])
    inside = object_before > 0.3
    assert inside.sum() > 50
    if name == "recolor":
        assert np.square(before[3].astype(int) - after[3])[inside].mean() > 40  # levels of 255
    assert (before[3] != after[3])[inside].any()
    # Half way to the neighbors it is seen, beyond it is not.
    near, far = (np.interp(k, np.arange(NUM_FRAMES), TIMES) for k in (3.4, 3.6))
    assert apart(chain.video(), model, near) > 0.01
    assert apart(chain.video(), model, far) == 0


def test_vanished_is_gone_and_nothing_else():
    model = soft_model(options=RenderOptions())
    gone = edit(model).select(OBJECT).vanish().video()
    assert gone.splats.num_gaussians == NUM - OBJECT.sum()
    faded = edit(model).select(OBJECT).vanish(frames=(2, None), ease=2).video()
    for t in BETWEEN:
        share = picture(alone(model, OBJECT), t)[0]
        assert share.sum() > 50
        np.testing.assert_array_equal(picture(gone, t)[:, share == 0], picture(model, t)[:, share == 0])
    left = lambda t: picture(alone(faded, OBJECT), t)[0].sum() / picture(alone(model, OBJECT), t)[0].sum()  # noqa: E731
    assert left(TIMES[1]) == 1
    assert 0.4 < left(TIMES[2]) < 0.99
    assert left(TIMES[5]) == 0
    assert apart(faded, gone, TIMES[5]) == 0
    assert apart(faded, model, TIMES[1]) == 0


def test_easing_comes_and_goes():
    """Where the object is, frame by frame: outside, half way in, there, half way out."""
    where = lambda video, k: video.at(TIMES[k]).mean[OBJECT].mean(0)[0]  # noqa: E731
    chain = edit(MODEL).select(OBJECT)
    video = chain.move((0.1, 0), frames=(1, 6), ease=2).video()
    still = edit(MODEL).apply(lambda g, t: g).video()
    way = [(where(video, k) - where(still, k)) / 6.4 for k in range(NUM_FRAMES)]
    np.testing.assert_allclose(way, [0, 0.25, 0.75, 1, 0.75, 0.25, 0], atol=1e-4)
    smooth = chain.move((0.1, 0), frames=(1, None), ease=2, curve="smooth").video()
    way = [(where(smooth, k) - where(still, k)) / 6.4 for k in range(NUM_FRAMES)]
    np.testing.assert_allclose(way, [0, 0.15625, 0.84375, 1, 1, 1, 1], atol=1e-4)
    by_times = chain.move((0.1, 0), times=(TIMES[2], TIMES[4])).video()
    assert [where(by_times, k) != where(still, k) for k in range(NUM_FRAMES)] == [False, False, True, True] + [
        False
    ] * 3


def test_a_turn_of_more_than_a_turn_is_one():
    video = edit(MODEL).select(OBJECT).rotate(4 * np.pi, about=(0, 0), frames=(0, None), ease=0).video()
    assert apart(video, MODEL, 0.5) < 1e-4
    eased = edit(MODEL).select(OBJECT).rotate(2 * np.pi, about=(0, 0), frames=(1, 6), ease=2).video()
    assert apart(eased, MODEL, TIMES[1]) > 0.1


# ------------------------------------------------------------------------------------------- own centers, copies


def test_about_its_own_center_it_stays_where_it_is():
    for make in (lambda e: e.scale(1.7), lambda e: e.rotate(1.0), lambda e: e.transform([[1, 0.5], [0, -1]])):
        video = make(edit(MODEL).select(OBJECT)).video()
        # Weighted by opacity and area, which an affine map scales alike.
        np.testing.assert_allclose(own_center(video), own_center(MODEL), atol=1e-5)


def test_the_own_center_is_where_most_of_it_is():
    """Weighted by opacity and area: by hand, of two."""
    ones = np.ones((2, 3), np.float32)
    factor = np.float32([[[2, 1], [0, 1]], [[1, 0], [3, 1]]])  # areas 2 and 1
    mean, opacity = np.float32([[0, 0], [1, 2]]), np.float32([0.3, 0.9])
    flat = SelectedGaussians(np.arange(2), mean, factor, opacity, ones)
    for gaussians in (flat, flat.in_space()):
        np.testing.assert_allclose(gaussians.center[:2], [0.6, 1.2], rtol=1e-6)
    unseen = dataclasses.replace(flat, opacity=0 * opacity)
    np.testing.assert_allclose(unseen.center, [0.5, 1.0])


def test_what_is_left_stays_where_it_was():
    """Half of an object deleted does not move the center about which the other half was scaled."""
    some = np.arange(NUM) < 5
    whole = edit(MODEL).select(OBJECT).scale(1.5)
    left = whole.select(some).vanish()
    rest = OBJECT & ~some
    np.testing.assert_allclose(left.video().at(0.31).mean[rest[5:]], whole.video().at(0.31).mean[rest], atol=1e-4)
    # Where nothing of it stays, it is deleted, and the edit with it.
    gone = whole.vanish().video()
    assert isinstance(gone, VideoModel)
    assert gone.splats.num_gaussians == NUM - OBJECT.sum()


def own_center(video):
    found = []
    edit(video).select(OBJECT).apply(lambda g, t: found.append(g.center) or g).video().at(0.31)
    return found[0]


def test_copies_stand_behind_their_originals():
    chain = edit(MODEL).select(OBJECT).multiply([(0.1, 0), (0.2, 0)])
    video = chain.video()
    assert video.splats.num_gaussians == NUM + 2 * OBJECT.sum()
    assert len(chain.selection) == 2 * OBJECT.sum()
    source = np.repeat(np.arange(NUM), np.where(OBJECT, 3, 1))
    np.testing.assert_array_equal(video.splats.opacity_logit, MODEL.splats.opacity_logit[source])
    shift = np.asarray(video.splats.loc)[:, 0] - MODEL.splats.loc[source, 0]
    np.testing.assert_allclose(shift[:6], [0, 0.1, 0.2] * 2, atol=1e-6)
    both = edit(MODEL).select(OBJECT).multiply([(0.1, 0)], originals=True)
    assert len(both.selection) == 2 * OBJECT.sum()
    assert not chain.selection.mask[~np.repeat(OBJECT, np.where(OBJECT, 3, 1))].any()


def test_copies_have_their_own_edits_and_times():
    """What was done to the original, about its own center, is done to each copy about its own."""
    grown = edit(MODEL).select(OBJECT).scale(1.5)
    copies = grown.multiply([(0.2, 0.0), (0.0, 0.2)], delays=(0.0, 0.1), scale=(1, 0.5), angle=0.2)
    each = [grown.scale(1).rotate(0.2).move((0.2, 0)), grown.scale(0.5).rotate(0.2).move((0, 0.2)).retime(shift=0.1)]
    got = copies.video().at(0.5)
    for k, one in enumerate(each):
        copy = np.flatnonzero(np.repeat(OBJECT, np.where(OBJECT, 3, 1)))[k + 1 :: 3]
        expected = one.video().at(0.5)
        np.testing.assert_allclose(got.mean[copy], expected.mean[OBJECT], atol=1e-3)
        np.testing.assert_allclose(got.factor[copy], expected.factor[OBJECT], atol=1e-3)


def test_copies_over_a_span_are_there_only_within():
    video = edit(MODEL).select(OBJECT).multiply([(0.2, 0)], frames=(2, 5), ease=1).video()
    number = [len(video.at(t).opacity) for t in TIMES]
    assert number == [NUM] * 2 + [NUM + OBJECT.sum()] * 3 + [NUM] * 2


# ------------------------------------------------------------------------------------------------------------ clocks


def test_clocks():
    chain = edit(MODEL).select(OBJECT)
    at = lambda video, t: video.at(t).mean[OBJECT]  # noqa: E731
    frozen = chain.freeze(2).video()
    assert isinstance(frozen, EditedVideo)
    base = edit(MODEL).apply(lambda g, t: g).video()
    for t in BETWEEN:
        np.testing.assert_array_equal(at(frozen, t), at(base, float(TIMES[2])))
        np.testing.assert_array_equal(frozen.at(t).mean[~OBJECT], base.at(t).mean[~OBJECT])
    there_and_back = chain.retime(clock=Clock((0.0, 0.5, 1.0), (0.0, 1.0, 0.0))).video()
    np.testing.assert_array_equal(at(there_and_back, 0.25), at(base, 0.5))
    np.testing.assert_array_equal(at(there_and_back, 0.75), at(base, 0.5))
    from_three_on = chain.retime(clock=Clock.frozen(0.0), frames=(3, None)).video()
    np.testing.assert_array_equal(at(from_three_on, TIMES[4]), at(base, 0.0))
    np.testing.assert_array_equal(at(from_three_on, TIMES[2]), at(base, TIMES[2]))


HELD = {
    "later": (lambda e: e.retime(shift=0.05), 0.0),
    "earlier": (lambda e: e.retime(shift=-0.5), 1.0),
    "faster": (lambda e: e.retime(stretch=0.5, about=0.5), 0.0),
    "backwards": (lambda e: e.retime(shift=-0.1, stretch=-1, about=0.5), 0.0),
    "delays": (lambda e: e.multiply([(0, 0)], delays=0.05).to_front(), 0.0),
    "clock": (lambda e: e.retime(clock=Clock((0, 1), (-0.3, 1.3))), 0.0),
    "eased": (lambda e: e.retime(clock=Clock((0, 1), (2, 3)), times=(0.9, 1), ease=0.01), 1.0),
}


@pytest.mark.parametrize("name", HELD)
def test_no_clock_leaves_the_frames_of_the_fit(name):
    """Beyond the first frame and the last the selection stands still: extrapolated folds scatter."""
    change, own = HELD[name]
    video, base = change(edit(MODEL).select(OBJECT)).video(), edit(MODEL).apply(lambda g, t: g).video()
    t = 1 - own if name == "backwards" else own
    shown, wanted = video.at(float(t)), base.at(own)
    np.testing.assert_array_equal(
        shown.mean[: OBJECT.sum()] if name == "delays" else shown.mean[OBJECT], wanted.mean[OBJECT]
    )


def test_clocks_follow_one_another():
    """A later retiming retimes what the earlier ones made: first reversed, then delayed."""
    reverse = Clock((0.0, 1.0), (1.0, 0.0))
    both = edit(MODEL).select(OBJECT).retime(clock=reverse).retime(shift=0.2).video()
    base = edit(MODEL).apply(lambda g, t: g).video()
    np.testing.assert_allclose(both.at(0.5).mean[OBJECT], base.at(0.7).mean[OBJECT], atol=1e-3)
    assert len(both.layers[0].clocks) == 2  # the second was not baked in under the first
    some = np.arange(NUM) < 20
    crossed = edit(MODEL).select(OBJECT).freeze(0).select(some).retime(shift=0.2).video()
    np.testing.assert_array_equal(crossed.at(0.5).mean[OBJECT], base.at(0.0).mean[OBJECT])
    np.testing.assert_allclose(crossed.at(0.5).mean[some & ~OBJECT], base.at(0.3).mean[some & ~OBJECT], atol=1e-3)


def test_shots():
    """Between two shots the nearer one's frame is seen, by an object's own clock, too; and no leaves say that."""
    model = dataclasses.replace(MODEL, frame_times=FrameTimes(make_time_logits(8, [4])))
    times = np.asarray(model.frame_times.times())
    assert times[4] - times[3] > 0.5
    late = edit(model).select(OBJECT).retime(shift=0.02).video()
    assert isinstance(late, EditedVideo)
    base = edit(model).apply(lambda g, t: g).video()
    for t, seen in ((times[3] + 0.1, times[3]), (times[3] + 0.4, times[4])):
        got = edit(model).select(OBJECT).retime(clock=Clock.frozen(float(t))).video().at(times[0])
        np.testing.assert_array_equal(got.mean[OBJECT], base.at(seen).mean[OBJECT])
    one_frame = edit(model).select(OBJECT).move((0.2, 0), frame=3).video()
    assert apart(one_frame, model, float(times[3] + 0.1)) > 0.01
    assert apart(one_frame, model, float(times[3] + 0.4)) == 0


# ----------------------------------------------------------------------------------------------------------- colors


def test_recoloring_keeps_the_shading():
    light = np.array([0.2126, 0.7152, 0.0722])
    base = edit(MODEL).apply(lambda g, t: g).video().at(0.5)
    red = edit(MODEL).select(OBJECT).recolor((0.8, 0.1, 0.1)).video()
    got = VideoRenderer(red).splats(0.5)
    ratio = got.color[OBJECT] / np.array([0.8, 0.1, 0.1])
    np.testing.assert_allclose(ratio, np.repeat(ratio[:, :1], 3, 1), rtol=1e-4)
    np.testing.assert_allclose(got.opacity[OBJECT] @ ratio[:, 0] / got.opacity[OBJECT].sum(), 1, rtol=1e-4)
    before = base.color[OBJECT] @ light
    np.testing.assert_allclose(ratio[:, 0] / before, ratio[0, 0] / before[0], rtol=1e-3)
    blue = VideoRenderer(edit(MODEL).select(OBJECT).recolor(hue=2 / 3).video()).splats(0.5).color[OBJECT]
    assert (blue[:, 2] >= blue[:, :2].max(1) - 1e-5).all()
    unclipped = (blue > 0).all(1)
    assert unclipped.sum() > 3
    np.testing.assert_allclose((blue @ light)[unclipped], before[unclipped], rtol=1e-4)


# --------------------------------------------------------------------------------------------------------- functions


def test_any_function_of_the_conditioned_gaussians():
    seen = []

    def wave(gaussians, t):
        seen.append((gaussians.index, t))
        shift = 0.1 * np.sin(2 * np.pi * t)
        return dataclasses.replace(gaussians, mean=gaussians.mean + np.array([shift, 0.0]))

    video = edit(MODEL).select(OBJECT).apply(wave).video()
    moved = edit(MODEL).select(OBJECT).move((0.1, 0)).video()
    assert apart(video, moved, 0.25) < 1e-5
    np.testing.assert_array_equal(seen[0][0], np.flatnonzero(OBJECT))
    assert seen[0][1] == 0.25
    half = edit(MODEL).select(OBJECT).apply(wave, frames=(1, 6), ease=5 / 2).video()
    quarter = float(np.interp(0.5 + 1.25, np.arange(NUM_FRAMES), TIMES))
    expected = edit(MODEL).select(OBJECT).move((0.05 * np.sin(2 * np.pi * quarter), 0)).video()
    assert apart(half, expected, quarter) < 1e-5


def test_arrays_that_a_function_returns_as_they_were_keep_their_bits():
    model = soft_model(size=(60, 100))  # the unit is no power of two: conversion to model space and back rounds
    before = model.prepare(model.size).splats(0.5)
    moved = edit(model).select(OBJECT).apply(lambda g, t: dataclasses.replace(g, mean=g.mean + 0.1)).video().at(0.5)
    np.testing.assert_array_equal(moved.factor, before.factor)
    larger = (
        edit(model).select(OBJECT).apply(lambda g, t: dataclasses.replace(g, factor=1.5 * g.factor)).video().at(0.5)
    )
    np.testing.assert_array_equal(larger.mean, before.mean)


def test_functions_are_the_edits_that_they_compute():
    """A turn and a mirror of means and factors; half of a shift at half of the progress."""
    chain = edit(MODEL).select(OBJECT)

    def through(matrix):
        matrix = np.float32(matrix)
        return lambda g, t: replace(g, mean=g.mean @ matrix.T + np.float32([0.1, 0.05]), factor=matrix @ g.factor)

    turn = np.array([[np.cos(0.7), -np.sin(0.7)], [np.sin(0.7), np.cos(0.7)]]) * 1.3
    for matrix in (turn, turn @ np.diag([1, -1])):
        expected = chain.transform(matrix, (0.1, 0.05), about=(0, 0)).video()
        assert apart(chain.apply(through(matrix)).video(), expected, 0.31) < 1e-3
    shift = lambda g, t: replace(g, mean=g.mean + np.float32([0.2, 0]))  # noqa: E731
    half = chain.apply(shift, frames=(1, 6), ease=2).video()
    assert apart(half, chain.move((0.05, 0)).video(), TIMES[1]) < 1e-3


# ------------------------------------------------------------------------------------------------------ who, and errors


def test_selections():
    chain = edit(MODEL)
    assert len(chain.selection) == NUM
    assert len(chain.select(OBJECT).selection) == OBJECT.sum()
    assert len(chain.select(Selection(OBJECT)).select().selection) == NUM
    asked = []
    by_function = chain.select(lambda model: asked.append(model) or ~Selection(OBJECT))
    np.testing.assert_array_equal(by_function.selection.mask, ~OBJECT)
    assert asked[0] is MODEL
    assert len(chain.select(OBJECT).vanish().selection) == 0
    # The chain that was begun with is as it was.
    assert len(chain.selection) == NUM
    assert chain.video() is MODEL


def test_criteria_are_asked_of_each_layer():
    box, other = {"box": (0, 0, 32, 40), "frame": 2}, soft_model(seed=1)
    moved = edit(MODEL).move((0.3, 0))
    assert moved.select(**box).selection == select(moved.video(), **box) != select(MODEL, **box)  # with baked edits
    chain, masks = edit(layers(MODEL, other)), [select(model, **box).mask for model in (MODEL, other)]
    np.testing.assert_array_equal(chain.select(**box).selection.mask, np.concatenate(masks))
    np.testing.assert_array_equal(chain.select(layer=1, **box).selection.mask, np.concatenate([0 * OBJECT, masks[1]]))


def test_selections_of_before_go_on():
    """A mask of what the chain was begun with means those, wherever they are now, and their copies."""
    some = np.arange(NUM) >= NUM - 5
    chain = edit(MODEL).select(OBJECT).multiply([(0.1, 0), (0.2, 0)]).select(some).vanish().select(OBJECT)
    assert len(chain.selection) == 3 * OBJECT.sum()
    np.testing.assert_array_equal(chain.selection.mask, np.repeat(OBJECT, np.where(OBJECT, 3, 1))[:-5])
    assert chain.select(lambda video: chain.selection).selection == chain.selection
    equal = edit(MODEL).select(some).multiply([(0.1, 0)]).select(np.arange(NUM) < 5).vanish()
    begun = OBJECT[np.r_[5 : NUM - 5, np.repeat(np.arange(NUM - 5, NUM), 2)]]
    np.testing.assert_array_equal(equal.select(OBJECT).selection.mask, begun)
    assert len(equal.select(lambda model: OBJECT).selection) == OBJECT.sum()
    assert len(equal.select().selection) == NUM


E = edit(MODEL)


def rendered(chain):
    return chain.video().render(0.5)


def in_place(gaussians, t):
    gaussians.mean[:] += 1
    return gaussians


ODD = np.arange(NUM) % 2 == 1
WRONG = {
    "no video": (lambda: edit(MODEL.splats), "video: expected a VideoModel or an EditedVideo"),
    "mask of others": (lambda: E.select(OBJECT[:-1]), "selection: expected a Selection or mask of 40"),
    "mask of numbers": (lambda: E.select(np.ones(NUM)), "selection: .*float64"),
    "both": (lambda: E.select(OBJECT, color=(1, 0, 0)), "selection: .*or criteria"),
    "no layer": (lambda: E.select(layer=1), "layer: expected a whole number in"),
    "nobody": (lambda: E.select(~(OBJECT | True)).move((0.1, 0)), "selection: expected at least one"),
    "nobody to copy": (lambda: E.select(~(OBJECT | True)).multiply([(0.1, 0)]), "selection: expected at least one"),
    "after vanishing": (lambda: E.select(OBJECT).vanish().vanish(), "selection: expected at least one"),
    "offset": (lambda: E.move((1, 2, 3)), "offset: expected 2 finite numbers"),
    "nan": (lambda: E.move((np.nan, 0)), "offset: expected 2 finite numbers"),
    "text": (lambda: E.move("ab"), "offset: expected 2 finite"),
    "number in a text": (lambda: E.scale("2"), "factor: expected a finite number, got '2'"),
    "numbers in texts": (lambda: E.move(("0.1", "0.2")), "offset: expected 2 finite numbers"),
    "about": (lambda: E.rotate(1, about=(0,)), "about: expected 2 finite"),
    "angle": (lambda: E.rotate(np.inf), "angle: expected a finite number"),
    "factor 0": (lambda: E.scale(0), "factor: expected one or two numbers > 0"),
    "three factors": (lambda: E.scale((1, 2, 3)), "factor: expected one or two"),
    "matrix": (lambda: E.transform(np.eye(3)), r"matrix: expected finite numbers of shape \(2, 2\)"),
    "matrix of one row": (
        lambda: E.transform([[1, 2]]),
        r"matrix: expected finite numbers of shape \(2, 2\), got \[\[1, 2\]\]",
    ),
    "ragged": (lambda: E.scale([(1, 2), 3]), "factor: expected finite numbers"),
    "flat matrix": (lambda: E.transform([[1, 2], [2, 4]]), "matrix: expected an invertible matrix"),
    "subnormal pivot": (lambda: E.transform([[0, 0], [2.3e-309, 1]]), "matrix: expected an invertible matrix"),
    "opacity": (lambda: E.opacity(-1), "factor: expected a number >= 0"),
    "no copies": (lambda: E.multiply([]), "offsets: expected pairs"),
    "no list": (lambda: E.multiply(3), "offsets: expected pairs"),
    "size of copies": (lambda: E.multiply([(0, 0)], scale=0), "scale: expected numbers > 0"),
    "originals": (lambda: E.multiply([(0, 0)], originals="yes"), "originals: expected True or False"),
    "delays": (lambda: E.multiply([(0, 0)], delays=(1, 2)), "delays: expected one number or 1"),
    "color": (lambda: E.recolor((1, 2)), "color: expected red, green and blue in"),
    "dark color": (lambda: E.recolor((1, 2, -1)), "color: expected red, green and blue in"),
    "no way": (lambda: E.recolor(), "color, hue, gain: expected color, hue, or gain"),
    "two ways": (lambda: E.recolor((1, 0, 0), hue=0.1), "color, hue, gain: expected color, hue, or gain"),
    "gains": (lambda: E.recolor(gain=(1, 2)), "gain: expected one number or 3"),
    "color matrix": (lambda: E.recolor(matrix=np.eye(2)), r"matrix: expected finite numbers of shape \(3, 3\)"),
    "black object": (lambda: E.recolor(gain=0).recolor((1, 0, 0)), "color: expected an object that is not black"),
    "standing still": (lambda: E.retime(stretch=0), "stretch: expected a number other than 0"),
    "two clocks": (lambda: E.retime(shift=1, clock=Clock.frozen(0)), "clock: expected a clock, or"),
    "no clock": (lambda: E.retime(clock=lambda t: t), "clock: expected a Clock"),
    "frozen": (lambda: E.freeze(7), r"at: expected a frame in \[0, 6\]"),
    "function": (lambda: E.apply(3), "function: expected a function"),
    "depth": (lambda: E.place(depth=None), "depth: expected a finite number"),
    "function of one": (
        lambda: E.apply(lambda g: g),
        r"function: expected a function of \(gaussians, t\), got one of \(g",
    ),
    "camera of none": (lambda: E.seen_from(lambda: 3), r"camera: expected a function of \(t\), got one of \(\)"),
    "camera itself": (lambda: E.seen_from(Camera), r"camera: expected a function of \(t\), got the class Camera"),
    "selection of none": (lambda: E.select(lambda: OBJECT), r"selection: expected a function of \(video\)"),
    "numbers": (lambda: E.select([1, 2]), r"selection: .*For indices of Gaussians: Selection.of"),
    "no videos": (lambda: layers(), "videos: expected at least one"),
    "list of videos": (lambda: layers([MODEL]), r"video: .*layers\(\*videos\)"),
    "path": (lambda: edit("m.safetensors"), r"video: .*load_video_model\(path\)"),
    "camera": (lambda: E.seen_from("left"), "camera: expected a Camera"),
    "frame": (lambda: E.move((0, 0), frame=7), r"frame: expected a whole number in \[0, 6\]"),
    "frames": (lambda: E.move((0, 0), frames=(3, 3)), "frames: expected .first, stop."),
    "frames of one": (lambda: E.move((0, 0), frames=3), "frames: expected .first, stop. .* for one frame give frame=k"),
    "times": (lambda: E.move((0, 0), times=(0.5, 0.2)), "times: expected .start, stop., rising"),
    "two whens": (lambda: E.move((0, 0), frame=1, times=(0, 1)), "frame, frames, times: expected one"),
    "ease alone": (lambda: E.move((0, 0), ease=2), "ease: expected a span"),
    "long ease": (lambda: E.move((0, 0), frames=(2, 4), ease=2), "ease: expected no more than the span's 2 frames"),
    "ease": (lambda: E.move((0, 0), frames=(2, 4), ease=-1), "ease: expected a number of frames"),
    "curve": (lambda: E.move((0, 0), frame=2, curve="cubic"), "curve: expected one of"),
    "clock knots": (lambda: Clock((0, 0), (0, 1)), "times: expected strictly increasing"),
    "file of a selection": (lambda: E.select("it.selection"), "selection: .*got 'it.selection'.*parse_indices"),
    "mask of pixels": (lambda: E.select(np.ones(SIZE, bool)), r"selection: .*select\(mask=mask, frame=k\)"),
    "one pair": (lambda: E.multiply((0.2, 0)), "offsets: expected pairs"),
    "clock lengths": (lambda: Clock((0, 1), (0,)), "times, own_times: expected as many"),
    "nothing back": (lambda: rendered(E.apply(lambda g, t: None)), "function: expected SelectedGaussians"),
    "fewer": (lambda: rendered(E.apply(lambda g, t: replace(g, mean=g.mean[1:]))), "function's mean"),
    "nan color": (lambda: rendered(E.apply(lambda g, t: replace(g, color=g.color * np.nan))), "function's color"),
    "opacity above 1": (
        lambda: rendered(E.apply(lambda g, t: replace(g, opacity=g.opacity + 1))),
        "function: expected opacity in",
    ),
    "others": (
        lambda: rendered(E.apply(lambda g, t: replace(g, index=g.index + 1))),
        "function: expected the same Gaussians",
    ),
    "in place": (lambda: rendered(E.apply(in_place)), ".*read-only"),
    "nobody to the front": (lambda: E.select(~(OBJECT | True)).to_front(), "selection"),
    "mask of now": (
        lambda: E.select(OBJECT).multiply([(0.1, 0)]).select(np.ones(59, bool)),
        "selection: expected a Selection or mask of .*lambda video: mask",
    ),
    "mask of the start": (
        lambda: E.select(OBJECT).multiply([(0.1, 0)]).select(lambda model: OBJECT),
        "selection: expected a Selection or mask of .*lambda video: mask",
    ),
    "a part to retime": (
        lambda: E.select(OBJECT).rotate(1.0).select(OBJECT & ODD).retime(shift=0.1),
        "selection: expected all Gaussians of an edit",
    ),
    "a part to freeze": (
        lambda: E.select(OBJECT).rotate(1.0).select(OBJECT & ODD).freeze(2),
        "selection: expected all Gaussians of an edit",
    ),
}


@pytest.mark.parametrize("name", WRONG)
def test_malformed_arguments(name):
    call, message = WRONG[name]
    with pytest.raises(ValueError, match=f"^{message}"):
        call()


OTHER_UNITS = {
    "degrees": (
        lambda: E.rotate(45),
        r"angle: expected radians, got 45, 7\.2 turns\. For degrees use math\.radians\(45\)",
    ),
    "degrees of copies": (lambda: E.multiply([(0, 0)], angle=90), "angle: expected radians, got 90"),
    "degrees in space": (lambda: E.place(rotate=(0, -45, 0)), "rotate: expected radians, got -45"),
    "pixels": (lambda: E.move((50, 20)), r"offset: expected units .* For pixels divide by 64"),
    "pixels of copies": (lambda: E.multiply([(50, 20)]), "offsets: expected units"),
    "pixels of a point": (lambda: E.scale(2, about=(32, 20)), "about: expected units"),
    "frames": (lambda: E.retime(shift=3), "shift: expected times .* For frames divide by 6"),
    "frames of copies": (lambda: E.multiply([(0, 0)], delays=(3,)), "delays: expected times"),
}


@pytest.mark.parametrize("name", OTHER_UNITS)
def test_numbers_of_other_units_are_warned_of(name):
    call, message = OTHER_UNITS[name]
    with pytest.warns(UserWarning, match=f"^{message}") as caught:
        assert call().video() is not None
    assert {warning.filename for warning in caught} == {__file__}


def test_turns_shifts_and_ways_that_are_meant():
    """No warning: it would be an error here."""
    E.rotate(4 * np.pi, frames=(0, 5), ease=2)
    E.rotate(np.array(6.0)).retime(stretch=-1, shift=1).retime(stretch=3, about=0.5)
    E.move((5, -5)).multiply([(0.1, 0)], delays=0.9)


@pytest.mark.parametrize(
    ("call", "error", "message"),
    [
        (lambda: E.move((0.1, 0)).render(0.5), AttributeError, r"no attribute 'render'\. End the chain with \.video"),
        (lambda: E.mve((0.1, 0)), AttributeError, r"no attribute 'mve'\.$"),
        (lambda: E.move((0, 0), easing=2), TypeError, "unexpected keyword argument 'easing'"),
    ],
)
def test_a_forgotten_end_of_the_chain_is_told(call, error, message):
    with pytest.raises(error, match=message):
        call()


def test_to_the_front_and_to_the_back():
    """Who covers whom is all that changes, and a selection of before still means the same Gaussians."""
    order = np.arange(NUM)
    for chain, expected in (
        (edit(MODEL).select(OBJECT).to_front(), np.concatenate([order[OBJECT], order[~OBJECT]])),
        (edit(MODEL).select(OBJECT).to_back(), np.concatenate([order[~OBJECT], order[OBJECT]])),
    ):
        np.testing.assert_array_equal(chain.video().splats.loc, np.asarray(MODEL.splats.loc)[expected])
        np.testing.assert_array_equal(chain.selection.mask, OBJECT[expected])
        np.testing.assert_array_equal(chain.select().select(Selection(OBJECT)).selection.mask, OBJECT[expected])
    eased = edit(MODEL).select(OBJECT).scale(1.5, frame=2).to_front()  # an overlay goes along
    assert isinstance(eased.video(), EditedVideo)
    np.testing.assert_array_equal(eased.video().layers[0].overlays[0].mask, eased.selection.mask)


def test_an_edit_as_a_whole_is_retimed():
    """A part of one about its own center is not: the center of the rest would go elsewhere."""
    turned = edit(MODEL).select(OBJECT).rotate(1.0)
    assert isinstance(turned.retime(shift=0.1).video(), EditedVideo)
    assert isinstance(turned.select(~OBJECT).freeze(2).video(), EditedVideo)
    about = edit(MODEL).select(OBJECT).rotate(1.0, about=(0, 0), frame=2)
    assert isinstance(about.select(OBJECT & ODD).freeze(2).video(), EditedVideo)


def test_sizes_are_not_baked_where_small_ones_are_left_out():
    model = dataclasses.replace(MODEL, scale_cutoff=float(np.exp(MODEL.splats.log_scale).min()) * 0.7)
    smaller = edit(model).scale(0.5, about=(0, 0)).video()
    assert isinstance(smaller, EditedVideo)
    assert smaller.render(0.5).mean() > 0.5 * edit(model).scale(0.5, about=(0, 0), **ALWAYS).video().render(0.5).mean()
    assert isinstance(edit(model).rotate(0.5, about=(0, 0)).video(), VideoModel)
