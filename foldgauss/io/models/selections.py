"""Selections as text: indices of Gaussians, in numbers and ranges whose ends are included, as "3,17,40-52"."""

import re
from collections.abc import Iterator

import numpy as np

from foldgauss._runtime.checks import require
from foldgauss.video.selection.selectors import Selection

_INDEX_RANGE = re.compile(r"\s*([0-9]{1,9})(?:-([0-9]{1,9}))?\s*")


def format_indices(selection: Selection) -> str:
    """The indices of a selection as text, "3,17,40-52". Edit scripts take it as `indices`.

    **Example:** `Path("ball.txt").write_text(format_indices(ball))`.
    """
    edges = np.flatnonzero(np.diff(np.r_[False, selection.mask, False].astype(np.int8)))
    ends = zip(edges[::2], edges[1::2] - 1, strict=True)
    return ",".join(f"{first}" if first == last else f"{first}-{last}" for first, last in ends)


def parse_indices(text: str, num_gaussians: int) -> Selection:
    """The selection, of `num_gaussians`, that a text of numbers and ranges describes, as "3,17,40-52".

    **Raises:** ValueError for another text, and for indices that the model does not have.

    **Example:** `parse_indices(Path("ball.txt").read_text(), model.num_gaussians)`.
    """
    mask = np.zeros(num_gaussians, bool)
    for first, last in parse_ranges(text):
        require(
            last < num_gaussians,
            "indices",
            expected=f"Gaussians from 0 to {num_gaussians - 1:,}",
            got=f"{last:,}",
            cure="Is it another model's script?",
        )
        mask[first : last + 1] = True
    return Selection(mask)


def parse_ranges(text: str) -> Iterator[tuple[int, int]]:
    """The first and the last index of each range in a text of `parse_indices`; ValueError for another text."""
    for part in text.split(","):
        found = _INDEX_RANGE.fullmatch(part)
        first, last = (int(found[1]), int(found[2] or found[1])) if found else (0, -1)
        require(last >= first, "indices", expected='numbers and ranges, as "3,17,40-52"', got=repr(part[:40]))
        yield first, last
