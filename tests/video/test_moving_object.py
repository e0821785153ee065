"""The moving object of a clip, found without input, and the background behind it."""

import cv2
import numpy as np
import pytest
from object_clips import BOX, DISC, named_model

from foldgauss.video import (
    NothingMoves,
    SegmentedVideo,
    Selection,
    by_box,
    by_motion,
    edit,
    fill_background,
    find_moving_object,
    psnr,
    select,
)
from foldgauss.video.motion.background_plate import Alignment

SIZE, NUM_FRAMES, RADIUS = (90, 160), 10, 17.0


def texture(seed: int, size: tuple[int, int] = (140, 320), fine: float = 1.5) -> np.ndarray:
    """Colored noise, smoothed, float32 (*size, 3) about [0, 255]."""
    noise = cv2.GaussianBlur(np.random.default_rng(seed).normal(size=(*size, 3)).astype(np.float32), (0, 0), fine)
    return 128 + 45 * noise / noise.std()


def panned(ground: np.ndarray, shift: tuple[float, float]) -> np.ndarray:
    """What a camera sees of the ground."""
    matrix = np.float32([[1, 0, shift[0]], [0, 1, shift[1]]])
    return cv2.warpAffine(ground, matrix, SIZE[::-1], flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)


def disc_clip(pan: float = 3.0, speed: float = 2.0, seed: int = 0, disc: bool = True):
    """A textured disc over a textured ground, both in motion: frames, masks, and frames without the disc."""
    ground, skin = texture(seed), texture(seed + 1, fine=2.0) * [0.5, 0.7, 1.5]
    y, x = np.mgrid[: SIZE[0], : SIZE[1]].astype(np.float32)
    frames, masks, empty = [], [], []
    for k in range(NUM_FRAMES):
        behind = panned(ground, (20 + pan * k, 15 + 0.3 * pan * k))
        center = 60 + speed * k, 42 + 0.5 * k
        alpha = np.clip(RADIUS - np.hypot(x - center[0], y - center[1]) + 0.5, 0, 1)[..., None] * disc
        front = panned(skin, (80 - center[0], 60 - center[1]))
        frames.append(alpha * front + (1 - alpha) * behind)
        masks.append(alpha[..., 0] > 0.5)
        empty.append(behind)
    return *(np.clip(np.stack(one), 0, 255).round().astype(np.uint8) for one in (frames, empty)), np.stack(masks)


def overlap(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Intersection over union of each frame."""
    return (one & other).sum((1, 2)) / (one | other).sum((1, 2))


@pytest.mark.parametrize(("pan", "speed"), [(3.0, 2.0), (0.0, 2.0), (3.0, 0.0), (-4.0, 1.0)])
def test_a_disc_is_found_and_removed(pan, speed):
    frames, empty, truth = disc_clip(pan, speed)
    alignment = Alignment.from_frames(frames)
    masks = find_moving_object(frames, alignment=alignment)
    assert masks.shape == truth.shape
    assert masks.dtype == bool
    assert overlap(masks, truth).mean() >= 0.85
    assert overlap(masks, truth).min() >= 0.75

    filled = fill_background(frames, masks, alignment=alignment)
    kept = ~np.stack([cv2.dilate(mask.astype(np.uint8), np.ones((9, 9))) > 0 for mask in masks | truth])
    np.testing.assert_array_equal(filled[kept], frames[kept])
    middle = slice(3, -3)  # the disc leaves no place in fewer frames
    assert psnr(filled[middle], empty[middle]) > psnr(frames[middle], empty[middle]) + 8


@pytest.mark.parametrize("pan", [0.0, 3.0])
def test_where_nothing_moves_this_is_an_error(pan):
    frames, _, _ = disc_clip(pan, disc=False)
    noisy = frames + np.random.default_rng(0).normal(scale=3.0, size=frames.shape)
    for clip in (frames, noisy.clip(0, 255).astype(np.uint8)):
        with pytest.raises(NothingMoves, match=r"moving: expected an object that moves .* got none\. Select by a mask"):
            find_moving_object(clip)


def test_each_shot_has_its_own_object():
    one, _, truth = disc_clip()
    other, _, other_truth = disc_clip(pan=0.0, speed=-2.0, seed=5)
    masks = find_moving_object(np.concatenate([one, other[:, ::-1]]))
    assert overlap(masks, np.concatenate([truth, other_truth[:, ::-1]])).mean() >= 0.85
    still, _, _ = disc_clip(pan=0.0, seed=9, disc=False)
    masks = find_moving_object(np.concatenate([one, still]))
    assert not masks[NUM_FRAMES:].any()


@pytest.mark.parametrize(
    "frames", [np.zeros((2, 20, 30, 3), np.uint8), np.zeros((5, 20, 30), np.uint8), np.zeros((5, 20, 30, 3))]
)
def test_other_frames_are_refused(frames):
    with pytest.raises(ValueError, match="frames: expected uint8"):
        find_moving_object(frames)
    with pytest.raises(ValueError, match="frames: expected uint8"):
        fill_background(frames, np.zeros(frames.shape[:3], bool))


def test_other_masks_are_refused():
    frames = np.zeros((3, 20, 30, 3), np.uint8)
    for masks in (np.zeros((3, 20, 20), bool), np.zeros((3, 20, 30), np.uint8)):
        with pytest.raises(ValueError, match=r"masks: expected bool \(3, 20, 30\)"):
            fill_background(frames, masks)


# --- selections -----------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def moving():
    """A model of a disc and a box that move over a wall, and the labels of its Gaussians."""
    return named_model(num_frames=8)


def test_select_finds_the_gaussians(moving):
    model, label = moving
    found = by_motion(model)
    assert found.mask[np.isin(label, (DISC, BOX))].mean() > 0.4  # one of the two at least
    assert found.mask[~np.isin(label, (DISC, BOX))].mean() < 0.05
    assert select(model, moving=True) == found
    box = (0, 0, 36, 48)
    assert select(model, moving=True, box=box, frame=0) == found & by_box(model, box, frame=0)
    assert edit(model).select(moving=True).selection == found
    assert len(select(model, moving=True, threshold=0.9)) < len(found)


def test_segments_are_searched_one_by_one(moving):
    model, _ = moving
    video = SegmentedVideo.from_models([(0, model), (model.num_frames, model)])
    found = edit(video).select(moving=True).selection
    assert all(part == by_motion(model) for part in found.parts)
    still = edit(model).select(Selection(~by_motion(model).mask)).freeze(0).select(moving=True)
    with pytest.raises(NothingMoves):
        still.video()


def test_mistakes_are_told(moving):
    model, _ = moving
    with pytest.raises(ValueError, match="moving: expected True or False, got 1"):
        select(model, moving=1)
    with pytest.raises(ValueError, match="at least one criterion"):
        select(model, moving=False)
