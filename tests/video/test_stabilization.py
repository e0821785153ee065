"""The path of the camera, and videos that a steadier camera shows."""

import itertools

import numpy as np
import pytest
from path_models import SCENE_FRAMES as NUM_FRAMES
from path_models import SCENE_SIZE as SIZE
from path_models import affine, scene

from foldgauss.render import Splats2D
from foldgauss.video import (
    CameraPath,
    FrameTimes,
    SegmentedVideo,
    StabilizedVideo,
    edit,
    estimate_camera_path,
    psnr,
    stabilize,
)
from foldgauss.video.models.frame_times import make_time_logits


def picture(video, k):
    """Frame k in 8 bits."""
    return next(video.frames(np.asarray(video.frame_times.times())[[k]]))


def standing(model):
    """The path of a camera that does not move."""
    num = model.num_frames
    return CameraPath(np.tile(np.eye(3), (num, 1, 1)), np.ones(num), np.asarray(model.frame_times.times()))


def shaken(model, seed=0, pan=0.01):
    """The scene seen by a camera that pans and shakes, and its true path from the first frame."""
    rng = np.random.default_rng(seed)
    maps = np.stack(
        [
            affine(0.02 * rng.normal(), 1 + 0.01 * rng.normal(), [pan * k, 0] + 0.012 * rng.normal(size=2))
            for k in range(model.num_frames)
        ]
    )
    return StabilizedVideo(model, maps, standing(model), "crop"), maps @ np.linalg.inv(maps[0])


CORNERS = np.array([[*corner, 1] for corner in itertools.product([-0.5, 0.5], [-0.3, 0.3])])


def at_corners(maps):
    """Where maps move the corners of the frame, (..., corners, 2) in pixels."""
    return max(SIZE) * np.einsum("...ij,cj->...ci", maps, CORNERS)[..., :2]


# --- the path -----------------------------------------------------------------------------------------------


def test_a_known_path_is_found():
    video, path = shaken(scene())
    seen = []
    found = estimate_camera_path(video, on_frame=lambda: seen.append(1))
    assert found.starts == (0,)
    assert len(seen) == NUM_FRAMES
    assert found.inliers.min() > 0.8
    error = at_corners(found.matrices) - at_corners(path)
    assert np.sqrt((error**2).mean()) < 0.15  # pixels, after 11 steps
    assert np.abs(at_corners(path)).max() > np.abs(at_corners(np.eye(3))).max() + 10  # it does move


def test_shots_are_separate():
    """A cut known by its gap in time; and one without, in a video in segments."""
    gap = FrameTimes(make_time_logits(NUM_FRAMES, [5]))
    assert estimate_camera_path(scene(gap)).shots == [(0, 5), (5, NUM_FRAMES)]
    other = scene(num=1400)
    joined = SegmentedVideo.from_models([(0, scene()), (NUM_FRAMES, other)])
    assert estimate_camera_path(joined).starts == (0, NUM_FRAMES)


@pytest.mark.parametrize("frames", [0.5, 24.0, 1000.0])
@pytest.mark.parametrize("step", [affine(shift=(0.03, -0.02)), affine(0.05, 1.01, (0.01, 0.02)), affine(zoom=1.1)])
def test_constant_speed_is_left_as_it_is(step, frames):
    matrices = np.stack([np.linalg.matrix_power(step, k) for k in range(20)])
    path = CameraPath(matrices, np.ones(20), np.linspace(0, 1, 20))
    np.testing.assert_allclose(path.smoothed(frames), np.tile(np.eye(3), (20, 1, 1)), atol=1e-10)


def test_a_steady_turn_is_kept_and_its_shake_is_not():
    rng, num = np.random.default_rng(0), 120
    turn = np.stack([affine(0.03 * k) for k in range(num)])
    shake = np.stack([affine(shift=rng.normal(size=2) * 0.01) for _ in range(num)])
    smooth = CameraPath(shake @ turn, np.ones(num), np.linspace(0, 1, num)).smoothed(8.0) @ shake @ turn
    left = (smooth @ np.linalg.inv(turn))[20:-20]
    np.testing.assert_allclose(left[:, :2, :2], np.tile(np.eye(2), (len(left), 1, 1)), atol=1e-3)
    assert left[:, :2, 2].std(0).max() < 0.4 * 0.01


