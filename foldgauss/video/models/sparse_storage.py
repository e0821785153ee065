"""Which parameters each Gaussian has, and the lossless form in which a model file stores them.

A Gaussian's *kind* is a byte: its degree, and a bit for each of two groups of parameters that it does without. A static
Gaussian has no m_t and sigma_t, an opaque one no opacity. Colors and sizes that many Gaussians share are stored once.
"""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Bool, Float, Float32, Int, UInt, UInt8

from foldgauss._runtime.checks import invalid, is_integer, short_repr
from foldgauss.envelope import TimeLikelihood
from foldgauss.video.models.row_layout import columns
from foldgauss.video.models.shared_paths import SharedPaths, check_paths
from foldgauss.video.models.splats import OPAQUE_LOGIT, STATIC_LOG_TIME_SCALE, FoldedSplats

#: Bits of a kind: static; opaque; and those of the degree.
STATIC_BIT, OPAQUE_BIT, DEGREE_MASK = 128, 64, 63
#: Parameters of a Gaussian of kind 0; of m_t and sigma_t, of the opacity, and of each power of the fold.
BASE_PARAMETERS, TIME_PARAMETERS, OPACITY_PARAMETERS, POWER_PARAMETERS = 11, 2, 1, 2
#: Leaves that a bit of the kind removes: the bit, and the value that the Gaussian then has.
_REMOVED = {
    "time_loc_logit": (STATIC_BIT, 0),
    "log_time_scale": (STATIC_BIT, STATIC_LOG_TIME_SCALE),
    "opacity_logit": (OPAQUE_BIT, OPAQUE_LOGIT),
}
#: Leaves whose rows may be shared: the leaf with each Gaussian's row number, and the name of the number of rows.
_SHARED = {"color_dc": ("color_index", "colors"), "log_scale": ("shape_index", "shapes")}
_INDEX_TYPES = (np.uint8, np.uint16, np.uint32)


def get_degrees(kinds: UInt8[np.ndarray, " num"]) -> Int[np.ndarray, " num"]:
    """The degree of each Gaussian's fold."""
    return (kinds & DEGREE_MASK).astype(int)


def is_static(kinds: UInt8[np.ndarray, " num"]) -> Bool[np.ndarray, " num"]:
    """Which Gaussians have no m_t and sigma_t."""
    return (kinds & STATIC_BIT) > 0


def is_opaque(kinds: UInt8[np.ndarray, " num"]) -> Bool[np.ndarray, " num"]:
    """Which Gaussians have no opacity."""
    return (kinds & OPAQUE_BIT) > 0


def find_kinds(rows: Float32[np.ndarray, "num width"], degree: int) -> UInt8[np.ndarray, " num"]:
    """The kinds of packed rows, from their values."""
    at, num = columns(degree), len(rows)
    nonzero = (rows[:, at["coefficients"]].reshape(num, degree, 2) != 0).any(2)
    last = np.max(nonzero * np.arange(1, degree + 1), axis=1, initial=0)
    static = rows[:, at["log_time_scale"].start] == STATIC_LOG_TIME_SCALE
    static &= rows[:, at["time_loc_logit"].start] == 0
    return _join_kinds(last, static, rows[:, at["opacity_logit"].start] == OPAQUE_LOGIT)


def find_initial_kinds(rows: Float32[np.ndarray, "num width"], degree: int) -> UInt8[np.ndarray, " num"]:
    """Kinds of rows before training, when coefficients are still 0: full degree, except for static Gaussians."""
    kinds = find_kinds(rows, degree)
    return np.where(is_static(kinds), kinds, degree).astype(np.uint8)


def count_parameters(kinds: UInt8[np.ndarray, " num"]) -> int:
    """The number of parameters of Gaussians of these kinds; shared ones count for each Gaussian."""
    saved = TIME_PARAMETERS * is_static(kinds) + OPACITY_PARAMETERS * is_opaque(kinds)
    return int((BASE_PARAMETERS + POWER_PARAMETERS * get_degrees(kinds) - saved).sum())


def clear_absent_moments(first: np.ndarray, second: np.ndarray, kinds: UInt8[np.ndarray, " num"], degree: int) -> None:
    """Set Adam's moments of parameters that a Gaussian does not have to 0, in place."""
    at = columns(degree)
    absent = np.repeat(np.arange(1, degree + 1), 2) > get_degrees(kinds)[:, None]
    for moments in (first, second):
        moments[:, at["coefficients"]][absent] = 0
        for name, (bit, _) in _REMOVED.items():
            moments[(kinds & bit) > 0, at[name].start] = 0


def _join_kinds(
    degrees: Int[np.ndarray, " num"], static: Bool[np.ndarray, " num"], opaque: Bool[np.ndarray, " num"]
) -> UInt8[np.ndarray, " num"]:
    return (degrees + STATIC_BIT * static + OPAQUE_BIT * opaque).astype(np.uint8)


