"""Models of a clip's segments as one video: which is seen where, and that no seam is."""

import dataclasses
import gc
import weakref
from functools import partial
from itertools import pairwise

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from soft_models import NUM, SIZE, learned, soft_model, soft_segments

from foldgauss.render import RenderOptions
from foldgauss.uncertainty.likelihood.residuals import Residuals
from foldgauss.video import (
    FrameTimes,
    Segment,
    SegmentedVideo,
    Selection,
    by_color,
    compress,
    edit,
    evaluate,
    plan_segments,
    times_at,
)
from foldgauss.video.models.frame_times import is_cut, make_time_logits
from foldgauss.video.models.renderer import VideoRenderer
from foldgauss.video.segmented.layering import flatten_video
from foldgauss.video.segmented.segmented_video import MAX_PREPARED
from foldgauss.video.tradeoff import measure_frame_rate

#: Spans 0:7, 4:13 (three frames shared), 13:18 (a cut), 17:23 (one shared).
FIRSTS, LENGTHS = (0, 4, 13, 17), (7, 9, 5, 6)
NUM_FRAMES = 23


def video():
    return soft_segments(FIRSTS, LENGTHS)


def models():
    return [segment.model for segment in video().segments]


def image(one, t):
    return np.array(VideoRenderer(one).image(t))


def at(clip, position):
    """The picture at a frame position."""
    return image(clip, position / (clip.num_frames - 1))


# ------------------------------------------------------------------------------------------ what is seen


@pytest.mark.parametrize("kind", ["learned", "cut", "edited", "alone"])
def test_one_segment_is_the_model_to_the_bit(kind):
    model = learned(soft_model())
    if kind == "cut":
        model = dataclasses.replace(model, frame_times=FrameTimes(make_time_logits(7, [3])))
    elif kind == "edited":
        model = edit(model).select(np.arange(NUM) < 12).move((0.1, 0.0), times=(0.2, 0.7)).video()
    elif kind == "alone":
        model = soft_model(num_frames=1)
    clip = SegmentedVideo.from_models([(0, model)])
    assert (clip.size, clip.fps, clip.num_frames) == (model.size, model.fps, model.num_frames)
    assert (clip.num_gaussians, clip.degree, clip.num_parameters) == (
        model.num_gaussians,
        model.degree,
        model.num_parameters,
    )
    np.testing.assert_array_equal(list(clip.frames()), list(model.frames()))
    green = {"size": (30, 48), "background": (0.0, 0.5, 0.0)}
    np.testing.assert_array_equal(list(clip.frames(**green)), list(model.frames(**green)))
    own = np.asarray(model.frame_times.times())
    for position in np.arange(0, model.num_frames - 1 + 1e-9, 0.375):
        t = position / max(model.num_frames - 1, 1)
        np.testing.assert_array_equal(image(clip, t), image(model, times_at(own, position)))


def test_every_frame_is_that_of_its_segment():
    clip, parts, shared = video(), models(), 0
    pictures = [list(model.frames()) for model in parts]
    times = clip.frame_times.times()
    assert times.dtype == np.float64
    for k, picture in enumerate(clip.frames()):
        here = [n for n, first in enumerate(FIRSTS) if first <= k < first + LENGTHS[n]]
        assert clip.position(times[k]) == k
        if len(here) == 1:
            np.testing.assert_array_equal(picture, pictures[here[0]][k - FIRSTS[here[0]]])
        else:
            shared += 1
            one, other = (np.float32(image(parts[n], parts[n].frame_times.times()[k - FIRSTS[n]])) for n in here)
            (_, first), (_, second) = clip.weights(k)
            expected = np.float32(first) * one + np.float32(second) * other
            np.testing.assert_array_equal(at(clip, k), expected)
            assert first + second == pytest.approx(1)
    assert shared == 4


