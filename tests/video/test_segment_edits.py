"""Edits of clips in segments: one chain for all, objects carried over the seams, times those of the whole clip."""

import dataclasses
import functools
import gc
import weakref

import numpy as np
import pytest
from object_clips import BOX, DISC, SPEED, named_model, square
from scipy.special import expit
from soft_models import NUM, OBJECT, assert_same, soft_model, soft_segments

from foldgauss.render import Camera
from foldgauss.video import (
    Clock,
    EditedVideo,
    Segment,
    SegmentedEdit,
    SegmentedVideo,
    Selection,
    VideoModel,
    by_color,
    by_mask,
    by_time,
    edit,
    influence,
    layers,
)
from foldgauss.video.segmented.segmented_video import MAX_PREPARED

#: Three segments of a dozen frames, three of which are shared with each neighbor.
FIRSTS, LENGTH, NUM_FRAMES = (0, 9, 18), 12, 30
SHARED = (9, 10, 11, 18, 19, 20)


def span_of_scene(first, seed):
    """A dozen frames of one long scene, by Gaussians of their own: the model, and what each was made for."""
    model, label = named_model(LENGTH, (40, 60), each=150, seed=seed)
    own = expit(np.float64(model.splats.time_loc_logit))
    later = (first + own * (LENGTH - 1)) / (NUM_FRAMES - 1) - own
    speed = np.array([SPEED[name] for name in label])
    loc = np.float32(model.splats.loc + later[:, None] * speed)
    coefficients = np.float32(model.splats.coefficients * (LENGTH - 1) / (NUM_FRAMES - 1))
    return dataclasses.replace(
        model, splats=dataclasses.replace(model.splats, loc=loc, coefficients=coefficients)
    ), label


@functools.cache
def scene():
    """The long scene in three segments, labels of each."""
    models, labels = zip(*(span_of_scene(first, seed) for seed, first in enumerate(FIRSTS)), strict=True)
    return SegmentedVideo.from_models(list(zip(FIRSTS, models, strict=True))), labels


@functools.cache
def pictures_of_scene():
    return np.stack(list(scene()[0].frames()))


def disc_box(k):
    rows, columns = np.nonzero(square(scene()[0], DISC, k))
    return tuple(map(int, (columns.min(), rows.min(), columns.max() + 1, rows.max() + 1)))


@functools.cache
def disc():
    """The disc, by a box in a frame of the first segment alone."""
    return edit(scene()[0]).select(box=disc_box(2), frame=2).selection


def drawn(video):
    return np.stack(list(video.frames())).astype(int)


# ------------------------------------------------------------------------------------ one segment is the model


def wider(gaussians, t):
    return dataclasses.replace(gaussians, factor=gaussians.factor * np.float32(1 + t))


def orbit(t):
    return Camera.front(0.625).orbit(0.5 * t, 0.0)


CHAINS = {
    "move": lambda e: e.move((0.2, 0.1)),
    "about its center": lambda e: e.rotate(0.4).scale(1.3),
    "a color, eased": lambda e: e.recolor((0.9, 0.2, 0.1), frames=(2, 6), ease=1, curve="smooth"),
    "a color": lambda e: e.recolor((0.9, 0.2, 0.1)),
    "hue, at times": lambda e: e.recolor(hue=0.3, times=(0.2, 0.61), ease=(0.5, 1)),
    "copies": lambda e: e.multiply([(0.1, 0.0), (0.2, 0.1)], delays=[0.05, 0.2], scale=0.8).to_front(),
    "copies over a span": lambda e: e.multiply([(0.1, 0.0)], delays=0.1, originals=True, frames=(1, 4)).opacity(0.5),
    "later": lambda e: e.retime(shift=0.05),
    "held": lambda e: e.retime(stretch=2, about=0.3, frames=(1, None)),
    "a clock": lambda e: e.retime(clock=Clock((0, 0.5, 1), (0, 1, 0))),
    "still": lambda e: e.freeze(2.5).to_back(),
    "gone": lambda e: e.vanish().select().opacity(0.7),
    "in space": lambda e: e.place(depth=0.2, rotate=(0, 0.4, 0)).seen_from(orbit),
    "a function": lambda e: (
        e.apply(wider, frame=3).select(lambda video: np.arange(NUM) % 3 == 0).transform([[1, 0.2], [0, 1]])
    ),
}


