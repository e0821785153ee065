"""Fits whose Gaussians follow the motion of the camera."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
import scipy
from path_models import affine, scene

from foldgauss.io import load_video_model, save_video_model
from foldgauss.video import FitConfig, evaluate, fit, fit_steps
from foldgauss.video.fitting import loop
from foldgauss.video.fitting.loop import start, start_from
from foldgauss.video.fitting.state import paths_of, to_model
from foldgauss.video.models.shared_paths import SharedPaths
from foldgauss.video.motion.camera_path import fit_affine
from foldgauss.video.motion.optical_flow import Motion
from foldgauss.video.motion.path_coordinates import PathCoordinates
from foldgauss.video.motion.shared_motions import FARTHEST, _Clip, find_shared_motions

CONFIG = FitConfig(num_gaussians=1500, steps=300, degree=2)
#: Enough for what a shaken camera costs.
QUICK = dataclasses.replace(CONFIG, num_gaussians=800, steps=150)
TIMES = np.linspace(0, 1, 12)


def shaken(maps, **settings) -> np.ndarray:
    """Frames of a plane of Gaussians, seen by a camera that moves: `maps` (12, 3, 3) of each frame."""
    model = scene(wide=3.0, scales=(0.01, 0.03), num=4000, **settings)
    paths = SharedPaths(jnp.asarray(TIMES[None], jnp.float32), jnp.asarray(maps[None, :, :2], jnp.float32))
    splats = dataclasses.replace(model.splats, path_index=np.ones(model.num_gaussians, np.uint8), paths=paths)
    return np.stack(list(dataclasses.replace(model, splats=splats).frames()))


def shake(seed=0, distance=0.02, turn=0.01) -> np.ndarray:
    """The maps of a hand-held camera: every frame is somewhere else."""
    rng = np.random.default_rng(seed)
    return np.stack([affine(rng.normal() * turn, 1.0, rng.normal(size=2) * distance) for _ in TIMES])


def find_camera(motion: Motion) -> np.ndarray:
    """The maps of the camera, (frames, 2, 3)."""
    return find_shared_motions(motion)[0]


MAPS = shake()
FRAMES = shaken(MAPS)
PAN = shaken(np.stack([affine(shift=(0.02 * k, 0.005 * k)) for k in range(12)]))


def test_maps_are_found_to_a_fraction_of_a_pixel():
    found = np.tile(np.eye(3), (12, 1, 1))
    found[:, :2] = find_camera(Motion.from_frames(FRAMES))
    expected = MAPS @ np.linalg.inv(MAPS[5])  # the middle frame
    corners = np.array([[x, y, 1] for x in (-0.5, 0.5) for y in (-0.3, 0.3)])
    miss = np.einsum("kij,cj->kci", found - expected, corners)[..., :2] * FRAMES.shape[2]
    assert np.sqrt((miss**2).sum(-1).mean()) < 0.3


def test_maps_do_not_drift_away_where_the_camera_never_returns():
    """A zoom by 15% in each frame, which adds up to 4.7 times."""
    maps = np.stack([affine(zoom=1.15**k) @ shaking for k, shaking in enumerate(MAPS)])
    found = np.tile(np.eye(3), (12, 1, 1))
    found[:, :2] = find_camera(Motion.from_frames(shaken(maps)))
    assert np.abs(np.log(np.linalg.svd(found[:, :2, :2], compute_uv=False))).max() < FARTHEST[0]
    assert np.linalg.det(found[-1, :2, :2]) > 1.1  # but they follow


def test_an_unknown_step_of_a_pan_is_no_jump(monkeypatch):
    """Unknown where the image has no texture."""
    own = _Clip.find_textured
    monkeypatch.setattr(_Clip, "find_textured", lambda clip, k, spacing: own(clip, k, spacing) & (k != 5))
    assert find_shared_motions(Motion.from_frames(PAN)) is None


def test_every_shot_has_coordinates_of_its_own():
    both = np.concatenate([FRAMES, FRAMES[::-1, ::-1]])
    found = find_camera(Motion.from_frames(both))
    for middle in (5, 17):
        np.testing.assert_allclose(found[middle], np.eye(2, 3), atol=1e-12)


@pytest.mark.slow
def test_maps_are_learned(monkeypatch):
    """From maps that are wrong by half a pixel."""
    found = find_shared_motions(Motion.from_frames(FRAMES))[:1]
    wrong = found + np.random.default_rng(0).normal(size=(12, 2, 3)) * [0, 0, 0.5 / 160]
    monkeypatch.setattr(loop, "find_shared_motions", lambda motion, steady: wrong)
    held = dataclasses.replace(CONFIG, rates=dataclasses.replace(CONFIG.rates, paths=0.0))
    learned, fixed = (fit(FRAMES, config).model for config in (CONFIG, held))
    assert evaluate(learned, FRAMES).mean_psnr > evaluate(fixed, FRAMES).mean_psnr + 1
    np.testing.assert_array_equal(fixed.splats.paths.matrices, np.float32(wrong))


def test_an_object_that_stays_in_the_frame_does_not_follow():
    frames = FRAMES.copy()
    frames[:, 30:66, 60:100] = np.random.default_rng(1).integers(0, 255, (9, 10, 3)).repeat(4, 0).repeat(4, 1)
    state = start(frames, CONFIG)
    x, y = (state.rows[:, :2] * 160 + [80, 48]).T
    inside = (x > 64) & (x < 96) & (y > 34) & (y < 62)
    assert state.rows[inside, -1].mean() < 0.4
    assert state.rows[~inside, -1].mean() > 0.6


NOISE = scipy.ndimage.gaussian_filter(np.random.default_rng(2).normal(size=(40, 48, 3)), (2.5, 2.5, 0))
PATCH = np.clip(128 + 400 * NOISE, 0, 255).astype(np.uint8)


def with_object(frames: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """The frames, and `PATCH` before them: its upper left corner (x, y) in each, in pixels."""
    frames, (rows, columns) = frames.copy(), PATCH.shape[:2]
    for frame, (x, y) in zip(frames, corners, strict=True):
        frame[y : y + rows, x : x + columns] = PATCH
    return frames


CORNERS = np.random.default_rng(3).integers([47, 22], [54, 29], (12, 2))
WITH_OBJECT = with_object(FRAMES, CORNERS)


def check_object(maps: np.ndarray, corners: np.ndarray) -> None:
    """Whether the maps (12, 2, 3) move the center of the object as `corners` do."""
    center = np.array([*((corners[5] + np.array(PATCH.shape[1::-1]) / 2 - [80, 48]) / 160), 1])
    np.testing.assert_allclose((maps @ center) * 160 - (maps[5] @ center) * 160, corners - corners[5], atol=0.5)


def test_an_object_with_a_motion_of_its_own_is_found():
    found = find_shared_motions(Motion.from_frames(WITH_OBJECT))
    assert len(found) == 2
    check_object(found[1], CORNERS)


def test_an_object_before_a_camera_that_stands_still_is_found():
    frames = with_object(FRAMES[:1].repeat(12, 0), CORNERS)
    (found,) = find_shared_motions(Motion.from_frames(frames))
    check_object(found, CORNERS)


#: Frames, settings, and the decibels that it is worth to follow a camera or an object in them. Where a frame is missing
#: folds do not jump, and learned frame times take longer to make up for it.
WORTH = {
    "a shaken camera": (FRAMES, QUICK, 3),
    "a pan with a missing frame": (np.delete(PAN, 6, 0), CONFIG, 1),
    "an object before a shaken camera": (WITH_OBJECT, CONFIG, 3),
    "an object before a camera that stands still": (with_object(FRAMES[:1].repeat(12, 0), CORNERS), CONFIG, 2),
}


@pytest.mark.parametrize(
    "name", [pytest.param(k, marks=[] if k == "a shaken camera" else pytest.mark.slow) for k in WORTH]
)
def test_following_is_worth_decibels(name):
    frames, config, decibels = WORTH[name]
    alone = dataclasses.replace(config, follow_camera=False)
    with_path, without = (fit(frames, one).model for one in (config, alone))
    assert without.splats.paths is None
    assert with_path.splats.paths is not None
    assert name != "a shaken camera" or np.asarray(with_path.splats.path_index).mean() > 0.5
    assert evaluate(with_path, frames).mean_psnr > evaluate(without, frames).mean_psnr + decibels


def before_flat_background():
    """An object of noise that jumps."""
    rng, y_x = np.random.default_rng(0), np.mgrid[:96, :160]
    frames = np.full((12, 96, 160, 3), 120, np.uint8)
    for frame, (x, y) in zip(frames, rng.uniform([40, 30], [120, 66], (12, 2)), strict=True):
        inside = np.hypot(y_x[0] - y, y_x[1] - x) < 9
        frame[inside] = rng.integers(0, 255, (inside.sum(), 3))
    return frames


STEADY = np.array([[30 + 3 * k, 20 + k] for k in range(12)])
SNOW = np.random.default_rng(0).integers(0, 255, (5, 96, 160, 3)).astype(np.uint8)
WITHOUT_MAPS = {
    "still": lambda: FRAMES[:1].repeat(6, 0),
    "pan": lambda: PAN,
    "rotation": lambda: shaken(np.stack([affine(turn=0.03 * k) for k in range(12)])),
    "object at constant speed": lambda: with_object(FRAMES[:1].repeat(12, 0), STEADY),
    "object before a flat background": before_flat_background,
    "cuts everywhere": lambda: SNOW,
    "two frames": lambda: SNOW[:2],
    "one frame": lambda: SNOW[:1],
    "flat": lambda: np.full_like(SNOW, 120),
}


@pytest.mark.parametrize("name", WITHOUT_MAPS)
def test_what_folds_follow_or_nothing_tells_has_no_maps(name):
    frames = WITHOUT_MAPS[name]()
    assert find_shared_motions(Motion.from_frames(frames)) is None
    if name == "still":
        assert start(frames, CONFIG).path_maps.shape == (6, 0, 2, 3)


def test_changes_are_those_of_the_path():
    """Zero for cubics, by numpy's differences for noise, whose second differences they are as large as."""
    clip = _Clip.of(Motion.from_frames(FRAMES[:1].repeat(12, 0)))
    rng = np.random.default_rng(0)
    curve = np.stack([np.polyval(rng.normal(size=4), TIMES) for _ in range(2)], 1)
    noise = rng.normal(size=(12, 2))
    measured = []
    for path in (curve, noise):
        steps = np.tile(np.eye(3), (12, 1, 1))
        steps[1:, :2, 2] = np.diff(path, axis=0)
        measured.append(clip.measure_changes(steps, path[:, None]))
    assert np.isnan(measured[1][[0, 1, 10, 11]]).all()
    assert measured[0][2:-2].max() < 1e-12
    expected = np.linalg.norm(np.diff(noise, 4, axis=0), axis=1) * np.sqrt(6 / 70)
    np.testing.assert_allclose(measured[1][2:-2], expected)


