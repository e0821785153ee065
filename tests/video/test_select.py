"""Selections: the right Gaussians, by their contribution to the image."""

import dataclasses

import equinox as eqx
import jax
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from object_clips import BACKGROUND, BOX, COLOR, DISC, NUM_FRAMES, SPEED, START, named_model, square, textured_clip
from soft_models import soft_model

from foldgauss.video import (
    FitConfig,
    FrameTimes,
    Selection,
    Views,
    by_box,
    by_click,
    by_color,
    by_mask,
    by_polygon,
    by_time,
    contribution,
    edit,
    fit,
    influence,
    matte,
    select,
)
from foldgauss.video.models.renderer import VideoRenderer
from foldgauss.video.selection.contributions import Contributions

MODEL, LABEL = named_model()
HEIGHT, WIDTH = MODEL.size
TIMES = np.linspace(0, 1, MODEL.num_frames)


def truth(name):
    return Selection(name == LABEL)


def object_masks(name):
    """(num_frames, height, width): where an object of the named model is, but for what hides it."""
    masks = np.stack([square(MODEL, name, k) for k in range(MODEL.num_frames)])
    return masks if name == DISC else masks & ~object_masks(DISC)


def errors(found, wanted, model=MODEL):
    """The worst frame's shares of what the object, and of what all others add, that were missed and wrongly taken."""
    lit, worst = Contributions(model), np.zeros(2)
    for t in np.linspace(0, 1, 2 * model.num_frames - 1):  # between frames, too
        light = lit.at(t)
        own, chosen = wanted.mask[light.alive], found.mask[light.alive]
        shares = (
            light.total[own & ~chosen].sum() / light.total[own].sum(),
            (light.total[~own & chosen].sum() / light.total[~own].sum()),
        )
        worst = np.maximum(worst, shares)
    return worst


def without(model, selection):
    """The model with the selected Gaussians deleted."""
    keep = ~selection.mask
    splats = jax.tree.map(lambda leaf: leaf[keep] if np.ndim(leaf) else leaf, model.splats)
    return dataclasses.replace(model, splats=splats)


# ----------------------------------------------------------------------------------------------------- sets

bits = st.lists(st.booleans(), min_size=6, max_size=6)


@settings(max_examples=30, deadline=None)
@given(bits, bits)
def test_sets_are_sets(one, other):
    a, b = Selection(np.array(one)), Selection(np.array(other))
    sets = {"a": {k for k in range(6) if one[k]}, "b": {k for k in range(6) if other[k]}}
    for found, wanted in (
        (a | b, sets["a"] | sets["b"]),
        (a & b, sets["a"] & sets["b"]),
        (a - b, sets["a"] - sets["b"]),
        (a ^ b, sets["a"] ^ sets["b"]),
        (~a, set(range(6)) - sets["a"]),
    ):
        assert set(found.indices.tolist()) == wanted
        assert len(found) == len(wanted)
        assert all((k in found) == (k in wanted) for k in range(-2, 9))
    assert (a == b) == (sets["a"] == sets["b"])


def test_selection_is_immutable():
    mask = np.zeros(5, bool)
    one = Selection(mask)
    mask[2] = True
    assert len(one) == 0
    with pytest.raises(ValueError, match="read-only"):
        one.mask[0] = True
    with pytest.raises(dataclasses.FrozenInstanceError):
        one.mask = mask
    assert repr(Selection(mask)) == "Selection(1 of 5)"
    assert one != "none"
    with pytest.raises(TypeError, match="expected a Selection, got ndarray"):
        one & mask


def test_all_none_and_numbers():
    assert len(Selection.all(MODEL)) == len(LABEL) == Selection.none(MODEL).num_gaussians
    assert Selection.of(MODEL, [3, 1, 3]).indices.tolist() == [1, 3]
    assert Selection.of(MODEL, []) == Selection.none(MODEL) == ~Selection.all(MODEL)


# --------------------------------------------------------------------------------------------- contribution


