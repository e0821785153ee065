"""Optical flow of clips whose motion is known: tracks, folds, cuts and interpolated frames."""

import cv2
import numpy as np
import pytest
from clips import moving_blobs

from foldgauss.video.models.polynomial_folds import GAINED
from foldgauss.video.motion import optical_flow as motion
from foldgauss.video.motion.optical_flow import LONGEST, NEEDED, RIDGES, WINDOW, Motion, Tracks, fit_folds


def panning(num_frames: int, step: tuple[float, float], height: int = 96, width: int = 160, seed: int = 0):
    """A smooth random texture that moves by `step` pixels (x, y) a frame."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[0:height, 0:width].astype(np.float64)
    waves = rng.normal(size=(30, 2)) * 0.25
    phase, weight = rng.uniform(0, 2 * np.pi, 30), rng.uniform(0, 1, (30, 3))
    frames = np.empty((num_frames, height, width, 3), np.uint8)
    for k in range(num_frames):
        turn = waves[:, 0, None, None] * (x - k * step[0]) + waves[:, 1, None, None] * (y - k * step[1])
        picture = np.einsum("nhw,nc->hwc", np.sin(turn + phase[:, None, None]), weight)
        frames[k] = np.clip(128 + 25 * picture, 0, 255)
    return frames


@pytest.mark.parametrize("step", [(2.0, 0.0), (-1.5, 1.0), (0.0, 0.0)])
def test_tracks_follow_a_panning_camera(step):
    frames = panning(16, step)
    position = np.random.default_rng(1).uniform([50, 40], [110, 56], (200, 2)).astype(np.float32)
    tracks = Motion.from_frames(frames).follow(np.full(200, 8), position)
    assert tracks.known[:, LONGEST].all()
    assert np.median(tracks.reach) >= 10
    elapsed = np.arange(-LONGEST, LONGEST + 1)[None, :, None]
    miss = np.abs(tracks.shift - elapsed * np.array(step))[tracks.known]
    assert np.percentile(miss, 95) < 0.6
    # One stretch, around the point's own frame, within the clip.
    assert not tracks.known[:, : LONGEST - 8].any()
    assert (np.abs(np.diff(tracks.known.astype(int), axis=1)).sum(1) <= 2).all()
    folds, rms = fit_folds(tracks, np.full(200, 4.0), 3)
    assert np.median(rms) < 0.3
    u = -np.array([-3.0, 3.0])  # own time minus t
    moved = (folds[:, None] * u[:, None, None] ** np.arange(1, 4)[:, None]).sum(2)
    np.testing.assert_allclose(
        np.median(moved, 0), [[-3 * step[0], -3 * step[1]], [3 * step[0], 3 * step[1]]], atol=0.4
    )


def test_interpolated_frame_matches_the_motion():
    """Of a texture that moves by 4 pixels a frame it is the same texture, moved by a share of that."""
    finer = panning(9, (1.0, 0.5))
    seen = np.ascontiguousarray(finer[::4])
    motion = Motion.from_frames(seen)
    found = motion.interpolate(seen, 1, 0.75, (96, 160)).image
    inner = np.s_[8:-8, 8:-8]
    assert np.abs(found - finer[7])[inner].mean() < 0.15 * np.abs(np.float32(seen[2]) - finer[7])[inner].mean()
    # The left border comes from outside frame 1, not from a mean with what is not there.
    assert np.abs(found - finer[7])[8:-8, :2].mean() < 4
    small = motion.interpolate(seen, 1, 0.75, (48, 80)).image
    assert small.shape == (48, 80, 3)
    same = cv2.resize(finer[7], (80, 48), interpolation=cv2.INTER_AREA)
    assert np.abs(small - same)[inner].mean() < 3


def test_interpolation_beats_plain_warping_at_occlusions():
    """Also in strips beside a square that moves over a panning texture, where one frame only shows the background."""
    finer = passing(17, before=(1.0, 0.0), behind=(-1.0, 0.5))
    seen = np.ascontiguousarray(finer[::4])
    motion = Motion.from_frames(seen)
    for k, share in [(0, 0.25), (0, 0.5), (0, 0.75), (1, 0.5), (2, 0.5)]:
        found, plain = motion.interpolate(seen, k, share, (96, 160)).image, plainly_warped(*seen[k : k + 2], share)
        number = round(4 * (k + share))
        error, plain_error = (np.square(image - finer[number]) for image in (found, plain))
        assert error.mean() < 0.85 * plain_error.mean()
        for left in (30 + number, 80 + number) if k else ():
            assert error[30:70, left : left + 10].mean() < 0.7 * plain_error[30:70, left : left + 10].mean()


@pytest.mark.slow
def test_interpolation_follows_accelerated_motion():
    """Half way in time is not half way along the path. What is beyond a cut does not change it."""
    finer = np.stack([panning(2, (0.06 * k * k, 0.0))[1] for k in range(17)])
    seen = np.ascontiguousarray(finer[::4])
    motion, inner = Motion.from_frames(seen), np.s_[8:-8, 16:-16]
    for k in range(4):
        for share in (0.25, 0.5, 0.75):
            found, plain = motion.interpolate(seen, k, share, (96, 160)).image, plainly_warped(*seen[k : k + 2], share)
            target = finer[round(4 * (k + share))]
            assert np.square(found - target)[inner].mean() < 0.2 * np.square(plain - target)[inner].mean()
    cut = np.concatenate([panning(3, (0.0, 2.0), seed=5), seen, panning(3, (3.0, 0.0), seed=9)])
    beside = Motion.from_frames(cut)
    for k in (0, 3):
        found = beside.interpolate(cut, 3 + k, 0.5, (96, 160)).image
        np.testing.assert_array_equal(found, motion.interpolate(seen, k, 0.5, (96, 160)).image)


def test_interpolation_of_a_still_clip_is_the_clip():
    still = np.repeat(panning(1, (0.0, 0.0)), 4, axis=0)
    for k in range(3):
        np.testing.assert_allclose(
            Motion.from_frames(still).interpolate(still, k, 0.3, (96, 160)).image, still[0], atol=1e-3
        )


def passing(num_frames: int, before: tuple[float, float], behind: tuple[float, float]):
    """A textured square moving over another texture."""
    frames, square = panning(num_frames, behind), panning(num_frames, before, seed=3)
    for k in range(num_frames):
        x, y = round(40 + before[0] * k), round(30 + before[1] * k)
        frames[k, y : y + 40, x : x + 40] = square[k, y : y + 40, x : x + 40]
    return frames


def plainly_warped(one, other, share: float):
    gray = [cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY) for picture in (one, other)]
    search = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    grid = np.stack(np.meshgrid(np.arange(160), np.arange(96)), -1).astype(np.float32)
    moved = [
        cv2.remap(
            np.float32(picture),
            grid - np.float32(way) * search.calc(*pair, None),
            None,
            cv2.INTER_CUBIC,
            borderMode=cv2.BORDER_REPLICATE,
        )
        for picture, pair, way in ((one, gray, share), (other, gray[::-1], 1 - share))
    ]
    return (1 - share) * moved[0] + share * moved[1]


def test_cuts_are_found():
    one, other, third = panning(7, (2, 0)), panning(5, (0, 0), seed=5), panning(4, (0, -1), seed=9)
    assert Motion.from_frames(np.concatenate([one, other, third])).cuts == [7, 12]
    assert Motion.from_frames(one).cuts == []
    assert Motion.from_frames(moving_blobs()).cuts == []
    assert Motion.from_frames(np.full((3, 20, 30, 3), 7, np.uint8)).cuts == []


def test_tracks_end_at_a_cut():
    frames = np.concatenate([panning(7, (2, 0)), panning(7, (2, 0), seed=5)])
    position = np.random.default_rng(1).uniform([50, 40], [110, 56], (100, 2)).astype(np.float32)
    tracks = Motion.from_frames(frames).follow(np.full(100, 5), position)
    assert tracks.known[:, LONGEST + 2 :].mean() < 0.03


@pytest.mark.parametrize("degree", [0, 1, 2, 3, 5])
def test_folds_of_known_tracks(degree):
    """A cubic track, seen whole: its coefficients come back; a degree that is too low misses it."""
    elapsed = np.arange(-LONGEST, LONGEST + 1)
    u = -elapsed[:, None] / 10.0
    shift = (np.array([[3.0, -1.0]]) * u + np.array([[0.5, 2.0]]) * u**2 + np.array([[0.2, 0.0]]) * u**3)[None]
    tracks = Tracks(shift.astype(np.float32), np.ones((1, 2 * LONGEST + 1), bool))
    folds, rms = fit_folds(tracks, np.array([20.0]), degree)
    assert folds.shape == (1, degree, 2)
    if degree >= 3:
        near, powers = np.abs(elapsed) <= 15, (-elapsed[:, None]) ** np.arange(1.0, degree + 1)
        np.testing.assert_allclose(
            (powers @ folds[0])[near], shift[0][near], atol=0.3
        )  # of up to 8 pixels; a ridge holds it back
        assert rms[0] < 0.1
        assert not folds[0, 3:].any()
    else:
        assert rms[0] > 0.3


def test_maps_shrink_to_the_memory_limit(monkeypatch):
    frames = panning(4, (2.0, 0.0))
    assert Motion.from_frames(frames).small.shape == (4, 96, 160, 3)
    monkeypatch.setattr(motion, "MAP_BYTES", 0)  # as where the clip is long: then the share of the frames' bytes counts
    small = Motion.from_frames(frames)
    kept = small.small.nbytes + small.there.nbytes + small.back.nbytes
    assert 0.1 * frames.nbytes < kept <= motion.MAP_FRACTION * frames.nbytes
    tracks = small.follow(np.full(20, 1), np.full((20, 2), [80.0, 48.0], np.float32))
    assert tracks.known[:, LONGEST + 1].all()
    np.testing.assert_allclose(tracks.shift[:, LONGEST + 1], np.tile([2.0, 0.0], (20, 1)), atol=0.5)


@pytest.mark.parametrize("degree", [1, 2, 3])
def test_folds_are_the_weighted_least_squares(degree):
    """Against NumPy's least squares, with the ridge as further rows; tracks and windows of any length."""
    rng, num, longest = np.random.default_rng(0), 60, 9
    u = -np.arange(-longest, longest + 1.0)
    shift = np.cumsum(rng.normal(size=(num, len(u), 2)), axis=1).astype(np.float32)
    known = np.zeros((num, len(u)), bool)
    for row in known:
        row[longest - rng.integers(longest + 1) : longest + 1 + rng.integers(longest + 1)] = True
    shift -= shift[:, longest : longest + 1]
    shift[~known] = 0
    spread, found = rng.uniform(0.4, 15.0, num), []
    coefficients, miss = fit_folds(Tracks(shift, known), spread, degree)
    for n in range(num):
        window = WINDOW * spread[n]
        unit, root = min(window, longest), np.sqrt(known[n] * np.exp(-0.5 * (u / window) ** 2))
        best, error = None, np.inf
        for used in range(1, degree + 1):  # another power only where it is needed, and gains
            powers = (u / unit)[:, None] ** np.arange(1, used + 1)
            design = np.concatenate([root[:, None] * powers, np.diag(np.sqrt(RIDGES[:used]))])
            target = np.concatenate([root[:, None] * shift[n], np.zeros((used, 2))])
            own = np.linalg.lstsq(design, target, rcond=None)[0]
            left = np.sqrt(((root[:, None] * (shift[n] - powers @ own)) ** 2).sum() / (root**2).sum())
            if error > NEEDED and left < GAINED * error:
                best, error = own / unit ** np.arange(1, used + 1)[:, None], left
        found.append(len(best))
        np.testing.assert_allclose(coefficients[n, : len(best)], best, rtol=1e-3, atol=1e-5)
        np.testing.assert_allclose(miss[n], error, rtol=1e-3, atol=1e-4)
        assert (coefficients[n, len(best) :] == 0).all()
    assert set(found) == set(range(1, degree + 1))
