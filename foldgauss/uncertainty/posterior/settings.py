"""Settings of the sampler: validation and defaults."""

import copy
import dataclasses
import importlib.metadata
import os
import re
from pathlib import Path
from typing import Any

from foldgauss._runtime.checks import check_signature, invalid, is_integer, is_within, short_repr
from foldgauss.uncertainty.posterior.draws_file import read_fingerprint
from foldgauss.uncertainty.posterior.optional_imports import import_optional

#: Steps per kept step.
THIN = 10
#: With up to this many free frames emcee's own moves update all at once, beside blocks; with more, only blocks move.
AT_ONCE = 12
#: Frames in a block of `BlockSweep`. Walkers must be at least twice as many.
BLOCK = 6


@dataclasses.dataclass(frozen=True)
class SamplerSettings:
    """Validated settings; `moves` None: the default moves."""

    walkers: int
    seed: int
    ensembles: int
    thin_by: int
    moves: list[tuple[Any, float]] | None
    backend: Path | None


def check_settings(
    num_free: int,
    walkers: int | None = None,
    *,
    ensembles: int = 4,
    steps: int | None = None,
    thin_by: int = THIN,
    together: bool = False,
) -> int:
    """Validate settings for `num_free` free frames; returns the number of walkers or its default.

    `together`: all frames move at once. Raises ValueError as `frame_time_posterior` does.
    """
    at_once = num_free if together or num_free <= AT_ONCE else BLOCK
    found = max(32, 4 * at_once) if walkers is None else walkers
    if not is_integer(found, max(2 * at_once, 4)) or found % 2:
        expected = f"an even number, at least {max(2 * at_once, 4)}: twice the frames that move at once"
        cure = "Leave it out, or choose fewer frames."
        raise invalid("walkers", expected=expected, got=short_repr(walkers), cure=cure)
    if not is_integer(ensembles, 2):
        expected = "at least 2 (a whole number), better 4: R-hat compares them"
        raise invalid("ensembles", expected=expected, got=short_repr(ensembles))
    if not is_integer(thin_by, 1):
        raise invalid("thin_by", expected="a whole number >= 1", got=short_repr(thin_by))
    if steps is not None and not is_integer(steps, int(thin_by)):
        raise invalid("steps", expected=f"at least thin_by = {thin_by}, a whole number", got=short_repr(steps))
    return int(found)


def check_seed(seed: int) -> int:
    if not is_integer(seed, 0):
        raise invalid("seed", expected="a whole number >= 0", got=short_repr(seed))
    return int(seed)


def check_moves(moves) -> list[tuple[Any, float]] | None:
    """Copies of moves with their weights, from any form that `emcee.EnsembleSampler` accepts; None stays None."""
    if moves is None:
        return None
    expected = "an emcee move, a list of moves, or a list of (move, weight)"
    if _is_move(moves):
        pairs = [(moves, 1.0)]
    elif isinstance(moves, list | tuple) and moves and all(map(_is_move, moves)):
        pairs = [(move, 1.0) for move in moves]
    elif isinstance(moves, list | tuple) and moves and all(map(_is_weighted, moves)):
        pairs = [(move, float(weight)) for move, weight in moves]
    else:
        cure = "Pass an instance, not the class: `StretchMove()`." if "class" in repr(moves) else ""
        raise invalid("moves", expected=expected, got=short_repr(moves), cure=cure)
    if not sum(weight for _, weight in pairs) > 0:
        raise invalid("moves", expected="weights of which one is above 0", got=[weight for _, weight in pairs])
    if any(type(move).__name__ == "DESnookerMove" for move, _ in pairs) and _version("emcee") < (3, 1, 7):
        cure = "Its proposals are scaled wrongly (emcee pull request 531): use DEMove, or a later emcee."
        expected = "moves that leave the posterior invariant"
        raise invalid("moves", expected=expected, got="DESnookerMove of emcee 3.1", cure=cure)
    # Copies, since a move stores state of its run in itself.
    return [(copy.copy(move), weight) for move, weight in pairs]


def _is_move(value) -> bool:
    return callable(getattr(value, "propose", None)) and not isinstance(value, type)


def _is_weighted(value) -> bool:
    return (
        isinstance(value, list | tuple) and len(value) == 2 and _is_move(value[0]) and is_within(value[1], "[0, inf)")
    )


def _version(name: str) -> tuple[int, ...]:
    return tuple(int(part) for part in re.findall(r"\d+", importlib.metadata.version(name))[:3])


def check_backend(backend) -> Path | None:
    """A path that can be written; whether it is a file of the same run is checked later."""
    if backend is None:
        return None
    import_optional("h5py")
    if not isinstance(backend, str | os.PathLike) or not os.fspath(backend):
        raise invalid("backend", expected="the path of an HDF5 file, or None", got=short_repr(backend))
    path = Path(backend)
    if not path.parent.is_dir():
        cure = "Make the folder first."
        raise invalid("backend", expected="a file in a folder that exists", got=str(path), cure=cure)
    if path.is_dir():
        raise invalid("backend", expected="a file", got=f"the folder {path}")
    if not os.access(path.parent, os.W_OK):
        raise invalid("backend", expected="a folder that can be written to", got=str(path.parent))
    if path.exists():
        read_fingerprint(path)
    return path


def check_progress(progress) -> None:
    if progress is None or isinstance(progress, bool):
        return
    if not callable(progress):
        raise invalid("progress", expected="True, False or a function", got=short_repr(progress))
    check_signature("progress", progress, "what", "done", "total")
