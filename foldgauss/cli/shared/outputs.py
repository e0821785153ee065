"""Outputs: default names, and checks before any work is done."""

import os
from collections.abc import Collection, Mapping
from pathlib import Path

from foldgauss._runtime.checks import ParameterError, invalid, require
from foldgauss.io._atomic import check_replaceable, check_writable, resolve
from foldgauss.io.media.images import IMAGE_SUFFIXES
from foldgauss.io.media.reading import memory_limit
from foldgauss.io.media.writing import ANIMATION_SUFFIXES, FRAME_NAMES, VIDEO_SUFFIXES

IMAGE_SUFFIX = ".png"


def name_after(source: Path, ending: str) -> Path:
    """The default name of an output: in the current folder, after its source."""
    whole = source if source.name not in ("", "..") else resolve(source)
    return Path(f"{whole.name if whole.is_dir() else whole.stem}{ending}")


def refuse_huge(size: tuple[int, int] | None) -> None:
    """Refuse images that do not fit in memory: several copies are held in floating point."""
    if size is None:
        return
    got = f"{size[0]}x{size[1]}"
    fits = 64 * size[0] * size[1] <= memory_limit()
    require(fits, "--size", expected="an image that fits in memory", got=got, cure="Choose a smaller one.")


def refuse_existing(path: Path, overwrite: bool, option: str = "--out") -> None:
    if os.path.exists(path) and not overwrite:
        raise ParameterError(option, f"{path} exists. Choose another path, or add --overwrite.")


def refuse_inputs(path: Path, inputs: Mapping[str, Path | None], option: str = "--out") -> None:
    """Refuse an output in place of one of the command's `inputs` by name, of an image in a folder that is one, or of a
    folder that holds one."""
    for what, source in inputs.items():
        if source is None or not os.path.exists(source):
            continue
        # os.path: a name that is too long does not exist here; creating the file reports it.
        is_source = os.path.exists(path) and path.samefile(source)
        require(
            path.suffix.lower() not in IMAGE_SUFFIXES or resolve(path.parent) != resolve(source),
            option,
            expected=f"a place outside the {what}'s folder",
            got=path,
            cure="It would be one of its images.",
        )
        require(
            not is_source and resolve(path) not in resolve(source).parents,
            option,
            expected=f"another path than the {what}",
            got=path,
            cure="Inputs are never replaced.",
        )


def check_output(path: Path, overwrite: bool, inputs: Mapping[str, Path | None], option: str = "--out") -> None:
    """Refuse an output file that could not be written, or that is one of the `inputs`."""
    refuse_inputs(path, inputs, option)
    refuse_existing(path, overwrite, option)
    check_writable(path)


def check_images_output(
    path: Path,
    overwrite: bool,
    inputs: Mapping[str, Path | None],
    option: str = "--out",
    *,
    others: Collection[str] = (),
) -> None:
    """Refuse a name that images cannot be written to, unless its suffix is one of `others`, and as `check_output`."""
    wanted = (*others, *VIDEO_SUFFIXES, *ANIMATION_SUFFIXES)
    if path.suffix and not path.is_dir() and path.suffix.lower() not in wanted:
        is_image = path.suffix.lower() == IMAGE_SUFFIX
        cure = "One image of a model: foldgauss render MODEL --times T --out FILE.png." if is_image else ""
        raise invalid(option, expected=", ".join(wanted) + ", or a folder without extension", got=path, cure=cure)
    refuse_inputs(path, inputs, option)
    if not path.is_dir() or any(path.iterdir()):
        refuse_existing(path, overwrite, option)
    if path.is_dir() or not path.suffix:
        check_replaceable(path, overwrite, pattern=FRAME_NAMES)
    if not path.is_dir():
        check_writable(path)


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
    foreign, expected = sorted(names - set(own)), f"a new folder or one that a {command} wrote"
    if foreign:
        raise invalid(
            "--out", expected=expected, got=f"{folder} with {foreign[0]!r} in it", cure="Choose another folder."
        )
    if names and not known:
        raise invalid(
            "--out",
            expected=expected,
            got=f"{folder} with {min(names)!r} in it, but no {record} of a {command}",
            cure=f"Choose another folder{cure}.",
        )


def make_folder(path: Path) -> None:
    """Create the folder of outputs if needed. Raises ParameterError or OutputError if it cannot be written to."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise invalid(
            "--out", expected="a folder that can be created", got=f"{path} ({error.strerror})", cure="Choose another."
        ) from error
    check_writable(path / "model.safetensors")