@pytest.mark.parametrize("name", CHAINS)
def test_one_segment_is_edited_as_the_model_to_the_bit(name):
    model = soft_model()
    box = {"box": (12, 10, 32, 30), "frame": 3}
    wanted = CHAINS[name](edit(model).select(**box)).video()
    got = CHAINS[name](edit(SegmentedVideo.from_models([(0, model)])).select(**box)).video()
    assert isinstance(got, SegmentedVideo)
    assert_same(got.segments[0].model, wanted)
    assert (got.num_gaussians, got.num_parameters) == (wanted.num_gaussians, wanted.num_parameters)
    np.testing.assert_array_equal(drawn(got), drawn(wanted))


QUESTIONS = {
    "box": {"box": (12, 10, 32, 30), "frame": 3},
    "box along": {"box": (12, 10, 32, 30), "frames": (2, None), "threshold": 0.7},
    "polygon": {"polygon": [(5, 5), (40, 8), (20, 38)], "frames": (1, 4), "follow": False},
    "mask": {"mask": {1: np.eye(40, 64, 10) > 0, 4: np.tri(40, 64) > 0}},
    "masks": {"mask": np.stack([np.tri(20, 32, k) for k in range(7)]).astype(np.float32)},
    "click": {"click": (22, 20), "frame": 3, "tolerance": 30},
    "color": {"color": (0.6, 0.4, 0.5), "tolerance": 30},
    "frames": {"frames": (2, 4)},
    "times": {"times": (0.3, 0.62)},
    "alive": {"times": (0.0, 0.2), "alive": True, "color": (0.6, 0.4, 0.5), "tolerance": 25},
    "all": {"box": (2, 2, 32, 38), "frame": 3, "color": (0.5, 0.5, 0.5), "times": (0.2, 0.9), "tolerance": 40},
}


@pytest.mark.parametrize("name", QUESTIONS)
def test_one_segment_answers_as_the_model(name):
    wanted = edit(soft_model()).select(**QUESTIONS[name]).selection
    got = edit(SegmentedVideo.from_models([(0, soft_model())])).select(**QUESTIONS[name]).selection
    assert 0 < len(wanted) < NUM
    assert got == wanted


# ------------------------------------------------------------------------------------ who, from segment to segment


def by_segment(video, selection):
    """The selection of each segment."""
    ends = np.cumsum([segment.num_gaussians for segment in video.segments])
    return tuple(map(Selection, np.split(selection.mask, ends[:-1])))


def shares(selection):
    """Of each segment's disc what is selected, and of all else that moves."""
    masks, labels = [part.mask for part in by_segment(scene()[0], selection)], scene()[1]
    of_disc = [mask[label == DISC].mean() for mask, label in zip(masks, labels, strict=True)]
    return of_disc, [mask[label == BOX].mean() for mask, label in zip(masks, labels, strict=True)]


@pytest.mark.parametrize("k", [14, *(pytest.param(k, marks=pytest.mark.slow) for k in (2, 27))])
def test_an_object_is_carried_both_ways(k):
    """From a segment to all others, by a box in the first one, too."""
    of_disc, of_box = shares(disc())
    assert min(of_disc) > 0.9
    assert max(of_box) == 0
    masks = np.stack([square(scene()[0], DISC, number) for number in (k - 1, k)])
    of_disc, of_box = shares(edit(scene()[0]).select(mask=masks[1], frame=k).selection)
    assert min(of_disc) > 0.9
    assert max(of_box) < 0.05
    several = edit(scene()[0]).select(mask=masks, frames=(k - 1, k + 1)).selection
    assert min(shares(several)[0]) > 0.9


def test_a_click_is_carried():
    model, label = scene()[0].segments[2].model, scene()[1][2]
    rows, columns = np.nonzero(square(scene()[0], DISC, 28))
    place = (float(columns.mean()), float(rows.mean()))
    alone = edit(SegmentedVideo.from_models([(0, model)])).select(click=place, frame=10, tolerance=25).selection
    assert alone.mask[label == DISC].mean() > 0.8
    carried = edit(scene()[0]).select(click=place, frame=28, tolerance=25).selection
    assert by_segment(scene()[0], carried)[2] == alone
    assert min(shares(carried)[0]) > 0.75
    assert max(shares(carried)[1]) < 0.1


