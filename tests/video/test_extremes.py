"""Extreme clips (one frame, one pixel, black, very long): fit, files and scores without NaN or dark frames."""

import math
import time

import jax
import numpy as np
import pytest
from clips import moving_blobs

from foldgauss.io import load_video_model, save_compact, save_video_model
from foldgauss.io.models.compact import pack_compact
from foldgauss.uncertainty import likelihood_profiles
from foldgauss.video import (
    FitConfig,
    FrameTimes,
    by_time,
    compress,
    edit,
    evaluate,
    fit,
    interpolated_times,
    layers,
    played_positions,
    psnr,
    ssim,
    times_at,
)
from foldgauss.video.fitting.config import chosen_num_gaussians
from foldgauss.video.fitting.loop import fit_steps, start, to_model
from foldgauss.video.models.frame_times import is_cut, make_time_logits, snap_to_shots
from foldgauss.video.motion.optical_flow import Motion

SIZE = (24, 32)


def constant(level, num_frames=3, size=SIZE, channels=3):
    return np.full((num_frames, *size, channels), level, np.uint8)


def one_bright_pixel():
    frames = constant(0)
    frames[:, 10, 13] = 255
    return frames


def pictures_of(num, size=SIZE):
    """Pictures that have nothing in common: plain, but of a color and with a disc each."""
    rng, (y, x) = np.random.default_rng(4), np.mgrid[: size[0], : size[1]]
    made = []
    for _ in range(num):
        where = rng.uniform(0.2, 0.8, 2) * size
        inside = np.hypot(y - where[0], x - where[1]) < 0.3 * min(size)
        ground, disc = rng.integers(0, 256, (2, 3))
        made.append(np.where(inside[..., None], disc, ground))
    return np.array(made, np.uint8)


def alternating(pattern, of):
    return np.stack([of["AB".index(name)] for name in pattern])