def test_between_frames_it_goes_by_the_segments_own_times():
    clip, model = video(), models()[1]
    own = np.asarray(model.frame_times.times())
    between = image(model, own[5] + 0.25 * (own[6] - own[5]))
    np.testing.assert_allclose(at(clip, 4 + 5.25), between, atol=2e-5)
    assert np.abs(between - image(model, (5.25) / 8)).max() > 1e-3  # evenly spaced times are others


def test_a_cut_within_a_segment_is_kept():
    model = dataclasses.replace(soft_model(), frame_times=FrameTimes(make_time_logits(7, [3])))
    clip = SegmentedVideo.from_models([(0, soft_model(num_frames=5)), (5, model)])
    for position, frame in ((7.4, 2), (7.6, 3)):
        np.testing.assert_array_equal(at(clip, position), image(model, model.frame_times.times()[frame]))
    assert clip.cuts == [5]


def test_at_a_cut_between_segments_is_the_nearer_frame():
    clip = video()
    np.testing.assert_array_equal(at(clip, 12.49), at(clip, 12))
    np.testing.assert_array_equal(at(clip, 12.5), at(clip, 13))
    assert np.abs(at(clip, 12) - at(clip, 13)).max() > 0.1


def test_weights_rise_linearly_and_sum_to_one():
    clip = video()
    for position, expected in ((3, [(0, 1)]), (3.5, [(0, 0.875), (1, 0.125)]), (4, [(0, 0.75), (1, 0.25)])):
        assert clip.weights(position) == expected
    assert clip.weights(6.5) == [(0, 0.125), (1, 0.875)]
    assert clip.weights(7) == [(1, 1)]
    assert clip.weights(17) == [(2, 0.5), (3, 0.5)]
    for position in np.arange(0, 22.001, 0.01):
        seen = clip.weights(min(position, 22))
        assert sum(weight for _, weight in seen) == pytest.approx(1, abs=1e-12)
        assert [n for n, _ in seen] == sorted({n for n, _ in seen})
    for outside in (-0.01, 22.01):
        with pytest.raises(ValueError, match=r"^position: expected a frame position in \[0, 22\]"):
            clip.weights(outside)


def test_fades_are_continuous():
    """From one position to the next, no picture changes by more than the models do and their share does."""
    step, clip, parts = 1 / 16, video(), models()[:2]
    positions = np.arange(2, 8.001, step)
    alone = [[_held(parts[n], position - FIRSTS[n]) for position in positions] for n in (0, 1)]
    apart = max(np.abs(a - b).max() for a, b in zip(*alone, strict=True))
    inside = max(_largest_jump(pictures) for pictures in alone)
    jump = _largest_jump([at(clip, position) for position in positions])
    assert jump <= inside + step / 4 * apart + 1e-4
    assert jump < 0.2 * apart


def _held(model, position):
    """Its picture, before its first frame the first one, after its last one the last."""
    return image(model, times_at(np.asarray(model.frame_times.times()), position))


def _largest_jump(pictures):
    return max(np.abs(b - a).max() for a, b in pairwise(pictures))


def test_three_are_seen_where_one_fade_meets_the_next():
    parts = [soft_model(seed=k, num_frames=num) for k, num in enumerate((5, 6, 5))]
    loaded = []

    def load(number):
        loaded.append(number)
        return parts[number]

    segments = SegmentedVideo.from_models(list(zip((0, 3, 5), parts, strict=True))).segments
    clip = SegmentedVideo([dataclasses.replace(s, load=partial(load, n)) for n, s in enumerate(segments)])
    seen = clip.weights(4.5)
    assert [n for n, _ in seen] == [0, 1, 2]
    assert sum(weight for _, weight in seen) == pytest.approx(1)
    around = [at(clip, position) for position in (4.4999, 4.5, 4.5001)]
    assert max(np.abs(a - around[1]).max() for a in around) < 1e-3
    loaded.clear()
    assert len(list(VideoRenderer(clip).frames(np.linspace(0, 1, 57)))) == 57
    assert loaded == [0, 1, 2]