def test_what_is_told_of_both_ends_is_told_between():
    """The middle segment hears from both neighbors: a disc that the last one denies ends in it."""
    video = scene()[0]
    nothing = np.zeros((40, 60), bool)
    nothing[0, 0] = True
    masks = {2: square(video, DISC, 2)} | dict.fromkeys(range(21, 30), nothing)
    selection = edit(video).select(mask=masks).selection
    assert shares(selection)[0][0] > 0.9
    assert shares(selection)[0][2] == 0
    middle = scene()[0].segments[1].model
    shown = carried_masks(0, 1, selection) | carried_masks(2, 1, selection)
    assert by_segment(video, selection)[1] == by_mask(middle, shown)


def carried_masks(one, other, selection):
    from foldgauss.video import matte

    segments = scene()[0].segments
    shared = range(max(segments[one].first, segments[other].first), min(segments[one].stop, segments[other].stop))
    model = segments[one].model
    times = np.asarray(model.frame_times.times())
    chosen = by_segment(scene()[0], selection)[one]

    def picture(k):
        return matte(model, chosen, float(times[k - segments[one].first])) >= 0.5

    return {k - segments[other].first: picture(k) for k in shared}


def test_nothing_is_carried_over_a_cut_or_without_follow():
    box = {"box": disc_box(2), "frame": 2}
    still = by_segment(scene()[0], edit(scene()[0]).select(**box, follow=False).selection)
    assert len(still[0])
    assert not len(still[1]) + len(still[2])
    models = [segment.model for segment in scene()[0].segments]
    cut = SegmentedVideo.from_models([(0, models[0]), (12, models[1]), (21, models[2])])
    found = by_segment(cut, edit(cut).select(**box).selection)
    assert found[0] == by_segment(cut, disc())[0]
    assert not len(found[1]) + len(found[2])
    found = by_segment(cut, edit(cut).select(box=disc_box(10), frame=13).selection)
    assert [len(part) > 0 for part in found] == [False, True, True]


def test_colors_and_times_are_asked_of_every_segment():
    video, labels = scene()
    red = edit(video).select(color=(0.9, 0.3, 0.1), tolerance=25).selection
    each = tuple(by_color(segment.model, (0.9, 0.3, 0.1), tolerance=25) for segment in video.segments)
    assert by_segment(video, red) == each
    both = edit(video).select(box=disc_box(2), frame=2, color=(0.9, 0.3, 0.1), tolerance=25).selection
    assert both == disc() & red
    middle = by_segment(video, edit(video).select(frames=(10, 15)).selection)
    last = video.segments[2].model
    assert middle[0] == by_time(video.segments[0].model, frames=(10, 12))
    assert middle[1] == by_time(video.segments[1].model, frames=(1, 6))
    assert middle[2] == Selection.none(last)
    timed = edit(video).select(times=(10 / 29, 20 / 29), alive=True).selection
    assert by_segment(video, timed)[2] == by_time(last, (0.0, 2 / 11), alive=True)
    assert sum(label.size for label in labels) == timed.num_gaussians


# ------------------------------------------------------------------------------------------------ pictures


def reached(k, selection):
    """Where a selection's Gaussians are at a frame, in whichever segments show it."""
    there = np.zeros((40, 60), bool)
    for segment, part in zip(scene()[0].segments, by_segment(scene()[0], selection), strict=True):
        if segment.first <= k < segment.stop:
            model = segment.model
            there |= influence(model, part, float(model.frame_times.times()[k - segment.first]))
    return there


def orange(pictures):
    """How much of a frame looks like the disc."""
    return (pictures[..., 0].astype(int) - pictures[..., 1] > 70).sum((1, 2))


@pytest.mark.parametrize("name", ["vanish", "recolor", "move"])
def test_an_object_is_edited_in_all_frames_and_nothing_else_is(name):
    video, before = scene()[0], pictures_of_scene()
    chain = edit(video).select(disc())
    edited = {"vanish": chain.vanish, "recolor": lambda: chain.recolor((0.2, 0.2, 1.0)), "move": None}[name]
    edited = chain.move((0.0, -0.3)).video() if edited is None else edited().video()
    assert all(isinstance(segment.model, VideoModel) for segment in edited.segments)
    after = np.stack(list(edited.frames()))
    changed = (before != after).any(-1)
    for k in range(NUM_FRAMES):
        touched = reached(k, disc())
        if name == "move":
            touched = touched | np.roll(touched, -18, 0)
        assert not changed[k][~touched].any()
        assert changed[k][square(video, DISC, k)].mean() > 0.5, k
    if name != "move":  # nothing of it is left, in no frame: no flash of it at the seams
        assert (orange(before) > 40).all()
        assert (orange(after) < 0.25 * orange(before)).all()


