"""The moving object of a clip, found without input, and the background behind it."""

import numpy as np
import pytest
from object_clips import BACKGROUND, DISC, named_model, square
from panned_clips import SIZE, disc_clip, panned, texture

from foldgauss.video import (
    NothingMoves,
    SegmentedVideo,
    by_box,
    by_mask,
    by_motion,
    by_time,
    edit,
    find_moving_object,
    psnr,
    select,
)
from foldgauss.video.motion.background_plate import Alignment, complete_background, cover
from foldgauss.video.motion.layer_clips import separate
from foldgauss.video.motion.moving_object import _assign_by_color, _clean, nothing_moves
from foldgauss.video.selection import selectors


def overlap(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Intersection over union of each frame."""
    return (one & other).sum((1, 2)) / (one | other).sum((1, 2))


@pytest.mark.parametrize(
    ("pan", "speed"),
    [(3.0, 2.0), *(pytest.param(*one, marks=pytest.mark.slow) for one in ((3.0, 0.0), (0.0, 2.0), (-4.0, 1.0)))],
)
def test_a_disc_is_found(pan, speed):
    frames, _, truth = disc_clip(pan, speed)
    masks = find_moving_object(frames)
    assert masks.shape == truth.shape
    assert masks.dtype == bool
    assert overlap(masks, truth).mean() >= 0.85
    assert overlap(masks, truth).min() >= 0.75


def textured_clip(ground, skin, truth):
    """Frames of an object of one texture before a ground of another; each a factor for the channels of noise."""
    behind, front = (panned(texture(seed) * factor, (9, 9)) for seed, factor in enumerate((ground, skin)))
    frames = [np.where(mask[..., None], front, behind) for mask in truth]
    return np.clip(np.stack(frames), 0, 255).round().astype(np.uint8)


GREEN, RED = [0.4, 1.2, 0.4], [1.4, 0.4, 0.4]
ROWS, COLUMNS = np.mgrid[: SIZE[0], : SIZE[1]]


def test_pixels_near_the_object_are_assigned_by_color():
    """Votes that miss a part of the border, or hold some of what is around it; far from them no color counts."""
    truth = np.stack([np.hypot(COLUMNS - 60 - 2 * k, ROWS - 40) < 20 for k in range(26)])
    twin = np.hypot(COLUMNS - 140, ROWS - 70) < 12  # of the object's color, elsewhere
    frames = textured_clip(GREEN, RED, truth | twin)
    votes = truth.astype(np.float32)
    votes[2, 24:56, 72:] *= 0.3
    votes[5, 45:70, 40:60] = 0.7
    votes[25] = 0
    plain = np.stack([_clean(vote > 0.5) for vote in votes])
    assert overlap(plain, truth)[[2, 5]].max() < 0.9
    masks = _assign_by_color(frames, votes)
    assert overlap(masks, truth)[:25].min() > 0.97
    assert not masks[:, twin].any()
    assert not masks[25].any()
    assert not _assign_by_color(frames, np.zeros_like(votes)).any()


def test_the_background_is_filled_in_from_other_frames():
    frames, empty, truth = disc_clip(pan=4.0, speed=1.0, num_frames=10)
    alignment = Alignment.from_frames(frames)
    assert alignment.shots == [(0, 10)]
    covered = cover(truth)
    filled, unknown = complete_background(frames, covered, alignment)
    np.testing.assert_array_equal(filled[~covered], frames[~covered])
    assert psnr(filled, empty) > 35 > 25 > psnr(frames, empty)
    assert unknown < 0.1
    # Without other frames to fill it from, the hole is filled from its surroundings.
    everywhere = np.broadcast_to(truth.any(0), truth.shape)
    filled, unknown = complete_background(frames[:3], everywhere[:3])
    assert 30 > psnr(filled, empty[:3]) > psnr(frames[:3], empty[:3])
    assert unknown > 0.1


@pytest.mark.parametrize(
    ("pan", "noise"),
    [(3.0, 3.0), *(pytest.param(*case, marks=pytest.mark.slow) for case in [(3.0, 0.0), (0.0, 3.0), (0.0, 0.0)])],
)
def test_where_nothing_moves_this_is_an_error(pan, noise):
    frames, _, _ = disc_clip(pan, disc=False)
    noisy = (frames + np.random.default_rng(0).normal(scale=noise, size=frames.shape)).clip(0, 255).astype(np.uint8)
    with pytest.raises(NothingMoves, match=r"moving: expected an object that moves .* got none\. Select by a mask"):
        find_moving_object(noisy)


def test_each_shot_has_its_own_object_or_none():
    one, _, truth = disc_clip(num_frames=5)
    other, _, other_truth = disc_clip(pan=0.0, speed=-2.0, seed=5, num_frames=5)
    still, _, _ = disc_clip(pan=0.0, seed=9, disc=False, num_frames=3)
    with pytest.warns(UserWarning, match=r"^No moving object was found in the shots of frames 10:13\.$"):
        masks = find_moving_object(np.concatenate([one, other[:, ::-1], still]))
    assert overlap(masks[:5], truth).mean() >= 0.85
    assert overlap(masks[5:10], other_truth[:, ::-1]).mean() >= 0.85
    assert not masks[10:].any()


COLORED, GRAY = np.zeros((3, 20, 30, 3), np.uint8), np.zeros((5, 20, 30), np.uint8)
WRONG = {
    "two frames": (lambda: find_moving_object(COLORED[:2]), "frames: expected uint8"),
    "gray frames": (lambda: find_moving_object(GRAY), "frames: expected uint8"),
    "float frames": (lambda: separate(COLORED.astype(float), {"it": GRAY[:3] > 0}), "frames: expected uint8"),
    "a number": (lambda: select(SHORT, moving=1), "moving: expected True or False, got 1"),
    "no criterion": (lambda: select(SHORT, moving=False), "select: expected at least one criterion"),
    "few frames": (lambda: by_motion(SHORT), "moving: expected a video of 3 frames at least, got 2"),
}
SHORT = named_model(num_frames=2)[0]


@pytest.mark.parametrize("name", WRONG)
def test_mistakes_are_told(name):
    call, message = WRONG[name]
    with pytest.raises(ValueError, match=f"^{message}"):
        call()


# --- selections -----------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def moving():
    """A model of a disc and a box that move over a wall, the labels of its Gaussians, and what moves."""
    model, label = named_model(num_frames=6)
    return model, label, by_motion(model)


@pytest.fixture
def searched(moving, monkeypatch):
    """The search of each model gives the disc's place, without the search."""
    model, _, _ = moving
    masks = np.stack([square(model, DISC, k) for k in range(model.num_frames)])
    monkeypatch.setattr(selectors, "find_moving_object", lambda frames: masks)
    return by_mask(model, masks)


def test_the_gaussians_of_the_object_are_found(moving):
    """The disc passes the box, and objects that touch count as one."""
    _, label, found = moving
    assert found.mask[label != BACKGROUND].mean() > 0.95
    assert found.mask[label == DISC].mean() > 0.95
    assert found.mask[label == BACKGROUND].mean() < 0.1


def test_select_combines_motion_with_other_criteria(moving, searched):
    model, _, _ = moving
    assert by_motion(model) == select(model, moving=True) == edit(model).select(moving=True).selection == searched
    box = (0, 0, 36, 48)
    assert select(model, moving=True, box=box, frame=0) == searched & by_box(model, box, frame=0)
    assert select(model, moving=True, frames=(0, 3)) == searched & by_time(model, frames=(0, 3))
    assert len(select(model, moving=True, threshold=0.99)) < len(searched)


def test_segments_are_searched_one_by_one(moving, searched, monkeypatch):
    model, _, _ = moving
    num, calls = model.num_frames, []
    video = SegmentedVideo.from_models([(0, model), (num, model)])
    assert np.array_equal(edit(video).select(moving=True).selection.mask, np.tile(searched.mask, 2))

    def search(frames):
        calls.append(frames)
        if len(calls) == 1 or search.still:
            raise nothing_moves("an object", "none")
        return np.stack([square(model, DISC, k) for k in range(num)])

    monkeypatch.setattr(selectors, "find_moving_object", search)
    search.still = False
    with pytest.warns(
        UserWarning, match="^Segment 0, from frame 0 on: moving: expected an object, got none. Select by"
    ):
        found = edit(video).select(moving=True).selection.mask
    assert found.sum() == found[-searched.num_gaussians :].sum() == len(searched)
    search.still = True
    with pytest.raises(NothingMoves):  # and no warning for each segment
        edit(video).select(moving=True)
