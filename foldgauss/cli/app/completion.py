"""Shell completion of option values: choices, and files by suffix."""

import os
from collections.abc import Callable, Iterable
from pathlib import Path

from foldgauss.io.media.images import IMAGE_SUFFIXES
from foldgauss.io.media.writing import ANIMATION_SUFFIXES
from foldgauss.io.models.compact import COMPACT_SUFFIX
from foldgauss.io.models.video_model import MODEL_SUFFIX

Completion = Callable[[str], list[str]]

#: Suffixes of clips that are completed; others that are read can be typed.
CLIP_SUFFIXES = (".mp4", ".webm", ".mov", ".mkv", ".avi", ".m4v", ".y4m", *ANIMATION_SUFFIXES, *IMAGE_SUFFIXES)


def complete_choice(choices: Iterable[str]) -> Completion:
    """Completes one of the choices."""
    names = tuple(choices)

    def complete(incomplete: str) -> list[str]:
        return [name for name in names if name.startswith(incomplete)]

    return complete


def complete_files(*suffixes: str) -> Completion:
    """Completes files with these suffixes, and folders."""

    def complete(incomplete: str) -> list[str]:
        found = _find_files(incomplete, suffixes)
        if len(found) == 1 and found[0].endswith(os.sep):  # otherwise the shell ends the word here
            return _find_files(found[0], suffixes) or found
        return found

    return complete


def _find_files(incomplete: str, suffixes: tuple[str, ...]) -> list[str]:
    folder, start = os.path.split(incomplete)
    try:
        entries = sorted(Path(os.path.expanduser(folder) or ".").iterdir())
    except OSError:
        return []
    shown = [entry for entry in entries if entry.name.startswith(start) and (start or not entry.name.startswith("."))]
    written = [(os.path.join(folder, entry.name), entry) for entry in shown]
    folders = [f"{text}{os.sep}" for text, entry in written if entry.is_dir()]
    return folders + [text for text, entry in written if entry.suffix.lower() in suffixes and entry.is_file()]


complete_models = complete_files(MODEL_SUFFIX, COMPACT_SUFFIX)
complete_clips = complete_files(*CLIP_SUFFIXES)