def progress_at(position, last, *, frame=None, frames=None, times=None, ease=0, curve="linear"):
    """How far along an edit over a span is at a frame position, by the words of `make_frame_span`."""
    if times is not None:
        begin, end = times[0] * last, times[1] * last
    else:
        first, stop = (frame, frame + 1) if frames is None else frames
        begin = -np.inf if first is None else first - 0.5
        end = np.inf if stop is None else stop - 0.5
    rise, fall = ease if isinstance(ease, tuple) else (ease, ease)
    if not begin <= position < end:
        return 0.0
    into = (position - begin) / rise if rise and np.isfinite(begin) else 1.0
    out_of = (end - position) / fall if fall and np.isfinite(end) else 1.0
    s = min(1.0, into, out_of)
    return s if curve == "linear" else s * s * (3 - 2 * s)


@pytest.mark.parametrize("evenly", [True, pytest.param(False, marks=pytest.mark.slow)])
@pytest.mark.parametrize(
    "when",
    [
        {"frames": (2, 9), "ease": 3, "curve": "smooth"},
        {"frames": (5, 11), "ease": (4, 1)},
        {"frames": (None, 12), "ease": 5},
        {"times": (0.3, 0.8), "ease": 2},
        {"frame": 5},
        {"frame": 9},
        {"frames": (4, 7)},
    ],
    ids=str,
)
def test_a_span_acts_over_seams_as_if_there_were_none(when, evenly):
    """Light by a factor that comes and goes: each picture is the unedited one times it, whichever segment shows it."""
    video = soft_segments(evenly=evenly)
    edited = edit(video).recolor(gain=0.2, **when).video()
    times = video.frame_times.times()
    last = len(times) - 1
    progress = np.array([progress_at(k, last, **when) for k in range(len(times))])
    assert 0 < (progress > 0).sum() < len(times)
    before, after = np.stack(list(video.frames())), np.stack(list(edited.frames()))
    exact = np.stack([video.render(t) for t in times])
    for k, s in enumerate(progress):
        np.testing.assert_allclose(edited.render(times[k]), exact[k] * (1 - 0.8 * s), atol=2e-6, err_msg=f"frame {k}")
        if s == 0:
            np.testing.assert_array_equal(before[k], after[k])
    between = (np.arange(4 * len(times) - 3) / 4 / (len(times) - 1))[1::4]
    for t in between:
        position = t * (len(times) - 1)
        seen = [number for number, _ in video.weights(position)]
        if len(seen) == 1:  # between the frames of a fade's ends one model shows its last frame, edited as that is
            expected = video.render(t) * (1 - 0.8 * progress_at(position, last, **when))
            np.testing.assert_allclose(edited.render(t), expected, atol=1e-5)


def test_what_a_span_does_not_reach_is_the_same_segment():
    video = soft_segments()
    edited = edit(video).move((0.1, 0), frames=(7, 9)).video()
    assert edited.segments[0] is video.segments[0]
    assert edited.segments[2] is not video.segments[2] or video.segments[2].first > 8
    assert isinstance(edited.segments[1].model, EditedVideo)
    unchanged = edit(video).move((0.0, 0.0)).video()
    assert unchanged.segments == video.segments
    copies = edit(video).multiply([(0.1, 0)], frames=(0, 2))
    assert copies.video().segments[2] is video.segments[2]
    then = copies.recolor(gain=0.5).video()  # of the copies, which the last segments have not
    assert then.segments[2] is video.segments[2]
    both = edit(video).multiply([(0.1, 0)], originals=True, frames=(0, 2)).recolor(gain=0.5).video()
    assert both.segments[2] is not video.segments[2]