def with_alpha(frames):
    """Its left half; the right one is clear."""
    alpha = np.zeros((*frames.shape[:3], 1), np.uint8)
    alpha[:, :, : max(frames.shape[2] // 2, 1)] = 255
    return np.concatenate([frames * (alpha > 0), alpha], -1)


BLACK_AND_WHITE = np.concatenate([constant(0, 1), constant(255, 1)])
#: Frames, and the mean PSNR in dB that a short fit must reach.
CLIPS = {
    "one frame": (moving_blobs(1, *SIZE), 32),
    "one frame with alpha": (with_alpha(moving_blobs(1, *SIZE)), 26),
    "two frames": (moving_blobs(2, *SIZE), 30),
    "two unlike frames": (pictures_of(2), 22),
    "all black": (constant(0), 100),
    "all white": (constant(255), 48),
    "one black frame": (constant(0, 1), 100),
    "all clear": (constant(0, channels=4), 60),
    "one bright pixel": (one_bright_pixel(), 48),
    "black and white": (alternating("ABABAB", BLACK_AND_WHITE), 15),
    "two pictures in turn": (alternating("ABABAB", pictures_of(2)), 20),
    "8x8": (moving_blobs(3, 8, 8), 30),
    "1x1": (moving_blobs(3, 1, 1), 40),
    "1x4096": (moving_blobs(2, 1, 4096), 22),
    "4096x1": (moving_blobs(2, 4096, 1), 22),
    "1x4096 with alpha": (with_alpha(moving_blobs(2, 1, 4096)), 18),
}
USUAL, PRESET = FitConfig(num_gaussians=300, steps=60), {"num_gaussians": 200, "max_gaussians": 300, "steps": 60}
SETTINGS = {
    "standard": USUAL,
    "sum": USUAL.replace(compositing="sum"),
    "degree 0": USUAL.replace(degree=0),
    "degree 7": USUAL.replace(degree=7),
    "two cameras, batches": USUAL.replace(steps=30, **{"views.two_cameras": True, "views.batch_size": 3}),
    "between, psnr": USUAL.replace(steps=30, psnr=99.0, **{"views.interpolation_fraction": 0.5}),
    "at rest": USUAL.replace(initialization="static"),
    "draft": FitConfig.preset("draft", **PRESET),
    "paper": FitConfig.preset("paper", **PRESET),
}


def check_whole(model, history, frames):
    """Finite, and the same from its file, at its frames and between them; returns the scores."""
    assert all(np.isfinite(leaf).all() for leaf in map(np.asarray, jax.tree.leaves(model)))
    assert all(math.isfinite(info.loss) and math.isfinite(info.psnr) for info in history)
    scores = evaluate(model, frames)
    assert np.isfinite(scores.psnr).all()
    assert np.isfinite(scores.ssim).all()
    times = np.asarray(model.frame_times.times())
    for picture in model.frames(interpolated_times(times, 2), (9, 7)):
        assert picture.shape == (9, 7, 3)
    return scores


#: Each of these has a neighbor that is farther at the extreme; the long runs take them.
SLOW = ("two frames", "all white", "one black frame", "two pictures in turn", "8x8", "1x4096", "4096x1")
SLOW += ("one frame with alpha", "two unlike frames", "all black", "one bright pixel")


@pytest.mark.parametrize("name", [pytest.param(k, marks=pytest.mark.slow if k in SLOW else []) for k in CLIPS])
def test_a_short_fit_and_its_file(tmp_path, name):
    frames, least = CLIPS[name]
    result = fit(frames, FitConfig(num_gaussians=400, steps=120))
    scores = check_whole(result.model, result.history, frames)
    assert scores.mean_psnr >= least
    kept = load_video_model(save_video_model(tmp_path / "m.safetensors", result.model))
    assert (kept.num_frames, kept.size) == (len(frames), frames.shape[1:3])
    assert evaluate(kept, frames) == scores


#: Each setting at two extremes or more, each extreme with three settings or more; quickly, each setting at the first.
AT = {
    "between, psnr": ("8x8", "one frame", "all white", "black and white", "1x4096"),
    "two cameras, batches": ("one frame", "all white", "8x8"),
    "standard": ("all white", "1x4096"),
    "sum": ("black and white", "one frame"),
    "degree 0": ("1x4096", "all white"),
    "degree 7": ("one frame", "black and white"),
    "at rest": ("8x8", "one frame"),
    "draft": ("all black", "one frame", "black and white", "1x4096"),
    "paper": ("one frame", "all black", "black and white", "1x4096"),
}


@pytest.mark.parametrize(
    ("name", "setting"),
    [
        pytest.param(name, how, marks=[] if name == names[0] else pytest.mark.slow)
        for how, names in AT.items()
        for name in names
    ],
)
def test_every_setting_at_the_extremes(name, setting):
    frames, least = CLIPS[name]
    result = fit(frames, SETTINGS[setting])
    scores = check_whole(result.model, result.history, frames)
    assert scores.mean_psnr > 0.4 * least or setting in ("draft", "paper")  # these are far from their end


# ------------------------------------------------------------------------------------------ one frame alone


@pytest.fixture(scope="module")
def still():
    frames = moving_blobs(1, *SIZE)
    return frames, fit(frames, FitConfig(num_gaussians=200, steps=120)).model


def test_one_frame_has_one_time():
    times = FrameTimes.uniform(1).times()
    np.testing.assert_array_equal(times, [0])
    assert times.dtype == np.float32
    assert make_time_logits(1, []).shape == is_cut(times).shape == (0,)
    np.testing.assert_array_equal(interpolated_times(np.asarray(times), 5), [0])
    np.testing.assert_array_equal(times_at(np.asarray(times), np.array([[0.0, 0.7], [-1.0, 3.0]])), np.zeros((2, 2)))
    np.testing.assert_array_equal(played_positions(1, 2.4, speed=-0.5), [0])
    np.testing.assert_array_equal(snap_to_shots(np.array([0.0, 0.3, 1.0], np.float32), times), [0, 0, 0])


def test_one_frame_is_shown_at_all_times(still):
    frames, model = still
    shown = np.stack(list(model.frames(np.array([0.0, 0.5, 1.0]))))
    np.testing.assert_array_equal(shown[1:], shown[:1].repeat(2, 0))
    np.testing.assert_array_equal(np.asarray(model.render(1.0)), np.asarray(model.render(0.0)))
    assert by_time(model, frame=0).mask.all()
    with pytest.raises(ValueError, match="at least 3 frames"):
        likelihood_profiles(model, frames)
    moved = edit(model).move((0.1, 0)).video()
    later = edit(moved).retime(shift=0.5).video()
    for video in (moved, later, layers(model, moved)):
        first, last = video.frames(np.array([0.0, 1.0]))
        np.testing.assert_array_equal(first, last)
        assert psnr(first, shown[0]) < 60


def test_one_frame_can_be_a_background_layer(still):
    """A picture as the background of a video, at all of its times."""
    frames, picture = still
    clip = fit(constant(0, 4), FitConfig(num_gaussians=20, steps=2)).model
    gone = edit(clip).vanish().video()
    for shown in layers(gone, picture, timeline=0).frames():
        assert psnr(frames[0], shown) > 32


@pytest.mark.parametrize("how", [{"quality": 100}, {"psnr": 40, "steps": 60}], ids=["alone", "clip"])
def test_one_frame_in_a_compact_file(tmp_path, still, how):
    frames, model = still
    made = compress(model, frames if "steps" in how else None, **how)
    loaded = load_video_model(save_compact(tmp_path / "m.fgz", made.quantized))
    assert loaded.num_frames == 1
    assert evaluate(loaded, frames).mean_psnr >= how.get("psnr", 30)


# -------------------------------------------------------------------------------------------- alternating


@pytest.mark.slow
def test_slide_show_has_no_gaps():
    """Most intervals are cuts: gaps there would be the usual interval, and what is shown within them nothing."""
    frames = alternating("AABAABAAB", np.maximum(pictures_of(2), 100))
    assert len(Motion.from_frames(frames).cuts) == 5
    model = fit(frames, FitConfig(num_gaussians=600, steps=150)).model
    shown = np.stack(list(model.frames(interpolated_times(np.asarray(model.frame_times.times()), 4))))
    assert shown.mean((1, 2, 3)).min() > 0.5 * frames.mean((1, 2, 3)).min()


@pytest.mark.parametrize(
    ("num_frames", "cuts"), [(2, [1]), (3, [2]), (9, [1, 3, 5, 7]), (9, [2, 3, 5, 6, 8]), (6, [1, 2, 3]), (9, [3])]
)
def test_gaps_exist_only_where_they_are_detected_as_cuts(num_frames, cuts):
    logits = make_time_logits(num_frames, cuts)
    found = np.flatnonzero(is_cut(FrameTimes(logits).times())) + 1
    assert found.tolist() == (cuts if logits.any() else [])
    assert logits.any() == (2 * len(cuts) < num_frames - 1)


# -------------------------------------------------------------------------------------------------- long


@pytest.mark.parametrize("num", [200, *(pytest.param(num, marks=pytest.mark.slow) for num in (400, 1000, 5000))])
def test_thousands_of_frames_and_few_steps(num):
    """No frame is left dark, though most of them were never looked at; nor does it take long to begin."""
    frames = moving_blobs(50, 8, 8)[np.abs(np.arange(num) % 98 - 49)]
    config, begun = FitConfig(steps=num // 25, num_gaussians=num), time.process_time()
    *_, (state, info) = fit_steps(frames, config)
    assert time.process_time() - begun < 0.012 * num
    shown = np.stack(list(to_model(state, config, frames.shape[1:3], 25.0).frames()))
    assert (shown.mean((1, 2, 3)) > 0.25 * frames.mean((1, 2, 3))).all()
    assert math.isfinite(info.psnr)


def test_long_clips_get_as_many_gaussians_a_frame_as_shorter_ones():
    number = {n: chosen_num_gaussians(FitConfig(), n, 160, 320) for n in (250, 500, 5000)}
    assert number[500] == pytest.approx(2 * number[250], rel=1e-4)
    assert number[5000] == pytest.approx(20 * number[250], rel=1e-4)
    assert chosen_num_gaussians(FitConfig(max_gaussians=9000), 5000, 160, 320) == 9000


def test_every_stretch_of_a_long_clip_has_starts():
    """By chance alone, with one start in ten frames, one stretch of 60 in four hundred has none."""
    frames = moving_blobs(10, 16, 16)[np.arange(2000) % 10]
    config = FitConfig(num_gaussians=200, steps=1, initialization="static")
    model = to_model(start(frames, config), config, (16, 16), 25.0)
    own = np.sort(1 / (1 + np.exp(-model.splats.time_loc_logit)))
    assert np.diff(own, prepend=0, append=1).max() < 25 / 2000


# --------------------------------------------------------------------------------------------- judgement


@pytest.mark.parametrize("size", [(1, 1), (1, 40), (40, 1), (8, 8), (10, 30)])
def test_ssim_of_small_pictures(size):
    rng = np.random.default_rng(1)
    one, other = rng.integers(0, 256, (2, *size, 3)).astype(np.uint8)
    assert ssim(one, one) == pytest.approx(1)
    assert ssim(one, other) < 0.8
    assert ssim(one, other) == pytest.approx(ssim(other, one))
    assert ssim(one.swapaxes(0, 1), other.swapaxes(0, 1)) == pytest.approx(ssim(one, other))


@pytest.mark.slow
@pytest.mark.parametrize(("degree", "steps"), [(3, 200), (None, 600)])  # degree 1, the default, needs more steps here
def test_exact_frames_cost_the_others_no_bits(degree, steps):
    """Half of the frames are black: the others are about as good as alone, in files that are hardly larger."""
    blobs, scores = moving_blobs(3, *SIZE), []
    frames = np.concatenate([blobs, constant(0, 3)])
    for seed in range(3):  # with few Gaussians a frame may be worse by chance
        how = {"num_gaussians": 500, "quality": 80, "seed": seed, "degree": degree}
        both = fit(frames, FitConfig().replace(steps=2 * steps, **how))
        alone = fit(blobs, FitConfig().replace(steps=steps, **how))  # each frame is shown as often
        found = evaluate(both.model, frames).psnr
        assert min(found[3:]) > 40
        scores.append(np.mean(found[:3]) - evaluate(alone.model, blobs).mean_psnr)
        assert len(pack_compact(both.quantized)) < 2 * len(pack_compact(alone.quantized))
    assert np.mean(scores) > -2


@pytest.mark.parametrize(
    ("frames", "words"),
    [
        (constant(7).astype(np.uint16), "uint16.*np.rint"),
        (constant(1).astype(np.float32), "float32.*255"),
        (constant(1)[0], r"frames\[None\]"),
        (list(constant(1)), "list.*np.stack"),
        (constant(1)[:0], r"\(0, 24, 32, 3\)"),
        (constant(1)[:, :, :0], r"\(3, 24, 0, 3\)"),
        (constant(1, channels=2), r"\(3, 24, 32, 2\)"),
        (constant(1, channels=5), r"\(3, 24, 32, 5\)"),
    ],
    ids=["16 bits", "floats", "one picture", "a list", "no frames", "no pixels", "2 channels", "5 channels"],
)
def test_invalid_frames_are_rejected_with_a_cure(frames, words):
    with pytest.raises(ValueError, match=f"frames: expected a uint8 array.*{words}"):
        fit(frames, FitConfig(steps=1))