class StoredSplats(eqx.Module):
    """The leaves of `FoldedSplats` without absent and repeated parameters; leaves not named here are the same.

    | leaf | shape | holds |
    |---|---|---|
    | `kinds` | (num,) or None | degree + 64 opaque + 128 static of each; None: the next four leaves are dense |
    | `coefficients` | (powers, 2) | c_1 to c_degree of the first Gaussian, then those of the second, and so on |
    | `time_loc_logit`, `log_time_scale` | (timed,) | those of the Gaussians that are not static |
    | `opacity_logit` | (clear,) | those of the Gaussians that are not opaque |
    | `color_index` | (num,) or None | each Gaussian's row of `color_dc`; None: rows are not shared |
    | `color_dc` | (colors, 3) | the distinct colors |
    | `shape_index`, `log_scale` | likewise, (shapes, 2) | the distinct pairs of standard deviations |

    `degree` is that of the dense leaf; no Gaussian need reach it.
    """

    loc: Float[Array, "num 2"]
    log_scale: Float[Array, "shapes 2"]
    angle_logit: Float[Array, " num"]
    time_loc_logit: Float[Array, " timed"]
    log_time_scale: Float[Array, " timed"]
    coefficients: Float[Array, "powers 2"] | Float[Array, "num degree 2"]
    opacity_logit: Float[Array, " clear"]
    color_dc: Float[Array, "colors 3"]
    envelope: TimeLikelihood
    kinds: UInt8[Array, " num"] | None
    color_index: UInt[Array, " num"] | None
    shape_index: UInt[Array, " num"] | None
    degree: int = eqx.field(static=True)
    path_index: UInt8[Array, " num"] | None = None
    paths: SharedPaths | None = None

    @property
    def num_gaussians(self) -> int:
        return self.loc.shape[0]


def to_stored(splats: FoldedSplats) -> FoldedSplats | StoredSplats:
    """The splats, whose values must be known, in the form with the fewest bytes; unchanged if nothing is saved.

    Kinds are used if they take fewer bytes than what they remove, and likewise the indices of shared rows.
    """
    if not _is_regular(splats):  # leaves of other shapes: the writer reports them
        return splats
    return _replace_leaves(splats, _by_kind(splats) | _by_index(splats))


def from_stored(splats: FoldedSplats | StoredSplats) -> FoldedSplats:
    """The inverse of `to_stored`; leaves that are put together again are JAX arrays.

    Raises ValueError for kinds and indices that do not fit the other leaves, whose shapes must be those of the class.
    """
    check_paths(splats)
    if isinstance(splats, FoldedSplats):
        return splats
    leaves = {name: getattr(splats, name) for name in _leaf_names()}
    if splats.kinds is not None:
        leaves |= _to_dense(splats)
    for name, (index, _) in _SHARED.items():
        if getattr(splats, index) is not None:
            leaves[name] = _look_up_rows(splats, name, index)
    return FoldedSplats(**leaves)


def stored_counts(splats: FoldedSplats | StoredSplats) -> dict[str, int]:
    """The row counts that `stored_skeleton` needs; empty for splats stored unchanged."""
    if isinstance(splats, FoldedSplats):
        return {}
    counts = {}
    if splats.kinds is not None:
        counts |= {"powers": splats.coefficients.shape[0], "timed": splats.log_time_scale.shape[0]}
        counts |= {"clear": splats.opacity_logit.shape[0]}
    for name, (index, rows) in _SHARED.items():
        if getattr(splats, index) is not None:
            counts |= {rows: getattr(splats, name).shape[0]}
    return counts


def stored_skeleton(
    splats: FoldedSplats,
    *,
    powers: int | None = None,
    timed: int | None = None,
    clear: int | None = None,
    colors: int | None = None,
    shapes: int | None = None,
) -> FoldedSplats | StoredSplats:
    """The stored form of splats of `jax.ShapeDtypeStruct`, whose leaves have these numbers of rows.

    Raises ValueError for numbers that no such form has.
    """
    num, leaves = splats.num_gaussians, {}
    if any(count is not None for count in (powers, timed, clear)):
        _check_count("degree", splats.degree, 0, DEGREE_MASK)
        _check_count("powers", powers, 0, num * splats.degree)
        _check_count("timed", timed, 0, num)
        clear = num if clear is None else clear  # older files have no opaque Gaussians
        _check_count("clear", clear, 0, num)
        leaves |= {"kinds": _shape(np.uint8, num), "coefficients": _shape(np.float32, powers, 2)}
        leaves |= {name: _shape(np.float32, timed) for name in ("time_loc_logit", "log_time_scale")}
        leaves |= {"opacity_logit": _shape(np.float32, clear)}
    for (name, (index, what)), rows in zip(_SHARED.items(), (colors, shapes), strict=True):
        if rows is not None:
            _check_count(what, rows, 1, min(num, 1 + np.iinfo(_INDEX_TYPES[-1]).max))
            width = getattr(splats, name).shape[1]
            leaves |= {name: _shape(np.float32, rows, width), index: _shape(_index_type(rows), num)}
    return _replace_leaves(splats, leaves)


def _is_regular(splats: FoldedSplats) -> bool:
    num = splats.num_gaussians
    shapes = {"coefficients": (num, splats.degree, 2), "color_dc": (num, 3), "log_scale": (num, 2)}
    shapes |= dict.fromkeys(_REMOVED, (num,))
    return all(np.shape(getattr(splats, name)) == shape for name, shape in shapes.items())