def test_one_color_for_the_object_in_all_segments():
    """By the mean lightness over all, so that it does not jump where one segment follows another."""
    video = soft_segments()
    models = [segment.model for segment in video.segments]
    opacity = np.concatenate([expit(np.float64(model.splats.opacity_logit)) for model in models])
    color = np.concatenate([np.maximum(0.5 + 0.28209479177387814 * np.float64(m.splats.color_dc), 0) for m in models])
    lightness = color @ [0.2126, 0.7152, 0.0722]
    mean = (opacity * lightness).sum() / opacity.sum()
    wanted = np.outer([0.9, 0.3, 0.2], [0.2126, 0.7152, 0.0722])
    by_hand = edit(video).recolor(gain=1 / mean, matrix=wanted).video()
    np.testing.assert_allclose(drawn(edit(video).recolor((0.9, 0.3, 0.2)).video()), drawn(by_hand), atol=1)
    alone = edit(models[0]).recolor((0.9, 0.3, 0.2)).video()
    assert np.abs(drawn(alone)[0] - drawn(by_hand)[0]).max() > 3
    assert edit(video).recolor((0.9, 0.3, 0.2), frame=0).video().segments[2] is video.segments[2]


# ------------------------------------------------------------------------------------------------ clocks, functions


@pytest.mark.parametrize("evenly", [True, False])
def test_clocks_go_by_the_clip(evenly):
    """Shown at frame k what is there at another, where one segment has both: frames 4 to 12 are the second's."""
    video = soft_segments(evenly=evenly)
    assert [segment.first for segment in video.segments] == [0, 4, 10]
    before, per_frame = drawn(video), 1 / (video.num_frames - 1)
    later = edit(video).retime(shift=2 * per_frame, frames=(9, 10)).video()
    np.testing.assert_allclose(drawn(later)[9], before[7], atol=1)
    np.testing.assert_array_equal(drawn(later)[:9], before[:9])
    np.testing.assert_array_equal(drawn(later)[10:], before[10:])
    still = drawn(edit(video).freeze(7, frames=(7, 10)).video())
    np.testing.assert_allclose(still[7:10], before[[7, 7, 7]], atol=1)
    clock = Clock((7 * per_frame, 9 * per_frame), (9 * per_frame, 7 * per_frame))
    turned = drawn(edit(video).retime(clock=clock, frames=(7, 10)).video())
    np.testing.assert_allclose(turned[7:10], before[[9, 8, 7]], atol=1)
    fast = edit(video).retime(stretch=0.5, about=7 * per_frame, frames=(7, 9)).video()
    np.testing.assert_allclose(fast.render(7.5 * per_frame), video.render(8 * per_frame), atol=1e-4)
    half = edit(video).retime(stretch=2, about=7 * per_frame, frames=(7, 10)).video()
    wanted = edit(video.segments[1].model)
    own = np.asarray(video.segments[1].model.frame_times.times())
    wanted = wanted.retime(clock=Clock.frozen(float((own[3] + own[4]) / 2)), frame=4).video()
    np.testing.assert_allclose(half.render(8 * per_frame), wanted.render(float(own[4])), atol=1e-4)


@pytest.mark.parametrize(("number", "frames"), [(0, 2), (2, -2)])
def test_the_first_segment_holds_before_the_clip_and_the_last_behind_it(number, frames):
    """As a model of one piece does: there is no other segment to ask."""
    video = soft_segments(evenly=True)
    segment, steps = video.segments[number], video.num_frames - 1
    mask = np.repeat(np.arange(3) == number, NUM) & np.tile(OBJECT, 3)
    held = edit(video).select(mask).retime(shift=frames / steps).video()
    wanted = edit(segment.model).select(OBJECT).retime(shift=frames / (segment.num_frames - 1)).video()
    alone = slice(3, None) if number else slice(0, 4)  # of the segment's frames, those that no other shares
    np.testing.assert_allclose(drawn(held)[segment.first : segment.stop][alone], drawn(wanted)[alone], atol=1)
    assert [one is other for one, other in zip(held.segments, video.segments, strict=True)].count(True) == 2
    with pytest.raises(ValueError, match=r"shift: .*, got frame \d+ for frame \d+, which is in another"):
        edit(video).select(mask).retime(shift=-frames / steps).video()


@pytest.mark.parametrize(
    ("parameter", "change"),
    [
        ("shift", lambda e: e.retime(shift=0.1)),
        ("at", lambda e: e.freeze(2)),
        ("delays", lambda e: e.multiply([(0.1, 0)], delays=0.1)),
        ("clock", lambda e: e.retime(clock=Clock((0, 0.5, 1), (0, 1, 0)))),
        ("shift", lambda e: e.retime(shift=-0.4, frames=(4, 6))),
        ("at", lambda e: e.freeze(2, frames=(8, 9))),
    ],
)
def test_what_another_segment_has_is_refused(parameter, change):
    with pytest.raises(ValueError, match=rf"^{parameter}: expected times of the segment that shows .*another segment"):
        change(edit(soft_segments())).video()