def test_what_is_given_for_one_time():
    clip, parts = video(), models()
    for position, number in ((4, 0), (6, 1), (20, 3)):
        t = position / 22
        own = parts[number]
        expected = own.prepare(SIZE).splats(own.frame_times.times()[position - FIRSTS[number]])
        for found in (clip.at(t), VideoRenderer(clip).splats(t)):
            np.testing.assert_array_equal(found.mean, expected.mean)
            np.testing.assert_array_equal(found.opacity, expected.opacity)
    np.testing.assert_array_equal(clip.render(0.3), np.moveaxis(image(clip, 0.3), 0, -1))
    for wrong in (-0.1, 1.5, "soon"):
        with pytest.raises(ValueError, match=r"^time: expected a time in \[0, 1\]"):
            clip.render(wrong)


def test_other_constants_go_to_all_segments():
    options = RenderOptions(alpha_cutoff=0.2, support_radius=1.0)
    clip, parts = video().with_options(options), [model.with_options(options) for model in models()]
    expected = SegmentedVideo.from_models(list(zip(FIRSTS, parts, strict=True)))
    assert clip.options == options
    np.testing.assert_array_equal(list(clip.frames()), list(expected.frames()))
    assert np.abs(at(clip, 3) - at(video(), 3)).max() > 0.01
    assert [segment.model.options for segment in clip.segments] == [options] * 4
    assert video().with_options(video().options).num_frames == NUM_FRAMES


# -------------------------------------------------------------------------------------------- long clips


def long_clip(num_frames=10**7, length=1000):
    """Of segments that are never loaded."""
    lead = Segment.from_model(0, soft_model())
    spans = plan_segments(num_frames, [], length=length, overlap=10)
    return SegmentedVideo(
        [dataclasses.replace(lead, first=a, num_frames=b - a, load=lambda: pytest.fail("loaded")) for a, b in spans]
    )


def test_positions_are_exact_in_a_clip_of_ten_million_frames():
    clip = long_clip()
    assert clip.num_frames == 10**7
    chosen = np.random.default_rng(0).integers(0, 10**7, 500)
    for k in [0, 1, 10**7 - 1, *chosen.tolist()]:
        position = clip.position(k / (clip.num_frames - 1))
        assert position == k
        half = clip.position(min(k + 0.25, 10**7 - 1) / (clip.num_frames - 1))
        assert half == pytest.approx(min(k + 0.25, 10**7 - 1), abs=1e-6)
        (number, weight), *_ = clip.weights(position)
        segment = clip.segments[number]
        assert 0 < weight <= 1
        assert segment.first - 1 < k <= segment.stop


def test_cuts_are_told_from_float64_times():
    """In float32 all of these are one."""
    times = 0.5 + 1e-9 * np.array([0, 1, 2, 3, 23, 24])
    assert list(is_cut(times)) == [False, False, False, True, False]
    np.testing.assert_array_equal(is_cut(jnp.float32([0, 1, 2, 3, 23, 24])), is_cut(times))


def test_even_times_of_a_long_clip_have_no_cuts():
    times = long_clip(300_000).frame_times.times()
    positions = np.array([0.5, 123456.25, 299_998.75])
    np.testing.assert_allclose(times_at(times, positions) * (len(times) - 1), positions, atol=1e-6)


# ------------------------------------------------------------------------------------------------ loading


def counted():
    """The video, the numbers of the segments as they are loaded, and the models that are still there."""
    loaded, alive = [], []

    def load(number):
        model = learned(soft_model(seed=number, num_frames=LENGTHS[number]), number)
        loaded.append(number)
        alive.append(weakref.ref(model.splats))
        return model

    segments = [
        dataclasses.replace(segment, load=lambda number=number: load(number))
        for number, segment in enumerate(video().segments)
    ]
    return SegmentedVideo(segments), loaded, lambda: gc.collect() and sum(one() is not None for one in alive)


@pytest.mark.parametrize("way", [1, -1])
def test_played_through_each_segment_is_loaded_once(way):
    clip, loaded, alive = counted()
    assert loaded == []
    playback = VideoRenderer(clip)
    for _ in playback.frames(np.linspace(0, 1, 67)[::way]):
        assert len(playback._prepared._kept) <= MAX_PREPARED
    assert loaded == [0, 1, 2, 3][::way]
    assert not alive()  # a stage needs no model


