"""What the Tab key offers: names of presets and formats, and files of the right kind."""

import os
from collections.abc import Callable, Iterable
from pathlib import Path

from foldgauss.io.media.image_files import IMAGE_SUFFIXES
from foldgauss.io.media.video_writing import ANIMATION_SUFFIXES
from foldgauss.io.models.compact import COMPACT_SUFFIX
from foldgauss.io.models.video_model import MODEL_SUFFIX

Completion = Callable[[str], list[str]]

#: Names that clips have; what else OpenCV reads can be typed.
CLIP_SUFFIXES = (".mp4", ".webm", ".mov", ".mkv", ".avi", ".m4v", ".y4m", *ANIMATION_SUFFIXES, *IMAGE_SUFFIXES)


def among(choices: Iterable[str]) -> Completion:
    names = tuple(choices)

    def complete(incomplete: str) -> list[str]:
        return [name for name in names if name.startswith(incomplete)]

    return complete


def lists_of(choices: Iterable[str]) -> Completion:
    """Lists with commas, each name once."""
    names = tuple(choices)

    def complete(incomplete: str) -> list[str]:
        *before, last = incomplete.split(",")
        return [",".join([*before, name]) for name in names if name.startswith(last) and name not in before]

    return complete


def files(*suffixes: str) -> Completion:
    """Files with these endings, and folders, which may hold some."""

    def complete(incomplete: str) -> list[str]:
        found = _found(incomplete, suffixes)
        if len(found) == 1 and found[0].endswith(os.sep):  # or the shell would end the word here
            return _found(found[0], suffixes) or found
        return found

    return complete


def _found(incomplete: str, suffixes: tuple[str, ...]) -> list[str]:
    folder, start = os.path.split(incomplete)
    try:
        entries = sorted(Path(os.path.expanduser(folder) or ".").iterdir())
    except OSError:
        return []
    shown = [entry for entry in entries if entry.name.startswith(start) and (start or not entry.name.startswith("."))]
    written = [(os.path.join(folder, entry.name), entry) for entry in shown]
    folders = [f"{text}{os.sep}" for text, entry in written if entry.is_dir()]
    return folders + [text for text, entry in written if entry.suffix.lower() in suffixes and entry.is_file()]


model_files = files(MODEL_SUFFIX, COMPACT_SUFFIX)
clip_files = files(*CLIP_SUFFIXES)