def weights(model, k):
    """The definition, pixel by pixel: (num_gaussians, height, width), float64."""
    lit, options = Contributions(model), model.options
    splats = lit.at_frame(k).splats
    y, x = np.mgrid[: model.size[0], : model.size[1]] + 0.5
    found, light = np.zeros((lit.num_gaussians, *model.size)), np.ones(model.size)
    for i, mean, factor, opacity in zip(splats.alive, splats.mean, splats.factor, splats.opacity, strict=True):
        precision = np.linalg.inv(factor.astype(float) @ factor.T + options.low_pass * np.eye(2))
        offset = np.stack([x - mean[0], y - mean[1]], -1)
        alpha = opacity * np.exp(-0.5 * np.einsum("hwi,ij,hwj->hw", offset, precision, offset))
        alpha = np.where(alpha >= options.alpha_cutoff, np.minimum(alpha, options.alpha_ceiling), 0)
        if model.compositing == "over":
            alpha[light <= options.transmittance_stop] = 0
            found[i], light = light * alpha, light * (1 - alpha)
        else:
            found[i] = alpha
    return found


@pytest.mark.parametrize("compositing", ["over", "sum"])
def test_contribution_is_its_definition(compositing):
    model, _ = named_model(num_frames=5, size=(24, 36), compositing=compositing, each=60)
    rng = np.random.default_rng(0)
    masks = {1: rng.random((24, 36)) < 0.3, 4: rng.random((24, 36))}
    inside, total = contribution(model, masks)
    by_frame = {k: weights(model, k) for k in masks}
    np.testing.assert_allclose(inside, sum((by_frame[k] * masks[k]).sum((1, 2)) for k in masks), rtol=2e-3, atol=5e-3)
    np.testing.assert_allclose(total, sum(by_frame[k].sum((1, 2)) for k in masks), rtol=2e-3, atol=5e-3)
    own = Selection(rng.random(len(total)) < 0.5)
    share = by_frame[1][own.mask].sum(0) / by_frame[1].sum(0)
    np.testing.assert_allclose(matte(model, own, 0.25), share, atol=2e-3)


@pytest.mark.parametrize("t", [0.0, 0.5, 0.77])
def test_removal_changes_only_pixels_of_influence(t):
    selection = truth(DISC)
    reached = influence(MODEL, selection, t)
    before, after = (VideoRenderer(model).frame(t).astype(int) for model in (MODEL, without(MODEL, selection)))
    changed = (before != after).any(-1)
    assert not changed[~reached].any()
    assert 0.05 < changed.mean() <= reached.mean() < 0.2
    assert not matte(MODEL, selection, t)[~reached].any()
    assert not influence(MODEL, Selection.none(MODEL), t).any()


# ----------------------------------------------------------------------------------------------------- masks


@pytest.mark.parametrize("name", [DISC, BOX])
def test_masks_of_all_frames_give_exactly_the_object(name):
    assert by_mask(MODEL, object_masks(name)) == truth(name)
    scaled = object_masks(name).repeat(3, 1).repeat(3, 2)
    assert by_mask(MODEL, scaled) == truth(name)
    assert by_mask(MODEL, object_masks(name).astype(np.float32)) == truth(name)


@pytest.mark.parametrize("name", [DISC, BOX])
@pytest.mark.parametrize("k", [0, 6, 11])
def test_one_mask_selects_the_object_in_all_frames(name, k):
    missed, wrong = errors(by_mask(MODEL, object_masks(name)[k], frame=k), truth(name))
    assert missed < 0.05
    assert wrong < 0.02
    alone = errors(by_mask(MODEL, object_masks(name)[k], frame=k, follow=False), truth(name))[0]
    if k != 6:  # where many are not alive yet, or no more
        assert alone > 0.2


def test_sums_are_selected_too():
    model, label = named_model(compositing="sum")
    missed, _ = errors(by_mask(model, np.stack([square(model, DISC, k) for k in range(12)])), Selection(label == DISC))
    assert missed < 0.05


def test_ways_to_name_frames_are_one():
    masks = object_masks(DISC)
    for found in (
        by_mask(MODEL, {5: masks[5], 4: masks[4]}, follow=False),
        by_mask(MODEL, masks[4:6], frames=(4, 6), follow=False),
    ):
        assert found == by_mask(MODEL, [masks[4], masks[5]], frames=(4, 6), follow=False)
    still = by_mask(MODEL, np.stack([masks[4]] * 12))
    assert still == by_mask(MODEL, masks[4], frames=(0, 12))
    assert by_mask(MODEL, masks[4:5], frame=4) == by_mask(MODEL, masks[4], frame=4)


