"""An object followed from its masks in some frames, and one chosen by a click."""

import numpy as np
import pytest
from panned_clips import SIZE, disc_clip, texture
from test_moving_object import overlap

from foldgauss.video import NothingMoves, find_moving_object, follow_object


@pytest.mark.parametrize("given", [(0,), pytest.param((11,), marks=pytest.mark.slow), (0, 11)], ids=str)
def test_an_object_is_followed_from_its_masks(given):
    frames, _, truth = disc_clip(3.0, 2.0, num_frames=12)
    found = follow_object(frames, {k: truth[k] for k in given})
    assert (found[list(given)] == truth[list(given)]).all()
    assert overlap(found, truth).min() >= 0.8


def test_an_object_that_stands_still_is_followed_by_color():
    """Nothing moves but the camera, by which nothing is told; the twin of another color is not taken."""
    frames, _, truth = disc_clip(3.0, 0.0, num_frames=8)
    frames = np.where(truth[..., None], np.uint8(0.4 * frames + [120, 0, 0]), np.uint8(0.7 * frames))
    found = follow_object(frames, {0: truth[0]})
    assert overlap(found, truth).min() >= 0.8


def test_an_object_that_was_hidden_is_found_again():
    frames, _, truth = disc_clip(0.0, 6.0, num_frames=16)
    pole = np.zeros(SIZE, bool)
    pole[:, 68:104] = True
    frames = np.where(pole[..., None], np.uint8(texture(9)[: SIZE[0], : SIZE[1]].clip(0, 255)), frames)
    truth &= ~pole
    assert (truth.sum((1, 2)) == 0).any()
    assert truth[-1].any()
    found = follow_object(frames, {0: truth[0]})
    assert overlap(found[-1:], truth[-1:]) >= 0.7
    hidden = ~truth.any((1, 2))
    assert found[hidden].mean() < 0.02


def test_shots_without_a_mask_have_none():
    one, _, truth = disc_clip(3.0, 2.0, num_frames=6)
    frames = np.concatenate([one, 255 - one[::-1]])
    with pytest.warns(UserWarning, match="No mask is given in the shots of frames 6:12"):
        found = follow_object(frames, {2: truth[2]})
    assert overlap(found[:6], truth).min() >= 0.75
    assert not found[6:].any()
    single = follow_object(np.concatenate([one[:1], 255 - one[2:]]), {0: truth[0], 3: truth[4]})
    assert (single[0] == truth[0]).all()


@pytest.mark.parametrize(
    ("masks", "told"),
    [
        ({}, "masks: expected one that is not empty"),
        ({0: np.zeros(SIZE, bool)}, "masks: expected one that is not empty"),
        ({12: np.ones(SIZE, bool)}, "masks: expected frames from 0 to 11, got 12"),
        ({0: np.ones((3, 3), bool)}, r"masks: expected bool \(90, 160\), got bool \(3, 3\) for frame 0"),
        ({0: np.ones(SIZE)}, "got float64"),
    ],
)
def test_masks_that_cannot_be_followed_are_refused(masks, told):
    with pytest.raises(ValueError, match=told):
        follow_object(np.zeros((12, *SIZE, 3), np.uint8), masks)


def test_a_click_chooses_one_of_two_objects():
    one, _, first = disc_clip(3.0, 2.0, num_frames=8)
    frames, second = one.copy(), np.zeros_like(first)
    rows, columns = np.mgrid[: SIZE[0], : SIZE[1]]
    for k in range(8):
        second[k] = np.hypot(columns - 130 + 4 * k, rows - 72) < 9
        frames[k][second[k]] = (230, 220, 40)
    second &= ~first
    assert overlap(find_moving_object(frames), first).mean() > 0.6  # the larger one
    found = find_moving_object(frames, at=(2, 130 - 8, 72))
    assert overlap(found, second).mean() > 0.6
    with pytest.raises(NothingMoves, match="moves against the background at 5,5 in frame 2, got none"):
        find_moving_object(frames, at=(2, 5, 5))
    with pytest.raises(ValueError, match=r"at: expected \(frame, x, y\) below \(8, 160, 90\), got \(8, 5, 5\)"):
        find_moving_object(frames, at=(8, 5, 5))
