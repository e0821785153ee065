"""The comparison people look at."""

import numpy as np

from foldgauss.cli.shared.contact_sheet import ERROR_GAIN, make_comparison_sheet


def test_layout_and_error():
    original = np.full((40, 60, 3), 100, np.uint8)
    picture = original.copy()
    picture[10:20, 10:20] = 103
    montage = make_comparison_sheet([original, original], [picture, original], ["a", "b"])
    assert montage.dtype == np.uint8
    assert montage.shape[0] > 80
    assert montage.shape[1] > 180
    assert np.any(np.all(montage == 3 * ERROR_GAIN, axis=-1))  # the magnified error
    assert np.any(np.all(montage == 103, axis=-1))


def test_titles_fit_into_narrow_pictures():
    """The gap beside a picture stays paper: no letter is cut off."""
    for width in range(90, 260, 10):
        plain = np.full((40, width, 3), 100, np.uint8)
        montage = make_comparison_sheet([plain], [plain], ["frame 104, step 30000, 34.4 dB"])
        gap = montage[:26, width + 6 : width + 8]  # the last columns of the first tile
        assert gap.min() == 250, width