def test_more_of_a_gaussian_has_to_be_inside_for_a_higher_threshold():
    half = np.zeros((12, *MODEL.size), bool)
    half[:, :, : WIDTH // 2] = True
    few, more, most = (by_mask(MODEL, half, threshold=share) for share in (1.0, 0.5, 0.05))
    assert few - more == more - most == Selection.none(MODEL)
    assert len(few) < len(more) < len(most) < len(LABEL)
    inside, total = contribution(MODEL, half)
    seen = total > 0
    np.testing.assert_array_equal(more.mask[seen], inside[seen] >= 0.5 * total[seen])


def test_gaussians_between_frames_are_decided_by_position():
    """Alive for less than a frame, between two: no picture of a frame shows them."""
    between = np.flatnonzero(np.abs((MODEL.splats.gaussians().time_loc * 11) % 1 - 0.5) < 0.1)
    change = np.asarray(MODEL.splats.log_time_scale).copy()
    change[between] = np.log(0.02 / 11)
    model = eqx.tree_at(lambda m: m.splats.log_time_scale, MODEL, change)
    assert contribution(model, np.ones(MODEL.size, bool), frames=(0, 12))[1][between].max() == 0
    found = by_mask(model, object_masks(DISC))
    hidden = between[LABEL[between] != BACKGROUND]
    assert len(hidden) > 40
    assert (found.mask[hidden] == (LABEL[hidden] == DISC)).mean() > 0.98  # some stand in the disc's rim
    one = by_mask(model, object_masks(DISC)[0], frame=0)  # followed: by their neighbors' place
    assert (one.mask[hidden] == (LABEL[hidden] == DISC)).mean() > 0.9
    alone = by_mask(model, object_masks(DISC)[0], frame=0, follow=False)
    early = MODEL.splats.gaussians().time_loc[hidden] < 0.5 / 11
    np.testing.assert_array_equal(alone.mask[hidden], (LABEL[hidden] == DISC) & early)


def test_labels_do_not_propagate_across_a_cut():
    logits = np.zeros(11, np.float32)
    logits[5] = np.log(25.0)
    model = dataclasses.replace(MODEL, frame_times=FrameTimes(logits))
    t = np.asarray(model.frame_times.times())
    assert t[6] - t[5] > 0.6
    k = 2
    where = matte(model, truth(DISC), float(t[k])) > 0.5
    found = by_mask(model, where, frame=k)
    before = by_time(model, frames=(0, 6), alive=True)
    assert len(found & truth(DISC)) > 0
    assert not len(found - before)
    assert len(truth(DISC) - before) > 10


def test_masks_of_a_smaller_size_have_rounded_sides():
    """24 of 96 columns and 10 or 11 of 42 rows, as `select(moving=True)` renders images."""
    large = dataclasses.replace(soft_model(), size=(42, 96))
    for rows in (10, 11):
        assert len(by_mask(large, np.ones((rows, 24), bool), frame=0))
    for rows in (9, 12):
        with pytest.raises(ValueError, match="mask: expected the aspect"):
            by_mask(large, np.ones((rows, 24), bool), frame=0)


# ------------------------------------------------------------------------------------- boxes, colors, times


def test_boxes_and_polygons_are_masks():
    mask = np.zeros(MODEL.size, bool)
    mask[10:30, 5:25] = True
    wanted = by_mask(MODEL, mask, frame=3)
    assert by_box(MODEL, (5, 10, 25, 30), frame=3) == wanted
    assert by_box(MODEL, (4.6, 9.6, 25.4, 30.4), frame=3) == wanted  # by centers
    assert by_polygon(MODEL, [(5, 10), (25, 10), (25, 30), (5, 30)], frame=3) == wanted
    assert by_box(MODEL, (5, 10, 25, 30)) == by_mask(MODEL, mask, frames=(0, 12))
    y, x = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    triangle = (x > 10) & (y > 5) & (x - 10 + 2 * (y - 5) < 50)
    assert by_polygon(MODEL, [(10, 5), (60, 5), (10, 30)], frame=3) == by_mask(MODEL, triangle, frame=3)


@pytest.mark.parametrize("name", [DISC, BOX, BACKGROUND])
def test_colors(name):
    assert by_color(MODEL, COLOR[name], tolerance=12, seen=False) == truth(name)
    missed, wrong = errors(by_color(MODEL, COLOR[name], tolerance=20), truth(name))
    assert max(missed, wrong) < 0.03
    assert len(by_color(MODEL, COLOR[name], tolerance=0)) == 0


def test_seen_color_is_that_of_the_image():
    """Two of opposite tints, one on the other, look gray."""
    color = np.asarray(MODEL.splats.color_dc).copy()
    disc = truth(DISC).indices
    color[disc[::2]], color[disc[1::2]] = (2.0, -2.0, 0.0), (-2.0, 2.0, 0.0)
    model = eqx.tree_at(lambda m: m.splats.color_dc, MODEL, color)
    olive = (0.5, 0.5, 0.5)
    assert not len(by_color(model, olive, tolerance=15, seen=False) & truth(DISC))
    assert len(by_color(model, olive, tolerance=15) & truth(DISC)) > 0.1 * len(disc)


def test_times():
    own, spread = (np.asarray(leaf) for leaf in (MODEL.splats.gaussians().time_loc, MODEL.splats.log_time_scale))
    np.testing.assert_array_equal(by_time(MODEL, (0.2, 0.6)).mask, (own >= 0.2) & (own <= 0.6))
    reach = 3.0348 * np.exp(spread)
    alive = (own - reach < 0.1) & (own + reach > 0.05)
    np.testing.assert_array_equal(by_time(MODEL, (0.05, 0.1), alive=True).mask, alive)
    np.testing.assert_array_equal(by_time(MODEL, frames=(3, 6)).mask, (own >= 2.5 / 11) & (own <= 5.5 / 11))
    np.testing.assert_array_equal(by_time(MODEL, frame=0).mask, own <= 0.5 / 11)
    assert by_time(MODEL, frame=4, alive=True) == by_time(MODEL, (TIMES[4], TIMES[4]), alive=True)
    assert by_time(MODEL, frames=(0, 12)) == Selection.all(MODEL)


# ----------------------------------------------------------------------------------------------------- clicks


def center(name, k):
    return tuple(np.array([WIDTH, HEIGHT]) / 2 + WIDTH * (START[name] + TIMES[k] * SPEED[name]))


@pytest.mark.parametrize("name", [DISC, BOX])
@pytest.mark.parametrize("k", [0, 6, 10])
def test_a_click_grows_to_the_object(name, k):
    missed, wrong = errors(by_click(MODEL, center(name, k), frame=k, tolerance=25), truth(name))
    assert missed < 0.05
    assert wrong < 0.02


def test_click_stops_at_a_motion_boundary():
    """Disc and wall of one color."""
    color = np.broadcast_to(np.float32([0.5, 0.2, 0.1]), (len(LABEL), 3))
    model = eqx.tree_at(lambda m: m.splats.color_dc, MODEL, color)
    found = by_click(model, center(DISC, 6), frame=6)
    missed, wrong = errors(found, truth(DISC))
    assert missed < 0.05
    assert wrong < 0.05


# ----------------------------------------------------------------------------------------------------- the door


def test_criteria_are_intersected():
    box = (5, 5, 40, 40)
    both = by_box(MODEL, box, frame=0) & by_color(MODEL, COLOR[DISC], tolerance=25)
    assert 0 < len(both) < len(by_box(MODEL, box, frame=0))
    assert select(MODEL, box=box, frame=0, color=COLOR[DISC], tolerance=25) == both
    assert select(MODEL, box=box, frame=0, color=COLOR[DISC], tolerance=25, times=(0, 0.3)) == both & by_time(
        MODEL, (0, 0.3)
    )
    assert select(MODEL, frames=(2, 5), alive=True) == by_time(MODEL, frames=(2, 5), alive=True)
    assert select(MODEL, mask=object_masks(DISC)) == truth(DISC)
    assert select(MODEL, click=center(DISC, 6), frame=6) == by_click(MODEL, center(DISC, 6), frame=6)
    assert select(MODEL, polygon=[(0, 0), (9, 0), (9, 9)], frame=0, follow=False) == by_polygon(
        MODEL, [(0, 0), (9, 0), (9, 9)], frame=0, follow=False
    )


ONES = np.ones((48, 72), bool)
WRONG = [
    ({"mask": np.zeros((48, 72), bool), "frame": 0}, "mask: expected a mask that is not empty"),
    ({"mask": {}}, "mask: expected a mask that is not empty"),
    ({"mask": np.ones((48, 48), bool), "frame": 0}, "mask: expected the aspect of the model's 48x72, got 48x48"),
    ({"mask": np.ones((48, 72), np.uint8), "frame": 0}, r"mask: expected bool .* From labels .*mask=\(levels > 127\)"),
    ({"mask": np.full((48, 72), 1.5), "frame": 0}, r"mask: .*fractions in \[0, 1\]"),
    ({"mask": np.full((48, 72), np.nan), "frame": 0}, r"mask: .*fractions in \[0, 1\]"),
    ({"mask": ONES}, "mask: .*frame=k"),
    ({"mask": "m.png", "frame": 0}, "mask: expected .*got the path 'm.png'.*read_masks"),
    ({"mask": np.ones((5, 48, 72), bool)}, "mask: expected one of shape .*, or 12 of them"),
    ({"mask": np.ones(5, bool), "frame": 0}, "mask: expected one of shape"),
    ({"mask": np.ones((0, 0), bool), "frame": 0}, "mask: expected bool"),
    *(({"mask": ONES, "frame": k}, r"frame: expected a whole number in \[0, 11\]") for k in (12, -1, True)),
    ({"mask": ONES, "frame": 1, "frames": (0, 2)}, "frame, frames: expected one of the two"),
    *(({"mask": ONES, "frames": k}, "frames: expected .first, stop. with") for k in ((3, 3), (0, 13), (-1, 2), (1,))),
    *(({"mask": ONES, "frames": k}, "frames: .*frame=k") for k in (3, "13", (None, 0), (1.0, 3))),
    ({"mask": {0: ONES}, "frame": 0}, "mask: .*frames given once"),
    ({"mask": {0: np.ones((2, 48, 72), bool)}}, "mask: expected bool"),
    ({"mask": {99: ONES}}, "frame: expected"),
    *(({"mask": ONES, "frame": 0, "threshold": share}, "threshold") for share in (0, "half")),
    *(({"box": box}, "box") for box in ((5, 10, 5, 30), (25, 10, 5, 30), (0, 0, np.nan, 3), (1, 2, 3), "box")),
    ({"box": np.arange(100.0).reshape(10, 10)}, r"box: expected \(x0, y0, x1, y1\) in pixels, got ndarray\.$"),
    ({"box": MODEL, "frame": 0}, r"box: expected .*got VideoModel\.$"),
    ({"box": (80, 0, 90, 10)}, "box: expected pixels of a 48x72 frame in it, got none"),
    ({"box": [[1, 2], [3]], "frame": 0}, "box: expected"),
    *(({"polygon": p}, "polygon") for p in ([(0, 0), (1, 1)], [(0, 0, 0)] * 3, [(0, 0), (1, np.inf), (3, 3)], 7)),
    ({"polygon": [[1, 2], [3]], "frame": 0}, "polygon: expected"),
    *(({"color": c}, r"color: expected red, green and blue in \[0, 1\]") for c in ((0.5, 0.5), (2, 0, 0), "red")),
    *(({"color": c}, r"color: expected red, green and blue in \[0, 1\]") for c in ((np.nan, 0, 0), (200, 10, 10))),
    *(({"color": (0, 0, 0), "tolerance": tolerance}, "tolerance") for tolerance in (-1, np.nan, "5")),
    *(({"times": times}, "times: expected") for times in ((0.5, 0.2), (-0.1, 0.5), (0, 1.1), (0, np.nan), 0.5)),
    *(({"click": c, "frame": 0}, r"click: expected \(x, y\)") for c in ((-1, 5), (72, 5), (5, 48), (np.nan, 1), (1,))),
    ({"click": "here", "frame": 0}, r"click: expected \(x, y\)"),
    ({"click": (5, 5)}, "frame: expected the frame that was clicked in"),
    ({"click": (5, 5), "frames": (0, 2)}, r"frames: expected one of mask, .*, got \(0, 2\)\. For .* click: frame=k"),
    ({}, "select: expected at least one criterion"),
    ({"tolerance": 5.0, "frame": 1}, "tolerance: expected one of color, click with it"),
    ({"color": (1, 0, 0), "threshold": 0.2}, "threshold: expected one of mask"),
    ({"color": (1, 0, 0), "follow": False}, "follow: expected one of mask"),
    ({"box": (0, 0, 9, 9), "alive": True}, "alive: expected one of times"),
]


@pytest.mark.parametrize(("criteria", "match"), WRONG)
def test_malformed_criteria(criteria, match):
    with pytest.raises(ValueError, match=f"^{match}") as caught:
        select(MODEL, **criteria)
    assert "\n" not in str(caught.value)


# ------------------------------------------------------------------------------------------------- a real fit


@pytest.fixture(scope="module")
def fitted():
    frames, labels = textured_clip()
    return fit(frames, FitConfig(num_gaussians=3000, steps=600, views=Views(error_fraction=0), seed=2)).model, labels


def overlap(model, selection, masks):
    """Intersection over union of true masks and the pixels that are mostly the selection's; mean over frames."""
    times, found = np.asarray(model.frame_times.times()), []
    for t, mask in zip(times, masks, strict=True):
        mostly = matte(model, selection, float(t)) > 0.5
        found.append((mostly & mask).sum() / (mostly | mask).sum())
    return np.mean(found)


@pytest.mark.slow
@pytest.mark.parametrize("name", [DISC, BOX])
def test_a_fitted_object_is_selected(fitted, name):
    model, labels = fitted
    masks = labels == name
    assert overlap(model, by_mask(model, masks), masks) > 0.97
    assert overlap(model, by_mask(model, {0: masks[0], NUM_FRAMES - 1: masks[-1]}), masks) > 0.93
    y, x = np.argwhere(masks[4]).mean(0)
    assert overlap(model, by_click(model, (x, y), frame=4), masks) > 0.95
    other = by_mask(model, labels == 3 - name)
    assert overlap(model, other, masks) < 0.05  # the measure can fail


def test_frames_with_open_ends():
    model = soft_model()
    box = (12, 10, 32, 30)
    assert by_box(model, box, frames=(2, None)) == by_box(model, box, frames=(2, 7))
    assert by_box(model, box, frames=(None, 3)) == by_box(model, box, frames=np.array([0, 3]))


BROKEN = eqx.tree_at(lambda m: m.splats.loc, MODEL, np.full_like(MODEL.splats.loc, np.nan))
ALL, THREE = Selection.all(MODEL), np.zeros(3, bool)
WRONG_CALLS = [
    *((lambda mask=mask: Selection(mask), r"mask: expected bool \(num_gaussians,\)") for mask in (0 * THREE, [1, 0])),
    (lambda: Selection(THREE[:, None]), r"mask: expected bool \(num_gaussians,\)"),
    *(
        (lambda indices=indices: Selection.of(MODEL, indices), "indices: expected whole numbers")
        for indices in ([-1], [len(LABEL)], [0.5], [[1]], [True])
    ),
    (
        lambda: Selection(THREE) | Selection(np.zeros(4, bool)),
        "selection: expected a selection of 3 Gaussians, got one",
    ),
    (lambda: by_color(BROKEN, (0, 0, 0)), "model: expected finite numbers"),
    (lambda: matte(MODEL.splats, ALL, 0.5), "model: expected a VideoModel, got FoldedSplats"),
    (lambda: by_click("model.safetensors", (1, 1), frame=0), "model: expected a VideoModel, got str"),
    (lambda: matte(MODEL, Selection(THREE), 0.5), "selection"),
    (lambda: matte(MODEL, ALL, [0.1, 0.2]), r"t: expected one time in \[0, 1\], got \[0\.1, 0\.2\]"),
    (lambda: by_box("m", (1, 2, 3, 4)), "model: expected a VideoModel, got str. The model comes first"),
    (lambda: by_box((1, 2, 3, 4), MODEL, frame=0), "model: expected a VideoModel, got tuple"),
    (lambda: by_mask(np.ones((4, 4), bool), MODEL, frame=0), "model: .*got ndarray"),
    (lambda: by_box(edit(MODEL), (1, 2, 3, 4)), "model: .*got Edit. End the chain with .video"),
    (lambda: Selection.all(ALL), "model: .*got Selection"),
    (lambda: Selection.of(3, [1]), "model: .*got int"),
    (lambda: matte(MODEL, ALL.mask, 0.5), r"selection: expected a Selection, got ndarray.*Selection\(mask\)"),
    (lambda: influence(MODEL, 0.5, ALL), r"selection: .*The order is \(model, selection, t\)"),
    (lambda: matte(MODEL, ALL, 3), "t: expected a time in"),
    (lambda: influence(MODEL, ALL, "x"), "t: expected a time in"),
    (
        lambda: by_click(without(MODEL, truth(BACKGROUND)), (0.5, 0.5), frame=0),
        "click: expected a pixel where something is rendered",
    ),
    *(
        (lambda options=options: by_time(MODEL, **options), "times, frames, frame: expected one")
        for options in ({}, {"times": (0, 1), "frame": 1})
    ),
]


@pytest.mark.parametrize(("call", "message"), WRONG_CALLS)
def test_wrong_calls(call, message):
    with pytest.raises(ValueError, match=f"^{message}"):
        call()