def _by_kind(splats: FoldedSplats) -> dict[str, np.ndarray]:
    """The kinds and the leaves that they shorten; empty if that saves nothing."""
    if splats.degree > DEGREE_MASK:
        return {}
    kinds = _join_kinds(splats.degrees, splats.static, splats.opaque)
    leaves = {name: np.asarray(getattr(splats, name)) for name in ("coefficients", *_REMOVED)}
    short = {name: leaves[name][(kinds & bit) == 0] for name, (bit, _) in _REMOVED.items()}
    short |= {"coefficients": leaves["coefficients"][_has_power(get_degrees(kinds), splats.degree)], "kinds": kinds}
    return short if _num_bytes(short) < _num_bytes(leaves) else {}


def _to_dense(splats: StoredSplats) -> dict[str, Array]:
    """The leaves that kinds shortened, at full length."""
    degrees = _check_kinds(splats)
    kinds, num, rows = np.asarray(splats.kinds), splats.num_gaussians, np.asarray(splats.coefficients)
    coefficients = np.zeros((num, splats.degree, 2), rows.dtype)
    coefficients[_has_power(degrees, splats.degree)] = rows
    # device_put: jnp.asarray would compile a program for every shape.
    leaves = {"coefficients": jax.device_put(coefficients)}
    for name, (bit, value) in _REMOVED.items():
        kept = np.asarray(getattr(splats, name))
        leaf = np.full(num, value, kept.dtype)
        leaf[(kinds & bit) == 0] = kept
        leaves[name] = jax.device_put(leaf)
    return leaves


def _check_kinds(splats: StoredSplats) -> Int[np.ndarray, " num"]:
    """The degrees. Raises ValueError for kinds that do not fit the numbers of rows."""
    kinds = np.asarray(splats.kinds)
    degrees = get_degrees(kinds)
    _check_count("the greatest degree in kinds", int(degrees.max(initial=0)), 0, splats.degree)
    for what, count, leaf in (
        ("powers", degrees.sum(), splats.coefficients),
        ("Gaussians that are not static", (~is_static(kinds)).sum(), splats.log_time_scale),
        ("Gaussians that are not opaque", (~is_opaque(kinds)).sum(), splats.opacity_logit),
    ):
        if count != len(leaf):
            raise invalid("kinds", expected=f"{len(leaf):,} {what}, as many as are stored", got=f"{count:,}")
    return degrees


def _has_power(degrees: Int[np.ndarray, " num"], degree: int) -> Bool[np.ndarray, "num degree"]:
    return np.arange(degree) < degrees[:, None]


def _by_index(splats: FoldedSplats) -> dict[str, np.ndarray]:
    """The distinct rows and their indices, of each leaf for which that saves bytes."""
    leaves = {}
    for name, (index_name, _) in _SHARED.items():
        own = np.ascontiguousarray(getattr(splats, name))
        bits = own.view(np.dtype((np.void, own.dtype.itemsize * own.shape[1]))).ravel()  # keeps 0 and -0 apart
        found, index = np.unique(bits, return_inverse=True)
        shared = {name: found.view(own.dtype).reshape(-1, own.shape[1])}
        shared |= {index_name: index.astype(_index_type(len(found)))}
        leaves |= shared if _num_bytes(shared) < own.nbytes else {}
    return leaves


def _look_up_rows(splats: StoredSplats, name: str, index_name: str) -> Float[Array, "num width"]:
    index, rows = np.asarray(getattr(splats, index_name)), np.asarray(getattr(splats, name))
    _check_count(f"the greatest {index_name}", int(index.max(initial=0)), 0, len(rows) - 1)
    return jax.device_put(rows[index])


def _index_type(num: int) -> type:
    """The smallest unsigned type for indices below `num`."""
    return next(dtype for dtype in _INDEX_TYPES if num - 1 <= np.iinfo(dtype).max)


def _replace_leaves(splats: FoldedSplats, leaves: dict[str, Any]) -> FoldedSplats | StoredSplats:
    """The stored form with `leaves` in place of the splats' own; the splats themselves if there are none."""
    if not leaves:
        return splats
    form = {name: getattr(splats, name) for name in _leaf_names()}
    form |= dict.fromkeys(("kinds", "color_index", "shape_index"))
    return StoredSplats(**(form | leaves), degree=splats.degree)


def _leaf_names() -> list[str]:
    return [field.name for field in dataclasses.fields(FoldedSplats)]


def _shape(dtype: type, *shape: int) -> jax.ShapeDtypeStruct:
    return jax.ShapeDtypeStruct(shape, dtype)


def _num_bytes(leaves: dict[str, np.ndarray]) -> int:
    return sum(leaf.nbytes for leaf in leaves.values())


def _check_count(name: str, value: object, least: int, most: int) -> None:
    if not is_integer(value, least) or value > most:
        raise invalid(name, expected=f"a whole number from {least} to {most:,}", got=short_repr(value))
