"""The order of a model's Gaussians in a compact file, and the chunks that they are divided into.

A chunk is decoded by itself. The first holds the Gaussians that are largest in space and time, which show a coarse
clip. A layer of smaller ones in front of it, and a layer of the smallest, are divided in time: a chunk of those that
are visible around the middle of an interval, and the same again for those before and those after. A reader needs no
chunk for a time at which none of its Gaussians is visible.
"""

import numpy as np
from jaxtyping import Float, Int

from foldgauss.video.compression.quantize import MAX_CHUNKS, clamp_unit, compute_columns, find_cells, select_rows
from foldgauss.video.compression.sort_order import find_overlaps, sort_by_cell
from foldgauss.video.models.splats import TAU_MAX
from foldgauss.video.models.video_model import VideoModel
from foldgauss.video.selection.contributions import Contributions

#: The fractions of the Gaussians after which a layer ends: the first is about a tenth of a file.
LAYERS = (0.08, 0.4)
#: Least number of Gaussians of a file for each of its chunks. A chunk takes some 800 bytes more than if it were a part
#: of another, since its coder starts anew: at most 3% of the file.
LEAST = 2500
#: Most chunks, so that large models stay within the format's `MAX_CHUNKS`.
_MOST = MAX_CHUNKS // 2
#: From a layer to the next, numbers of chunks grow by this.
_STRIDE = MAX_CHUNKS


def arrange(
    model: VideoModel, budget: float, *, layered: bool = True
) -> tuple[Int[np.ndarray, " num"], Int[np.ndarray, " num"]]:
    """An order of the Gaussians that needs few bits, and in this order the number of the chunk of each.

    Within a chunk they are sorted by cell; see `sort_by_cell` for the `budget` of errors. Layers change the images:
    the large ones go behind the small ones. Without layers there is one chunk.
    """
    exact = compute_columns(model)
    chunks = np.zeros(model.num_gaussians, np.int64)
    if layered:
        first, last = visible_spans(exact.values["time"], exact.values["duration"])
        chunks = divide(find_layers(2 * exact.values["size"] + np.log(last - first)), first, last)
    cells = np.zeros(len(chunks), np.int32)
    for number in np.unique(chunks):  # a chunk of fewer Gaussians has fewer cells
        cells[chunks == number] = find_cells(select_rows(exact, chunks == number))
    if model.compositing == "sum":  # any order gives the same image
        order = np.lexsort((cells, -chunks))
        return order, chunks[order]
    front, back, cost = find_overlaps(Contributions(model))
    parts = []
    for number in np.unique(chunks)[::-1]:
        rows = np.flatnonzero(chunks == number)
        within = (chunks[front] == number) & (chunks[back] == number)
        place = np.zeros(len(chunks), np.int64)
        place[rows] = np.arange(len(rows))
        overlaps = place[front[within]], place[back[within]], cost[within]
        parts.append(rows[sort_by_cell(cells[rows], overlaps, budget * len(rows) / len(chunks))])
    order = np.concatenate(parts)
    return order, chunks[order]


def divide_anew(model: VideoModel, chunks: Int[np.ndarray, " num"]) -> tuple[Int[np.ndarray, " num"], ...]:
    """As `arrange`, from an order that it gave, where only the visible spans have changed: few Gaussians move."""
    values = compute_columns(model).values
    chunks = divide(chunks.astype(np.int64) // _STRIDE, *visible_spans(values["time"], values["duration"]))
    order = np.argsort(-chunks, kind="stable")
    return order, chunks[order]


def visible_spans(
    time: Float[np.ndarray, " num"], duration: Float[np.ndarray, " num"]
) -> tuple[Float[np.ndarray, " num"], Float[np.ndarray, " num"]]:
    """The first and the last time, in [0, 1], at which each Gaussian is visible, at most; the first is smaller."""
    time, reach = clamp_unit(time), TAU_MAX * np.exp(np.minimum(duration, 1.0))
    first, last = np.clip(time - reach, 0.0, 1.0), np.clip(time + reach, 0.0, 1.0)
    return first, np.maximum(last, first + 1e-9)


def find_layers(volume: Float[np.ndarray, " num"]) -> Int[np.ndarray, " num"]:
    """The layer of each Gaussian by its volume, 0 for the largest."""
    num = len(volume)
    ends = [round(fraction * num) for fraction in LAYERS[: max(num // LEAST - 1, 0)]]
    rank = np.empty(num, np.int64)
    rank[np.argsort(-volume, kind="stable")] = np.arange(num)
    return np.searchsorted(ends, rank, side="right")


def divide(
    layer: Int[np.ndarray, " num"], first: Float[np.ndarray, " num"], last: Float[np.ndarray, " num"]
) -> Int[np.ndarray, " num"]:
    """The number of each Gaussian's chunk, in the order of the file: `_STRIDE` times its layer and more."""
    out, least = np.zeros(len(layer), np.int64), max(LEAST, len(layer) // _MOST)
    for number in np.unique(layer):
        rows = np.flatnonzero(layer == number)
        groups = _divide_in_time(rows, first, last, (0.0, 1.0), least) if number else [rows]
        for place, group in enumerate(groups):
            out[group] = number * _STRIDE + place
    return out


def _divide_in_time(
    rows: Int[np.ndarray, " some"],
    first: Float[np.ndarray, " num"],
    last: Float[np.ndarray, " num"],
    interval: tuple[float, float],
    least: int,
) -> list[Int[np.ndarray, " few"]]:
    """Those visible around the middle of an interval of time, then those before and those after, divided alike.

    A part with fewer than `least` Gaussians is not divided off.
    """
    low, high = interval
    middle = (low + high) / 2
    before, after = rows[last[rows] < middle], rows[first[rows] > middle]
    around = rows[(last[rows] >= middle) & (first[rows] <= middle)]
    if min(map(len, (before, around, after))) < least:
        return [rows]
    earlier = _divide_in_time(before, first, last, (low, middle), least)
    return [around, *earlier, *_divide_in_time(after, first, last, (middle, high), least)]