def test_smoothing_is_that_of_a_gaussian():
    num, frames, period = 200, 3.0, 10
    x = np.cos(2 * np.pi * np.arange(num) / period)
    path = CameraPath(np.stack([affine(shift=(v, 0)) for v in x - x[0]]), np.ones(num), np.linspace(0, 1, num))
    smooth = x + path.smoothed(frames)[:, 0, 2]
    kept = np.exp(-2 * (np.pi * frames / period) ** 2)
    np.testing.assert_allclose(smooth[20:-20], kept * x[20:-20], atol=4e-3)  # the filter ends after 3 deviations


def test_the_time_of_smoothing_does_not_grow_with_its_square():
    """Nearly an hour otherwise."""
    matrices = np.stack([affine(shift=(0.01 * k, 0)) for k in range(4)])
    smooth = CameraPath(matrices, np.ones(4), np.linspace(0, 1, 4)).smoothed(100_000.0)
    np.testing.assert_allclose(smooth, np.tile(np.eye(3), (4, 1, 1)), atol=1e-6)


def test_one_frame_and_short_shots():
    path = CameraPath(np.tile(np.eye(3), (3, 1, 1)), np.ones(3), np.array([0, 0.5, 1]), (0, 1))
    np.testing.assert_allclose(path.smoothed(10.0), path.matrices, atol=1e-12)
    single = scene(FrameTimes.uniform(1))
    np.testing.assert_allclose(stabilize(single).render(frame=0), single.render(frame=0), atol=1 / 255)


# --- the steadier video -------------------------------------------------------------------------------------


def test_jitter_falls_by_a_known_factor():
    model = scene(FrameTimes.uniform(40))
    video, path = shaken(model)
    steady = stabilize(video, smoothing=0.5, border="keep")

    def jitter(maps):
        track = at_corners(maps)
        return np.sqrt(((track - (np.roll(track, 1, 0) + np.roll(track, -1, 0)) / 2)[5:-5] ** 2).mean())

    assert jitter(steady.maps @ path) < jitter(path) / 10
    # The pan stays.
    moved = at_corners((steady.maps @ path)[[5, -6]])
    assert np.diff(moved[..., 0], axis=0).mean() == pytest.approx(max(SIZE) * 0.01 * 29, rel=0.2)


def test_a_fixed_camera_shows_the_middle_frame():
    video, _ = shaken(scene())
    steady = stabilize(video, fixed=True, border="keep")
    middle = picture(video, 5)
    inside = np.s_[16:-16, 24:-24]
    for k in (0, 3, NUM_FRAMES - 1):
        shown, shaky = picture(steady, k), picture(video, k)
        assert psnr(shown[inside], middle[inside]) > psnr(shaky[inside], middle[inside]) + 8
    np.testing.assert_allclose(steady.maps[5], np.eye(3), atol=1e-12)


def test_cropped_images_have_no_borders():
    video, _ = shaken(scene(wide=1.0))
    steady = stabilize(video, smoothing=0.5)
    seen = np.einsum("nij,cj->nci", np.linalg.inv(steady.maps), CORNERS)[..., :2]
    assert (np.abs(seen) <= [0.5 + 1e-9, 0.3 + 1e-9]).all()
    smaller = np.einsum("nij,cj->nci", np.linalg.inv(np.diag([1 / 1.005, 1 / 1.005, 1]) @ steady.maps), CORNERS)[
        ..., :2
    ]
    assert (np.abs(smaller) > [0.5, 0.3]).any()  # no more than is needed
    assert 1.02 < steady.zoom < 1.5


class Windowed:
    """A video whose Gaussians are known inside its frames only, as of a fit."""

    def __init__(self, video):
        self.video = video
        self.size, self.fps, self.options, self.compositing = video.size, video.fps, video.options, video.compositing
        self.num_frames, self.frame_times = video.num_frames, video.frame_times

    def prepare(self, size):
        prepared = self.video.prepare(size)

        class Prepared:
            def splats(self, t):
                splats = prepared.splats(t)
                inside = ((splats.mean > -4) & (splats.mean < np.array(size[::-1]) + 4)).all(1)
                leaves = splats.mean, splats.factor, splats.opacity, splats.color
                return Splats2D(*(leaf[inside] for leaf in leaves))

            def weighted_splats(self, t):
                return [(1.0, self.splats(t))]

        return Prepared()