def test_speed_is_measured_of_some_segments():
    clip, loaded, _ = counted()
    assert measure_frame_rate(clip) > 0
    assert sorted(set(loaded)) == [0, 2, 3]


# --------------------------------------------------------------------------------------------- evaluation


class Frames:
    """Frames that are read when they are asked for."""

    ndim, dtype = 4, np.dtype(np.uint8)

    def __init__(self, frames):
        self._frames, self.shape, self.asked = frames, frames.shape, []

    def __getitem__(self, k):
        self.asked.append(k)
        return self._frames[k]


def test_scores_of_lazy_frames_are_those_of_an_array():
    clip = video()
    frames = np.stack(list(clip.frames()))
    noisy = np.clip(frames + np.random.default_rng(0).integers(-9, 10, frames.shape), 0, 255).astype(np.uint8)
    lazy = Frames(noisy)
    assert evaluate(clip, lazy) == evaluate(clip, noisy)
    assert lazy.asked == list(range(NUM_FRAMES))
    with_alpha = np.concatenate([noisy, np.full_like(noisy[..., :1], 255)], -1)
    assert evaluate(clip, Frames(with_alpha)).psnr == evaluate(clip, noisy).psnr
    with pytest.raises(ValueError, match=r"^frames: expected uint8 \(23, 40, 64, 3\)"):
        evaluate(clip, Frames(noisy[1:]))


# ------------------------------------------------------------------------------------------------ refusals


def spans(*pairs):
    lead = Segment.from_model(0, soft_model())
    return [dataclasses.replace(lead, first=a, num_frames=b - a) for a, b in pairs]


@pytest.mark.parametrize(
    ("pairs", "message"),
    [
        ([], "^segments: expected at least one"),
        ([(1, 9)], r"^segments\[0\]\.first: expected one that begins at frame 0 to 0 .*, got 1, and 8 frames"),
        (
            [(0, 9), (10, 20)],
            r"^segments\[1\]\.first: expected one that begins at frame 1 to 9 .*got 10, and 10 .*no gap",
        ),
        ([(0, 9), (9, 18), (0, 20)], r"^segments\[2\]\.first: expected one that begins at frame 10 to 18 "),
        ([(0, 9), (0, 12)], "one that begins at frame 1 to 9 "),
        ([(0, 9), (2, 9)], "and ends after 9, got 2, and 7 frames"),
        ([(0, 9), (3, 12), (8, 20)], r"begins at frame 9 to 12 .*at most two share a frame"),
        ([(-1, 9)], r"got -1, and 10 frames"),
    ],
)
def test_segments_that_do_not_cover_a_clip_are_refused(pairs, message):
    with pytest.raises(ValueError, match=message):
        SegmentedVideo(spans(*pairs))


LEAD = soft_model()


def beside(**changes):
    return SegmentedVideo.from_models([(0, LEAD), (5, dataclasses.replace(LEAD, **changes))])


@pytest.mark.parametrize(
    ("make", "message"),
    [
        *(
            (partial(beside, **{name: value}), rf"^segments\[1\]\.{name}: expected .*first segment.*fit them alike")
            for name, value in {"size": (40, 80), "fps": 24.0, "compositing": "sum", "options": RenderOptions()}.items()
        ),
        (lambda: SegmentedVideo.from_models([(0, "a")]), "^model: expected a VideoModel or an EditedVideo, got str"),
        (lambda: SegmentedVideo.from_models([(0, edit(LEAD))]), r"got Edit\. End a chain"),
        (lambda: SegmentedVideo([LEAD]), r"^segments\[0\]: expected a Segment"),
    ],
)
def test_segments_that_do_not_go_together_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()


