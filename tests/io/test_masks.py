"""Masks of an object from images, folders and videos."""

import numpy as np
import pytest
from PIL import Image
from tiny_clips import MASK_SIZE as SIZE
from tiny_clips import labels, write_mask

from foldgauss.io import read_masks, write_image, write_video


@pytest.fixture
def folder(tmp_path):
    for k in range(12):
        write_mask(tmp_path / f"mask{k}.png", labels(k))
    return tmp_path


def test_a_folder_in_natural_order(folder):
    np.testing.assert_array_equal(read_masks(folder, label=1), [labels(k) == 1 for k in range(12)])
    np.testing.assert_array_equal(read_masks(folder, label=2, frames=(9, None)), [labels(k) == 2 for k in (9, 10, 11)])
    every = read_masks(folder, frames=(None, 2))
    assert every.dtype == bool
    np.testing.assert_array_equal(every, [(labels(k) == 1) | (labels(k) == 2) for k in range(2)])  # but void


def test_one_image(folder):
    np.testing.assert_array_equal(read_masks(folder / "mask3.png", label=1), labels(3) == 1)
    Image.fromarray(np.where(labels(3) == 1, np.uint8(255), np.uint8(0))).save(folder / "white.png")
    np.testing.assert_array_equal(read_masks(folder / "white.png"), labels(3) == 1)


@pytest.mark.parametrize("mode", ["RGB", "RGBA", "LA"])
def test_gray_levels_stored_otherwise(tmp_path, mode):
    """As paint programs do; frame 77 of bear in DAVIS 2016 has a channel of alpha."""
    Image.fromarray(np.where(labels(3) == 1, np.uint8(255), np.uint8(0))).convert(mode).save(tmp_path / "mask.png")
    np.testing.assert_array_equal(read_masks(tmp_path / "mask.png"), labels(3) == 1)


@pytest.mark.parametrize("suffix", [".png", ".tif"])
@pytest.mark.parametrize("white", [2, 256, 4080, 65535])
def test_masks_of_16_bits(tmp_path, white, suffix):
    """Labels as those of 8 bits; one larger value besides 0 is white."""
    for k, truth in enumerate((labels(3) == 1, np.zeros(SIZE, bool))):
        Image.fromarray(np.where(truth, np.uint16(white), np.uint16(0))).save(tmp_path / f"{k}{suffix}")
    np.testing.assert_array_equal(read_masks(tmp_path), [labels(3) == 1, np.zeros(SIZE, bool)])
    np.testing.assert_array_equal(read_masks(tmp_path, label=min(white, 3) if white < 256 else 1)[0], labels(3) == 1)
    Image.fromarray(labels(3).astype(np.uint16) * 300).save(tmp_path / f"2{suffix}")
    with pytest.raises(ValueError, match=r"expected masks with labels up to 255, got labels up to (10,964|65,535)"):
        read_masks(tmp_path)


def test_notes_of_a_mask_video_are_warnings(tmp_path):
    path = write_video(tmp_path / "mask.webm", [np.full((*SIZE, 3), 20 * k, np.uint8) for k in range(10)], 25)
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.warns(UserWarning, match="mask.webm: only 7 of 10 frames decode"):
        assert len(read_masks(path)) == 7


def test_a_video_is_cut_at_a_level(tmp_path):
    frames = [np.repeat(np.where(labels(k) == 1, 200, 30).astype(np.uint8)[..., None], 3, -1) for k in range(4)]
    path = write_video(tmp_path / "mask.mp4", frames, 25)
    found = read_masks(path, frames=(1, 4))
    truth = np.array([labels(k) == 1 for k in (1, 2, 3)])
    assert found.shape == truth.shape
    assert (found != truth).mean() < 0.01  # compressed
    assert not read_masks(path, level=0.95).any()


def test_cut_as_frames_are(folder):
    whole = read_masks(folder, label=2)
    np.testing.assert_array_equal(read_masks(folder, label=2, size=(40, 40)), whole[:, :, 10:50])
    np.testing.assert_array_equal(read_masks(folder, label=2, size=(10, 30)), whole[:, 10:30])


#: Below `folder`: a path, options of `read_masks`, and the error.
REFUSED = [
    ("none", {}, "missing"),
    ("", {"label": 3}, r"label: expected one of \[1, 2\] .*, got 3"),
    *(("", {"label": label}, "label: expected an object's label, 1 to 254") for label in (0, 255, 1.5, True)),
    ("", {"frames": (12, 13)}, "frames: expected A:B within 0:12, .* got 12:"),
    ("", {"frames": (5, 5)}, "frames: expected A:B with at least 1 frame"),
    ("mask0.png", {"frames": (0, 1)}, "frames: expected a folder or a video"),
    ("", {"size": (0, 5)}, "size: expected"),
    ("other", {}, "path: expected a folder with images"),
    ("other/colors/0.png", {}, "label per pixel.*'RGB'"),
    ("other/v.mp4", {"label": 1}, "label: expected images with labels, got the video"),
    *(("other/v.mp4", {"level": level}, "level: expected a fraction of white") for level in (0, 1.5, None)),
    ("other/text.mp4", {}, "does not open as a video"),
]


def test_refused(folder):
    (folder / "other" / "colors").mkdir(parents=True)
    write_image(folder / "other" / "colors" / "0.png", np.full((*SIZE, 3), (1, 2, 3), np.uint8))
    write_video(folder / "other" / "v.mp4", [np.zeros((*SIZE, 3), np.uint8)] * 2, 25)
    (folder / "other" / "text.mp4").write_text("none")
    for name, options, text in REFUSED:
        with pytest.raises((ValueError, FileNotFoundError), match=rf"^[^\n]*{text}[^\n]*$"):
            read_masks(folder / name, **options)
    assert len(read_masks(folder, frames=(10, 99))) == 2