def test_borders_are_filled_with_what_other_frames_show():
    whole, path = shaken(scene(wide=3.0, num=20_000, scales=(0.005, 0.015)), pan=0.04)
    video = Windowed(whole)
    known = CameraPath(path, np.ones(NUM_FRAMES), np.asarray(whole.frame_times.times()))
    kept, filled = (stabilize(video, fixed=True, border=border, path=known) for border in ("keep", "fill"))
    truth = picture(whole, 5)
    for k, uncovered in [(0, np.s_[:, :24]), (NUM_FRAMES - 1, np.s_[:, -28:])]:
        with_others, alone = picture(filled, k)[uncovered], picture(kept, k)[uncovered]
        assert alone.mean() < 0.3 * truth[uncovered].mean()
        assert psnr(with_others, truth[uncovered]) > psnr(alone, truth[uncovered]) + 10


def test_what_was_never_seen_is_not_shown():
    """Gaussians beyond the borders of the frames they are fitted to."""
    model = scene()
    moved = StabilizedVideo(model, np.tile(affine(shift=(0.4, 0)), (NUM_FRAMES, 1, 1)), standing(model), "keep")
    shown = picture(moved, 3)
    assert shown[:, :20].max() < shown[:, 80:].max() / 3
    assert np.median(shown[:, :20]) == 0
    assert shown[:, 80:].min(axis=2).mean() > 20


def test_times_between_frames_and_sizes():
    video, _ = shaken(scene())
    steady = stabilize(video, smoothing=0.5, border="keep")
    t = float(steady.path.times[3:5].mean())
    np.testing.assert_allclose(steady.map_at(t), steady.maps[3:5].mean(0))
    np.testing.assert_allclose(steady.map_at(1.0), steady.maps[-1])
    assert steady.render(t, size=(192, 320)).shape == (192, 320, 3)
    assert len(list(steady.frames([0.0, t]))) == 2


def test_between_shots_the_nearer_one_is_shown():
    model = scene()
    times = np.asarray(model.frame_times.times())
    path = CameraPath(np.tile(np.eye(3), (NUM_FRAMES, 1, 1)), np.ones(NUM_FRAMES), times, (0, 6))
    maps = np.stack([affine(shift=(0.1 * (k >= 6), 0)) for k in range(NUM_FRAMES)])
    video = StabilizedVideo(model, maps, path)
    assert [video.map_at(float(t))[0, 2] for t in (times[5] + 0.01, times[6] - 0.01)] == [0, 0.1]


def test_half_way_between_segments_image_and_map_are_those_of_one_frame():
    clip = SegmentedVideo.from_models([(0, scene(FrameTimes.uniform(3))), (3, scene(FrameTimes.uniform(2), num=1400))])
    path = CameraPath(np.tile(np.eye(3), (5, 1, 1)), np.ones(5), clip.frame_times.times(), (0, 3))
    video = StabilizedVideo(clip, np.stack([affine(shift=(0.2 * (k < 3), 0)) for k in range(5)]), path)
    np.testing.assert_allclose(video.render(2.5 / 4), clip.render(2.5 / 4), atol=1e-4)


SCENE = scene()
STILL = standing(SCENE)
FAR = CameraPath(np.stack([affine(shift=(0.2 * k, 0)) for k in range(NUM_FRAMES)]), np.ones(NUM_FRAMES), STILL.times)
OTHER = standing(scene(FrameTimes.uniform(3)))


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: stabilize(SCENE, path=STILL, smoothing=0.0), "smoothing: expected seconds > 0, got 0.0"),
        (lambda: stabilize(SCENE, path=STILL, smoothing=float("nan")), "smoothing: expected seconds > 0"),
        (
            lambda: stabilize(SCENE, path=STILL, smoothing=1e9),
            r"smoothing: expected at most [0-9.e+]+ seconds \(100,000 frames\), got 1000000000.0",
        ),
        (lambda: stabilize(SCENE, path=STILL, border="blur"), "border: expected one of"),
        (lambda: stabilize(SCENE, path=OTHER), "path: expected that of 12 frames, got 3"),
        (
            lambda: stabilize(SCENE, path=FAR, fixed=True),
            r"border: expected a path that a zoom of 2 suffices for.*Fill or keep",
        ),
        (
            lambda: stabilize(scene(compositing="sum"), border="fill", path=STILL),
            r'border: expected "crop" or "keep" with compositing "sum"',
        ),
        (lambda: stabilize("m.safetensors"), "video: expected a model or another video of it, got str"),
        (
            lambda: edit(stabilize(SCENE, border="keep", path=STILL)),
            "Edit first, and stabilize the edited video",
        ),
        (lambda: STILL.smoothed(-1), "frames: expected a number > 0"),
    ],
)
def test_mistakes_are_told(call, message):
    with pytest.raises(ValueError, match=message):
        call()


def test_a_notebook_shows_no_player():
    assert stabilize(SCENE, border="keep", path=STILL)._repr_html_() is None