@pytest.mark.parametrize(
    "call",
    [
        compress,
        flatten_video,
        lambda clip: by_color(clip, (1.0, 0.0, 0.0)),
        lambda clip: Selection.all(clip),
        lambda clip: Residuals(clip, np.zeros((NUM_FRAMES, *SIZE, 3), np.uint8)),
    ],
)
def test_what_takes_one_model_says_how_to_get_one(call):
    with pytest.raises(ValueError, match=r"video\.segments\[k\]\.model") as caught:
        call(video())
    assert "\n" not in str(caught.value)


def test_a_model_of_other_frames_is_refused_when_it_comes():
    lead = Segment.from_model(0, soft_model())
    for other in (soft_model(num_frames=8), soft_model(size=(20, 32))):
        clip = SegmentedVideo([dataclasses.replace(lead, load=lambda other=other: other)])
        with pytest.raises(ValueError, match=r"^segment\.load\(\): expected a model of 7 frames of 40x64"):
            clip.render(0.5)


# -------------------------------------------------------------------------------------------------- plans


@st.composite
def clips(draw):
    num = draw(st.integers(1, 300))
    length = draw(st.integers(2, 80))
    cuts = draw(st.lists(st.integers(1, max(num - 1, 1)), max_size=12)) if num > 1 else []
    return num, cuts, length, draw(st.integers(1, length // 2))


@given(clips())
def test_plans_cover_the_clip(asked):
    num, cuts, length, overlap = asked
    plan = plan_segments(num, cuts, length=length, overlap=overlap)
    SegmentedVideo(spans(*plan))  # what it refuses no plan may have
    assert (plan[0][0], plan[-1][1]) == (0, num)
    for (_, stop), (first, _) in pairwise(plan):
        assert stop - first == 0 or 1 <= stop - first <= overlap
        if first == stop:
            assert first in cuts
    for first, stop in plan:
        assert stop - first <= 1.5 * length
        assert len(plan) == 1 or stop - first >= length / 2
        assert stop - first >= min(2, num) or length < 4


@given(clips())
def test_plans_end_at_the_cut_that_is_nearest(asked):
    num, cuts, length, overlap = asked
    plan = plan_segments(num, cuts, length=length, overlap=overlap)
    for (first, stop), (following, _) in pairwise(plan):
        near = [cut for cut in cuts if 0.5 * length <= cut - first <= 1.5 * length and num - cut >= length / 2]
        if near:
            assert following == stop
            assert abs(stop - first - length) == min(abs(cut - first - length) for cut in near)
        else:
            assert following < stop


@pytest.mark.parametrize(
    ("num_frames", "cuts", "length", "overlap", "plan"),
    [
        (250, [90], 100, 5, [(0, 90), (90, 190), (185, 250)]),
        (100, [50], 100, 5, [(0, 100)]),
        (130, [], 100, 10, [(0, 70), (60, 130)]),  # evened out
        (130, [100], 100, 10, [(0, 70), (60, 130)]),  # 30 frames are too few
        (33, [9], 20, 8, [(0, 20), (12, 25), (20, 33)]),  # the last two share less: the last must not reach the first
        (1, [], 2, 1, [(0, 1)]),
    ],
)
def test_plans_of_known_clips(num_frames, cuts, length, overlap, plan):
    assert plan_segments(num_frames, cuts, length=length, overlap=overlap) == plan


@pytest.mark.parametrize(
    ("given_", "name"),
    [
        ({"num_frames": 0}, "num_frames"),
        ({"num_frames": 2.5}, "num_frames"),
        ({"length": 1}, "length"),
        ({"overlap": 0}, "overlap"),
        ({"overlap": 6}, "overlap"),
        ({"cuts": [0]}, "cuts"),
        ({"cuts": [50]}, "cuts"),
        ({"cuts": [1.5]}, "cuts"),
    ],
)
def test_plans_that_make_no_sense_are_refused(given_, name):
    asked = {"num_frames": 50, "cuts": [], "length": 10, "overlap": 2} | given_
    with pytest.raises(ValueError, match=f"^{name}: expected"):
        plan_segments(asked.pop("num_frames"), asked.pop("cuts"), **asked)
