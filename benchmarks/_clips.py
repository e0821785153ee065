"""Clips by name for benchmarks over several: the sample clips, and the subfolders of a folder of clips."""

from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

from foldgauss.io import Clip, read_video
from foldgauss.io.datasets import sample_clip
from foldgauss.io.media.images import image_paths

#: The sample clips, and the size that each is fitted at; None: that of its file.
SAMPLE_SIZES: dict[str, tuple[int, int] | None] = {"bunny": (640, 1280), "bikes": None, "carphone": None}
#: Images that a subfolder must have to be a clip.
MIN_FRAMES = 2


class ClipSource(NamedTuple):
    """A clip that is not read yet. `size`: (height, width), None for its own; `frames`: only the first so many."""

    name: str
    path: Path
    size: tuple[int, int] | None = None
    frames: int | None = None

    def read(self) -> Clip:
        return read_video(self.path, size=self.size, frames=None if self.frames is None else (0, self.frames))

    def describe(self) -> dict[str, object]:
        """What the clip is known by in a file of results: without folders, which differ between machines."""
        files = image_paths(self.path) if self.path.is_dir() else [self.path]
        known = {"num_files": len(files), "bytes": sum(file.stat().st_size for file in files)}
        return {"name": self.name, "size": self.size, "frames": self.frames, **known}


def clip_path(name: str) -> Path:
    """The file of a sample clip, or a path as it is given."""
    return sample_clip(name) if name in SAMPLE_SIZES else Path(name)


def sample_sources(names: Iterable[str]) -> list[ClipSource]:
    return [ClipSource(name, sample_clip(name), SAMPLE_SIZES[name]) for name in names]


def folder_sources(folder: Path) -> list[ClipSource]:
    """The subfolders of `folder` as clips, by name. Raises SystemExit that says what is missing."""
    folder = folder.expanduser()
    if not folder.is_dir():
        raise SystemExit(f"--clips: expected a folder whose subfolders are clips, {folder} is not a folder.")
    places = sorted(entry for entry in folder.iterdir() if entry.is_dir() and not entry.name.startswith("."))
    if not places:
        raise SystemExit(f"--clips: expected a folder whose subfolders are clips, {folder} has no subfolder.")
    lacking = [f"{place.name} has {num}" for place in places if (num := len(image_paths(place))) < MIN_FRAMES]
    if lacking:
        raise SystemExit(f"--clips: expected at least {MIN_FRAMES} images in each of {folder}: {', '.join(lacking)}.")
    return [ClipSource(place.name, place) for place in places]