def test_a_camera_that_shakes_for_a_while_is_followed():
    """Most of the changes are zero."""
    maps = np.tile(MAPS[:1], (30, 1, 1))
    maps[10:15] = MAPS[3:8]
    clip = _Clip.of(Motion.from_frames(FRAMES[:1].repeat(30, 0)))
    steps = np.tile(np.eye(3), (30, 1, 1))
    steps[1:] = maps[1:] @ np.linalg.inv(maps[:-1])
    places = np.tile(0.3 * np.array([[x, y] for x in (-1, 1) for y in (-1, 1)]), (30, 1, 1))
    assert np.median(clip.measure_changes(steps, places)[2:-2]) < 1e-12
    np.testing.assert_array_equal(clip.keep_unsteady(steps, steps), steps)


def test_shots_with_a_steady_camera_have_coordinates_of_their_frames():
    found = find_camera(Motion.from_frames(np.concatenate([FRAMES, PAN[:, ::-1, ::-1]])))
    assert np.abs(found[:12] - np.eye(2, 3)).max() > 0.01
    np.testing.assert_array_equal(found[12:], np.tile(np.eye(2, 3), (12, 1, 1)))


def test_gaussians_follow_the_object():
    model = to_model(start(WITH_OBJECT, CONFIG), CONFIG, FRAMES.shape[1:3], 12.0)
    on = np.asarray(model.splats.path_index) == 2
    position = np.asarray(model.splats.loc)[on] * 160 + [80, 48] - CORNERS[5]  # of the middle frame
    inside = ((position > -2) & (position < np.array(PATCH.shape[1::-1]) + 2)).all(1)
    assert on.sum() > 50
    assert inside.mean() > 0.8


