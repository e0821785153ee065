"""Outputs: default names, checks before any work is done, and writing of results that took long."""

import os
import sys
from collections.abc import Callable, Collection, Mapping
from pathlib import Path

import typer

from foldgauss.cli.app.application import WrongUse, err, wrong_use
from foldgauss.io._atomic import OutputError, Result, check_replaceable, check_writable, resolve, write_or_keep
from foldgauss.io.media.images import IMAGE_SUFFIXES
from foldgauss.io.media.reading import memory_limit
from foldgauss.io.media.writing import ANIMATION_SUFFIXES, FRAME_NAMES, VIDEO_SUFFIXES

IMAGE_SUFFIX = ".png"


def name_after(source: Path, ending: str) -> Path:
    """The default name of an output: in the current folder, after its source."""
    whole = source if source.name not in ("", "..") else resolve(source)
    return Path(f"{whole.name if whole.is_dir() else whole.stem}{ending}")


def refuse_huge(size: tuple[int, int] | None, option: str = "--size") -> None:
    """Refuse images that do not fit in memory: several copies are held in floating point."""
    if size is not None and 64 * size[0] * size[1] > memory_limit():
        raise WrongUse(
            f"{option}: expected an image that fits in memory, got {size[0]}x{size[1]}. Choose a smaller one."
        )


def refuse_existing(path: Path, overwrite: bool, option: str = "--out") -> None:
    if os.path.exists(path) and not overwrite:
        raise WrongUse(f"{option}: {path} exists. Choose another path, or add --overwrite.")


def refuse_inputs(path: Path, inputs: Mapping[str, Path | None], option: str = "--out") -> None:
    """Refuse an output in place of one of the command's `inputs` by name, of an image in a folder that is one, or of a
    folder that holds one."""
    for what, source in inputs.items():
        # os.path: a name that is too long does not exist here; creating the file reports it.
        if source is None or not (os.path.exists(path) and os.path.exists(source)):
            continue
        into = path.suffix.lower() in IMAGE_SUFFIXES and path.parent.samefile(source)
        if into or path.samefile(source) or resolve(path) in resolve(source).parents:
            raise WrongUse(f"{option}: expected another path than the {what}, got {path}. Inputs are never replaced.")


def check_images_output(path: Path, inputs: Mapping[str, Path | None], overwrite: bool, option: str = "--out") -> None:
    """Refuse a video, an image or a folder of frames that could not be written, or that is one of the `inputs`."""
    refuse_inputs(path, inputs, option)
    if not path.is_dir():
        refuse_existing(path, overwrite, option)
        if not path.suffix:
            check_replaceable(path, overwrite, pattern=FRAME_NAMES)
        check_writable(path)
    elif any(path.iterdir()):
        refuse_existing(path, overwrite, option)
        check_replaceable(path, overwrite, pattern=FRAME_NAMES)


def refuse_foreign(
    folder: Path, own: Collection[str], command: str, *, record: str, known: bool, cure: str = ""
) -> None:
    """Refuse a folder with files other than the command's `own`, which it replaces.

    Files with the names of its own are the command's if its `record` is valid, which `known` states.
    """
    try:
        names = {entry.name for entry in folder.iterdir() if not entry.name.startswith(".")}
    except OSError:  # missing or not a folder, which creating it reports
        return
    foreign, expected = sorted(names - set(own)), f"--out: expected a new folder or one that a {command} wrote"
    if foreign:
        raise WrongUse(f"{expected}, got {folder} with {foreign[0]!r} in it. Choose another folder.")
    if names and not known:
        got = f"{folder} with {min(names)!r} in it, but no {record} of a {command}"
        raise WrongUse(f"{expected}, got {got}. Choose another folder{cure}.")


def check_image_path(path: Path, *, others: str = "", single: bool = False) -> None:
    """Refuse a name that images cannot be written to; with `single`, FILE.png is valid, for one image."""
    wanted = (*VIDEO_SUFFIXES, *ANIMATION_SUFFIXES, *([IMAGE_SUFFIX] if single else []))
    if path.suffix and not path.is_dir() and path.suffix.lower() not in wanted:
        expected = ", ".join((others, *wanted) if others else wanted) + ", or a folder without extension"
        is_image = path.suffix.lower() == IMAGE_SUFFIX
        cure = "One image of a model: foldgauss render MODEL --times T --out FILE.png." if is_image else ""
        raise wrong_use("--out", expected=expected, got=path, cure=cure)


def make_folder(path: Path) -> None:
    """Create the folder of outputs if needed. Raises OutputError if files cannot be written there."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"--out: cannot create the folder {path} ({error.strerror}). Choose another.") from error
    check_writable(path / "model.safetensors")


def write_result(path: Path, write: Callable[[Path], Result]) -> Result:
    """Write the result of long work by `write(path)`, which is called again with another path if that fails: one from
    the user, where there is a terminal, then one in the folder for temporary files. Raises as `write_or_keep`.
    """
    return write_or_keep(path, write, ask_output)


def ask_output(path: Path, error: OSError) -> Path | None:
    """Another path for an output, from the user; None without a terminal or an answer, and for one that exists.

    A folder, or an answer of another suffix than `path`, becomes the folder of the output.
    """
    if sys.stdin is None or not sys.stdin.isatty():
        return None
    err.print(f"error: {error}", style="red", soft_wrap=True)
    try:
        answer = typer.prompt("Another path for it (Enter: a temporary folder)", "", show_default=False, err=True)
    except typer.Abort:
        return None
    if not answer.strip():
        return None
    another = Path(answer.strip()).expanduser()
    if another.suffix.lower() != path.suffix.lower() or another.is_dir():
        another = another / path.name
    try:
        refuse_existing(another, overwrite=False)
    except WrongUse as refusal:
        err.print(f"error: {refusal}", style="red", soft_wrap=True)
        return None
    return another
