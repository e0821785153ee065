"""What is stored of a model's Gaussians: of each what it has, and a colour that many share once. Exact to the bit."""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Bool, Float, Int, UInt, UInt8

from foldgauss._runtime.checks import invalid, is_integer, short_repr
from foldgauss.envelope import TimeLikelihood
from foldgauss.video.models.kinds import DEGREES, LASTS, SOLID, degrees_of, is_solid, lasts
from foldgauss.video.models.splats import LASTING, OPAQUE, FoldedSplats

_INDEX_TYPES = (np.uint8, np.uint16, np.uint32)
#: Leaves of which many Gaussians may have one and the same row: where the index of each one's is, what rows are called.
_SHARED = {"color_dc": ("color_index", "colors"), "log_scale": ("shape_index", "shapes")}

#: Leaves that a bit of its kind says a Gaussian does not have: the bit, and what it has instead.
_LEFT_OUT = {"time_loc_logit": (LASTS, 0), "log_time_scale": (LASTS, LASTING), "opacity_logit": (SOLID, OPAQUE)}


class StoredSplats(eqx.Module):
    """The leaves of `FoldedSplats` less what `kinds` and the indices tell; leaves not named here are the same.

    | leaf | shape | holds |
    |---|---|---|
    | `kinds` | (num,) or None | degree + 64 solid + 128 lasting of each; None: the next four leaves are whole |
    | `coefficients` | (powers, 2) | c_1 to c_degree of the first Gaussian, then those of the second, and so on |
    | `time_loc_logit`, `log_time_scale` | (timed,) | those of the Gaussians that do not last |
    | `opacity_logit` | (clear,) | those of the Gaussians that light comes through |
    | `color_index` | (num,) or None | the row of `color_dc` that is the Gaussian's; None: each has its own |
    | `color_dc` | (colors, 3) | the colours that there are |
    | `shape_index`, `log_scale` | likewise, (shapes, 2) | the pairs of standard deviations |

    `degree` is that of the dense leaf, which no Gaussian need have.
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

    @property
    def num_gaussians(self) -> int:
        return self.loc.shape[0]


def to_stored(splats: FoldedSplats) -> FoldedSplats | StoredSplats:
    """The splats, whose values must be known, in the form of fewest bytes: themselves where nothing is gained.

    There are kinds where they take fewer bytes than what they leave out, and shared colours and shapes likewise.
    """
    if not _is_regular(splats):  # no form has a place for such leaves: who writes them says so
        return splats
    return _changed(splats, _by_kind(splats) | _by_index(splats))


def from_stored(splats: FoldedSplats | StoredSplats) -> FoldedSplats:
    """The inverse of `to_stored`; leaves that were put together again are JAX arrays.

    Raises ValueError for kinds and indices that do not fit the other leaves, whose shapes must be those of the class.
    """
    if isinstance(splats, FoldedSplats):
        return splats
    leaves = {name: getattr(splats, name) for name in _leaf_names()}
    if splats.kinds is not None:
        leaves |= _dense(splats)
    for name, (index, _) in _SHARED.items():
        if getattr(splats, index) is not None:
            leaves[name] = _own_rows(splats, name, index)
    return FoldedSplats(**leaves)


def stored_counts(splats: FoldedSplats | StoredSplats) -> dict[str, int]:
    """The numbers of rows that `stored_skeleton` needs; empty for splats that are stored as they are."""
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
    """The stored form of splats of shapes only (`jax.ShapeDtypeStruct`), with the numbers of rows of its leaves.

    Raises ValueError for numbers that no such form has.
    """
    num, leaves = splats.num_gaussians, {}
    if any(count is not None for count in (powers, timed, clear)):
        _check_count("degree", splats.degree, 0, DEGREES)
        _check_count("powers", powers, 0, num * splats.degree)
        _check_count("timed", timed, 0, num)
        clear = num if clear is None else clear  # files from before there were solid ones
        _check_count("clear", clear, 0, num)
        leaves |= {"kinds": _shape(np.uint8, num), "coefficients": _shape(np.float32, powers, 2)}
        leaves |= {name: _shape(np.float32, timed) for name in ("time_loc_logit", "log_time_scale")}
        leaves |= {"opacity_logit": _shape(np.float32, clear)}
    for (name, (index, what)), rows in zip(_SHARED.items(), (colors, shapes), strict=True):
        if rows is not None:
            _check_count(what, rows, 1, min(num, 1 + np.iinfo(_INDEX_TYPES[-1]).max))
            width = getattr(splats, name).shape[1]
            leaves |= {name: _shape(np.float32, rows, width), index: _shape(_index_type(rows), num)}
    return _changed(splats, leaves)


def _is_regular(splats: FoldedSplats) -> bool:
    num = splats.num_gaussians
    shapes = {"coefficients": (num, splats.degree, 2), "time_loc_logit": (num,), "log_time_scale": (num,)}
    shapes |= {"opacity_logit": (num,)}
    shapes |= {"color_dc": (num, 3), "log_scale": (num, 2)}
    return all(np.shape(getattr(splats, name)) == shape for name, shape in shapes.items())


def _by_kind(splats: FoldedSplats) -> dict[str, np.ndarray]:
    """The leaves with kinds told; none where that gains nothing."""
    if splats.degree > DEGREES:
        return {}
    degrees, lasting, solid = splats.degrees, splats.lasting, splats.solid
    leaves = {name: np.asarray(getattr(splats, name)) for name in ("coefficients", *_LEFT_OUT)}
    short = {name: leaves[name][~(lasting if bit == LASTS else solid)] for name, (bit, _) in _LEFT_OUT.items()}
    short |= {"coefficients": leaves["coefficients"][_has_power(degrees, splats.degree)]}
    short |= {"kinds": (degrees + LASTS * lasting + SOLID * solid).astype(np.uint8)}
    return short if _num_bytes(short) < _num_bytes(leaves) else {}


def _dense(splats: StoredSplats) -> dict[str, Array]:
    """The leaves that kinds made shorter."""
    degrees = _checked_degrees(splats)
    kinds, num, rows = np.asarray(splats.kinds), splats.num_gaussians, np.asarray(splats.coefficients)
    coefficients = np.zeros((num, splats.degree, 2), rows.dtype)
    coefficients[_has_power(degrees, splats.degree)] = rows
    # device_put: jnp.asarray compiles, and keeps, a program for every shape.
    leaves = {"coefficients": jax.device_put(coefficients)}
    for name, (bit, value) in _LEFT_OUT.items():
        kept = np.asarray(getattr(splats, name))
        leaf = np.full(num, value, kept.dtype)
        leaf[(kinds & bit) == 0] = kept
        leaves[name] = jax.device_put(leaf)
    return leaves


def _checked_degrees(splats: StoredSplats) -> Int[np.ndarray, " num"]:
    kinds = np.asarray(splats.kinds)
    degrees = degrees_of(kinds)
    _check_count("the greatest degree in kinds", int(degrees.max(initial=0)), 0, splats.degree)
    for what, told, leaf in (
        ("powers", degrees.sum(), splats.coefficients),
        ("Gaussians that do not last", (~lasts(kinds)).sum(), splats.log_time_scale),
        ("Gaussians that light comes through", (~is_solid(kinds)).sum(), splats.opacity_logit),
    ):
        if told != len(leaf):
            raise invalid("kinds", expected=f"{len(leaf):,} {what}, as many as are stored", got=f"{told:,}")
    return degrees


def _has_power(degrees: Int[np.ndarray, " num"], degree: int) -> Bool[np.ndarray, "num degree"]:
    return np.arange(degree) < degrees[:, None]


def _by_index(splats: FoldedSplats) -> dict[str, np.ndarray]:
    """The leaves with rows shared; none where that gains nothing."""
    leaves = {}
    for name, (index_name, _) in _SHARED.items():
        own = np.ascontiguousarray(getattr(splats, name))
        bits = own.view(np.dtype((np.void, own.dtype.itemsize * own.shape[1]))).ravel()  # so 0 and -0 stay two
        found, index = np.unique(bits, return_inverse=True)
        shared = {name: found.view(own.dtype).reshape(-1, own.shape[1])}
        shared |= {index_name: index.astype(_index_type(len(found)))}
        leaves |= shared if _num_bytes(shared) < own.nbytes else {}
    return leaves


def _own_rows(splats: StoredSplats, name: str, index_name: str) -> Float[Array, "num width"]:
    index, rows = np.asarray(getattr(splats, index_name)), np.asarray(getattr(splats, name))
    _check_count(f"the greatest {index_name}", int(index.max(initial=0)), 0, len(rows) - 1)
    return jax.device_put(rows[index])


def _index_type(num: int) -> type:
    """The smallest type that numbers so many."""
    return next(kind for kind in _INDEX_TYPES if num - 1 <= np.iinfo(kind).max)


def _changed(splats: FoldedSplats, leaves: dict[str, Any]) -> FoldedSplats | StoredSplats:
    """The stored form with these leaves in the place of the splats' own; without any, the splats."""
    if not leaves:
        return splats
    form = {name: getattr(splats, name) for name in _leaf_names()} | {
        "kinds": None,
        "color_index": None,
        "shape_index": None,
    }
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