def test_no_object_is_found_where_the_camera_alone_moves():
    assert len(find_shared_motions(Motion.from_frames(FRAMES))) == 1


def test_objects_in_several_shots():
    both = np.concatenate([WITH_OBJECT, WITH_OBJECT[:, ::-1, ::-1]])
    found = find_shared_motions(Motion.from_frames(both))
    check_object(found[1, :12], CORNERS)
    check_object(found[1, 12:], [160, 96] - CORNERS - PATCH.shape[1::-1])


@pytest.mark.parametrize("num", [2, 4, 5])
def test_motions_of_few_frames(num):
    """A cubic fold goes through any four places."""
    found = find_shared_motions(Motion.from_frames(WITH_OBJECT[:num]))
    assert found is None if num < 5 else len(found) >= 1


def test_maps_that_are_unknown_or_mirror_or_zoom_very_much_are_not_believed():
    line = np.float32([[2, 2], [6, 2], [10, 2]])
    assert fit_affine(line, line + 1, 0.5, 3) is None
    points = np.random.default_rng(0).uniform(0, 100, (30, 2)).astype(np.float32)
    assert fit_affine(points, points * 1.5, 0.5, 6)[1] == 30
    assert fit_affine(points, points * 2.5, 0.5, 6) is None
    assert fit_affine(points, points * [1, -1], 0.5, 6) is None