@pytest.mark.parametrize("evenly", [True, False])
def test_functions_and_cameras_are_given_the_clips_time(evenly):
    video, told, asked = soft_segments(evenly=evenly), [], []

    def note(anything, t):
        told.append(t)
        return anything

    def camera(t):
        asked.append(t)
        return Camera.front(0.625)

    edited = edit(video).apply(note).seen_from(camera).video()
    times = video.frame_times.times()
    for k in (0, 3, 5, 9, 11, 15):
        told.clear()
        asked.clear()
        edited.render(times[k])
        num = len(video.weights(k))
        np.testing.assert_allclose(told, [times[k]] * num, atol=1e-4 if evenly else 1e-6)
        np.testing.assert_allclose(asked, [times[k]] * num, atol=1e-4 if evenly else 1e-6)
    in_first = np.concatenate([OBJECT, np.zeros(2 * NUM, bool)])
    other = edit(video).select(in_first).seen_from(Camera.front(0.625).orbit(0.4, 0)).video()
    assert all(segment.model.camera is not None for segment in other.segments)


# ------------------------------------------------------------------------------------------------ the chain


def test_edits_act_in_their_order_and_a_selection_goes_along():
    """As on each model alone."""
    video = soft_segments()
    parts = [np.arange(NUM) % (k + 2) == 0 for k in range(3)]
    whole = Selection(np.concatenate(parts))
    chain = lambda e, one: (  # noqa: E731
        e.select(one).multiply([(0.2, 0)]).to_front().select(one).rotate(0.3, about=(0, 0)).select().opacity(0.6)
    )
    edited = chain(edit(video), whole).video()
    for segment, part in zip(edited.segments, parts, strict=True):
        model = next(own.model for own in video.segments if own.first == segment.first)
        wanted = chain(edit(model), part).video()
        assert_same(segment.model, wanted)
        assert (segment.num_gaussians, segment.num_parameters) == (wanted.num_gaussians, wanted.num_parameters)
    copied = edit(video).select(whole).multiply([(0.2, 0)])
    assert len(copied.selection) == len(whole)
    assert len(copied.select(whole).selection) == 2 * len(whole)
    assert copied.selection.num_gaussians == video.num_gaussians + len(whole)
    assert copied.select(lambda video: copied.selection).selection == copied.selection
    again = edit(edited).select(color=(0.5, 0.5, 0.5), tolerance=30).vanish().video()
    assert again.num_gaussians < edited.num_gaussians
    assert len(edit(video).vanish().select().selection) == video.num_gaussians


def test_layers_of_segments_are_edited():
    """Of each segment's layers one is selected; what is found in one layer is carried in that layer."""
    models = [layers(*(span_of_scene(first, 10 * k + n)[0] for n in range(2))) for k, first in enumerate((0, 9))]
    video = SegmentedVideo.from_models([(0, models[0]), (9, models[1])])
    found = edit(video).select(box=disc_box(2), frame=2, layer=1).selection
    for part, model in zip(by_segment(video, found), models, strict=True):
        front = model.layers[0].num_gaussians
        assert not part.mask[:front].any()
        assert part.mask[front:].any()
    assert by_segment(video, found)[0] == edit(models[0]).select(box=disc_box(2), frame=2, layer=1).selection
    some = np.arange(sum(model.layers[1].num_gaussians for model in models)) % 3 == 0
    assert len(edit(video).select(some, layer=1).selection) == some.sum()
    with pytest.raises(ValueError, match="layer: expected a whole number in"):
        edit(video).select(layer=2).video()


@pytest.fixture
def quick_collection():
    """All that is there already is left out of it."""
    gc.collect()
    gc.freeze()
    yield
    gc.unfreeze()


@pytest.mark.usefixtures("quick_collection")
def test_models_are_loaded_one_after_another_and_let_go():
    alive, most = [], 0

    def loading(model):
        def load():
            nonlocal most
            gc.collect()
            most = max(most, sum(one() is not None for one in alive))
            copied = dataclasses.replace(model)
            alive.append(weakref.ref(copied))
            return copied

        return load

    spans = [(k * 2, soft_model(seed=k, num_frames=4)) for k in range(9)]
    segments = [dataclasses.replace(Segment.from_model(first, model), load=loading(model)) for first, model in spans]
    video = SegmentedVideo(segments)
    chain = edit(video).select(color=(0.5, 0.5, 0.5), tolerance=40).move((0.1, 0), frames=(0, 19))
    list(chain.video().frames())
    assert len(alive) > 9
    before = len(alive)
    assert len(edit(video).select(box=(0, 0, 64, 40), frame=0, follow=False, times=(0.0, 0.5)).selection) > 0
    assert len(edit(video).select(frames=(0, 2)).selection) > 0
    assert len(alive) == before + 3  # once for each question: those that cannot answer are not loaded
    assert most <= 2 * MAX_PREPARED + 1  # those that are drawn, and those before them