def test_starts_lie_where_the_frame_shows_them():
    model = to_model(start(FRAMES, CONFIG), CONFIG, FRAMES.shape[1:3], 12.0)
    still = dataclasses.replace(CONFIG, follow_camera=False)
    plain = to_model(start(FRAMES, still), still, FRAMES.shape[1:3], 12.0)
    ours, theirs = (evaluate(one, FRAMES).mean_psnr for one in (model, plain))
    assert ours > theirs - 0.5


@pytest.mark.filterwarnings("ignore::foldgauss.video.DivergenceWarning")
@pytest.mark.parametrize("value", [np.nan, 0.0])
def test_maps_that_cannot_be_inverted_are_a_fault(value):
    for state, info in fit_steps(FRAMES, dataclasses.replace(CONFIG, num_gaussians=200, steps=60)):
        if info.step == 20:
            state.path_maps[3, 0, :, :2] = value
    assert state.backoffs == 1
    assert (np.linalg.det(state.path_maps[..., :2]) > 0).all()


def test_coordinates_of_positions_and_tracks_agree():
    paths = SharedPaths(np.float32(TIMES)[None], np.float32(MAPS[None, :, :2]))
    (camera,) = PathCoordinates.of_each(paths, TIMES, (96, 160))
    position, home = np.array([[20.0, 30.0], [100.0, 80.0]]), np.array([3, 7])
    tracks = Motion.from_frames(FRAMES).follow(home, position.astype(np.float32))
    placed = camera.place_tracks(tracks, home, position)
    np.testing.assert_array_equal(placed.known, tracks.known)
    for n in range(2):
        for step in np.flatnonzero(tracks.known[n]):
            frame = home[n] + step - 36
            there = camera.place(np.array([frame]), position[[n]] + tracks.shift[n, step])[0]
            own = camera.place(home[[n]], position[[n]])[0] + placed.shift[n, step]
            np.testing.assert_allclose(own, there, atol=1e-3)
    # The background stands still there, but for the error of the flow.
    assert np.abs(placed.shift[tracks.known]).mean() < 0.2 * np.abs(tracks.shift[tracks.known]).mean()


def test_a_model_can_be_saved_loaded_and_fitted_further(tmp_path):
    config = dataclasses.replace(CONFIG, num_gaussians=400, steps=20)
    model = fit(FRAMES, config).model
    again = load_video_model(save_video_model(tmp_path / "m.safetensors", model))
    state = start_from(again, config, 10)
    np.testing.assert_allclose(paths_of(state).matrices, model.splats.paths.matrices, atol=1e-6)
    for after, _ in fit_steps(FRAMES, config, state):
        pass
    assert np.isfinite(after.path_maps).all()