# ------------------------------------------------------------------------------------------------ mistakes


ALL, SOME = np.tile(OBJECT, 3), np.tile(np.arange(NUM) < 3, 3)


@pytest.mark.parametrize(
    ("change", "match"),
    [
        (lambda e: e.select(np.ones(NUM, bool)), "selection: expected a Selection or mask of 120 Gaussians"),
        (lambda e: e.select(Selection(OBJECT)), "selection: expected a Selection or mask of 120 Gaussians"),
        (lambda e: e.select(lambda video: 3), "selection: expected a Selection or mask of 120 Gaussians"),
        (lambda e: e.select(box=(0, 0, 9, 9), frame=16), r"frame: expected a whole number in \[0, 15\], got 16"),
        (lambda e: e.select(box=(0, 0, 9, 9), frames=(3, 17)), "frames: expected .first, stop. with .* <= 16"),
        (lambda e: e.select(box=(70, 0, 90, 9), frame=6), "box: expected pixels of a 40x64 frame"),
        (lambda e: e.select(mask=np.zeros((40, 64), bool), frame=6), "mask: expected a mask that is not empty"),
        (lambda e: e.select(click=(3, 3)), "frame: expected the frame that was clicked in"),
        (lambda e: e.select(times=(0.5, 2)), "times: expected .start, stop."),
        (lambda e: e.select(frame=3, color=(2, 0, 0)), "color: expected red, green and blue"),
        (lambda e: e.select(tolerance=3, frame=1), "tolerance: expected one of color, click"),
        (lambda e: e.select(np.tile(OBJECT, 3), frame=1), "a selection or criteria"),
        (lambda e: e.select(layer=-1).video(), "layer: expected a whole number in"),
        (lambda e: e.move((1, 2, 3)), "offset: expected 2 finite numbers"),
        (lambda e: e.move((0.1, 0), frames=(3, 17)), "frames: expected .*stop <= 16"),
        (lambda e: e.recolor((2, 0, 0)), "color: expected red, green and blue"),
        (lambda e: e.recolor((1, 0, 0), hue=0.3), "expected color, hue, or gain"),
        (lambda e: e.freeze(16), r"at: expected a frame in \[0, 15\], got 16"),
        (lambda e: e.select(color=(1, 0, 1), tolerance=0).move((0.1, 0)), "selection: expected at least one Gaussian"),
        (lambda e: e.select(color=(1, 0, 1), tolerance=0).recolor((1, 0, 0)), "selection: expected at least one"),
        (lambda e: e.vanish().move((0.1, 0)), "selection: expected at least one Gaussian"),
        (lambda e: e.opacity(0).recolor((1, 0, 0)), "selection: expected at least one Gaussian"),
        (lambda e: e.recolor(gain=0).recolor((1, 0, 0)), "color: expected an object that is not black"),
        (lambda e: e.seen_from("left"), "camera: expected a Camera"),
        (lambda e: e.frames(), "End the chain with"),
        (lambda e: e.select(colour=(1, 0, 0)), "colour"),
        # What only the models tell is told by `video`.
        (
            lambda e: e.select(ALL).vanish().select(ALL).move((0.1, 0)).video(),
            "selection: expected at least one Gaussian",
        ),
        (
            lambda e: e.select(ALL).rotate(0.3).select(SOME).freeze(7, frames=(7, 9)).video(),
            "Retime it before that edit",
        ),
    ],
)
def test_mistakes_are_told(change, match):
    with pytest.raises((ValueError, AttributeError, TypeError), match=match):
        change(edit(soft_segments()))


def test_a_warning_names_the_call():
    with pytest.warns(UserWarning, match="expected radians, got 45") as told:
        edit(soft_segments()).rotate(45).video()
    assert len(told) == 1
    assert told[0].filename == __file__
    assert isinstance(edit(soft_segments()), SegmentedEdit)
