"""What is stored of a model's Gaussians: of each what it has, and a colour that many share once. Exact to the bit."""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, UInt, UInt8

from foldgauss._checks import invalid, short_repr, whole
from foldgauss.envelope import TimeLikelihood
from foldgauss.video.model import LASTING, FoldedSplats

_LASTS = 128  # the highest bit of a kind; the lower ones are the degree
_INDEX_TYPES = (np.uint8, np.uint16, np.uint32)


class StoredSplats(eqx.Module):
    """The leaves of `FoldedSplats` less what `kinds` and `color_index` tell; leaves not named here are the same.

    | leaf | shape | holds |
    |---|---|---|
    | `kinds` | (num,) or None | degree + 128 lasting of each Gaussian; None: the next three leaves are whole |
    | `coefficients` | (powers, 2) | c_1 to c_degree of the first Gaussian, then those of the second, and so on |
    | `time_loc_logit`, `log_time_scale` | (timed,) | those of the Gaussians that do not last |
    | `color_index` | (num,) or None | the row of `color_dc` that is the Gaussian's; None: each has its own |
    | `color_dc` | (colors, 3) | the colours that there are |

    `degree` is that of the dense leaf, which no Gaussian need have.
    """

    loc: Float[Array, "num 2"]
    log_scale: Float[Array, "num 2"]
    angle_logit: Float[Array, "num"]
    time_loc_logit: Float[Array, "timed"]
    log_time_scale: Float[Array, "timed"]
    coefficients: Float[Array, "powers 2"] | Float[Array, "num degree 2"]
    opacity_logit: Float[Array, "num"]
    color_dc: Float[Array, "colors 3"]
    envelope: TimeLikelihood
    kinds: UInt8[Array, "num"] | None
    color_index: UInt[Array, "num"] | None
    degree: int = eqx.field(static=True)

    @property
    def num_gaussians(self) -> int:
        return self.loc.shape[0]


def to_stored(splats: FoldedSplats) -> FoldedSplats | StoredSplats:
    """The splats, whose values must be known, in the form of fewest bytes: themselves where nothing is gained.

    There are kinds where they take fewer bytes than what they leave out, and shared colours likewise.
    """
    if not _is_regular(splats):  # no form has a place for such leaves: who writes them says so
        return splats
    return _changed(splats, _by_kind(splats) | _by_palette(splats))


def from_stored(splats: FoldedSplats | StoredSplats) -> FoldedSplats:
    """The inverse of `to_stored`; leaves that were put together again are JAX arrays.

    Raises ValueError for kinds and indices that do not fit the other leaves, whose shapes must be those of the class.
    """
    if isinstance(splats, FoldedSplats):
        return splats
    leaves = {name: getattr(splats, name) for name in _leaf_names()}
    if splats.kinds is not None:
        leaves |= _dense(splats)
    if splats.color_index is not None:
        leaves["color_dc"] = _own_colors(splats)
    return FoldedSplats(**leaves)


def stored_counts(splats: FoldedSplats | StoredSplats) -> dict[str, int]:
    """The numbers of rows that `stored_skeleton` needs; empty for splats that are stored as they are."""
    if isinstance(splats, FoldedSplats):
        return {}
    counts = {}
    if splats.kinds is not None:
        counts |= {"powers": splats.coefficients.shape[0], "timed": splats.log_time_scale.shape[0]}
    if splats.color_index is not None:
        counts |= {"colors": splats.color_dc.shape[0]}
    return counts


def stored_skeleton(
    splats: FoldedSplats, *, powers: int | None = None, timed: int | None = None, colors: int | None = None
) -> FoldedSplats | StoredSplats:
    """The stored form of splats of shapes only (`jax.ShapeDtypeStruct`), with the numbers of rows of its leaves.

    Raises ValueError for numbers that no such form has.
    """
    num, leaves = splats.num_gaussians, {}
    if powers is not None or timed is not None:
        _check_count("degree", splats.degree, 0, _LASTS - 1)
        _check_count("powers", powers, 0, num * splats.degree)
        _check_count("timed", timed, 0, num)
        leaves |= {"kinds": _shape(np.uint8, num), "coefficients": _shape(np.float32, powers, 2)}
        leaves |= {name: _shape(np.float32, timed) for name in ("time_loc_logit", "log_time_scale")}
    if colors is not None:
        _check_count("colors", colors, 1, min(num, 1 + np.iinfo(_INDEX_TYPES[-1]).max))
        leaves |= {"color_dc": _shape(np.float32, colors, 3), "color_index": _shape(_index_type(colors), num)}
    return _changed(splats, leaves)


def _is_regular(splats: FoldedSplats) -> bool:
    num = splats.num_gaussians
    shapes = {"coefficients": (num, splats.degree, 2), "time_loc_logit": (num,), "log_time_scale": (num,)}
    return all(np.shape(getattr(splats, name)) == shape for name, shape in (shapes | {"color_dc": (num, 3)}).items())


def _by_kind(splats: FoldedSplats) -> dict[str, np.ndarray]:
    """The leaves with kinds told; none where that gains nothing."""
    if splats.degree >= _LASTS:
        return {}
    degrees, lasts = splats.degrees, splats.lasting
    leaves = {name: np.asarray(getattr(splats, name)) for name in ("coefficients", "time_loc_logit", "log_time_scale")}
    short = {name: leaf[~lasts] for name, leaf in leaves.items() if name != "coefficients"}
    short |= {"coefficients": leaves["coefficients"][_has_power(degrees, splats.degree)]}
    short |= {"kinds": (degrees + _LASTS * lasts).astype(np.uint8)}
    return short if _num_bytes(short) < _num_bytes(leaves) else {}


def _dense(splats: StoredSplats) -> dict[str, Array]:
    """The leaves that kinds made shorter."""
    degrees, lasts = _checked_kinds(splats)
    num, rows = splats.num_gaussians, np.asarray(splats.coefficients)
    coefficients = np.zeros((num, splats.degree, 2), rows.dtype)
    coefficients[_has_power(degrees, splats.degree)] = rows
    leaves = {"coefficients": jnp.asarray(coefficients)}
    for name, value in (("time_loc_logit", 0), ("log_time_scale", LASTING)):
        kept = np.asarray(getattr(splats, name))
        leaf = np.full(num, value, kept.dtype)
        leaf[~lasts] = kept
        leaves[name] = jnp.asarray(leaf)
    return leaves


def _checked_kinds(splats: StoredSplats) -> tuple[Int[np.ndarray, "num"], Bool[np.ndarray, "num"]]:
    """Degrees, and who lasts."""
    kinds = np.asarray(splats.kinds)
    degrees, lasts = (kinds % _LASTS).astype(int), kinds >= _LASTS
    _check_count("the greatest degree in kinds", int(degrees.max(initial=0)), 0, splats.degree)
    for what, told, leaf in (
        ("powers", degrees.sum(), splats.coefficients),
        ("Gaussians that do not last", (~lasts).sum(), splats.log_time_scale),
    ):
        if told != len(leaf):
            raise invalid("kinds", expected=f"{len(leaf):,} {what}, as many as are stored", got=f"{told:,}")
    return degrees, lasts


def _has_power(degrees: Int[np.ndarray, "num"], degree: int) -> Bool[np.ndarray, "num degree"]:
    return np.arange(degree) < degrees[:, None]


def _by_palette(splats: FoldedSplats) -> dict[str, np.ndarray]:
    """The leaves with colours shared; none where that gains nothing."""
    own = np.ascontiguousarray(splats.color_dc)
    bits = own.view(np.dtype((np.void, own.dtype.itemsize * own.shape[1]))).ravel()  # so 0 and -0 stay two colours
    found, index = np.unique(bits, return_inverse=True)
    shared = {"color_dc": found.view(own.dtype).reshape(-1, own.shape[1])}
    shared |= {"color_index": index.astype(_index_type(len(found)))}
    return shared if _num_bytes(shared) < own.nbytes else {}


def _own_colors(splats: StoredSplats) -> Float[Array, "num 3"]:
    index, palette = np.asarray(splats.color_index), np.asarray(splats.color_dc)
    _check_count("the greatest color_index", int(index.max(initial=0)), 0, len(palette) - 1)
    return jnp.asarray(palette[index])


def _index_type(num: int) -> type:
    """The smallest type that numbers so many."""
    return next(kind for kind in _INDEX_TYPES if num - 1 <= np.iinfo(kind).max)


def _changed(splats: FoldedSplats, leaves: dict[str, Any]) -> FoldedSplats | StoredSplats:
    """The stored form with these leaves in the place of the splats' own; without any, the splats."""
    if not leaves:
        return splats
    form = {name: getattr(splats, name) for name in _leaf_names()} | {"kinds": None, "color_index": None}
    return StoredSplats(**(form | leaves), degree=splats.degree)


def _leaf_names() -> list[str]:
    return [field.name for field in dataclasses.fields(FoldedSplats)]


def _shape(dtype: type, *shape: int) -> jax.ShapeDtypeStruct:
    return jax.ShapeDtypeStruct(shape, dtype)


def _num_bytes(leaves: dict[str, np.ndarray]) -> int:
    return sum(leaf.nbytes for leaf in leaves.values())


def _check_count(name: str, value: object, least: int, most: int) -> None:
    if not whole(value, least) or value > most:
        raise invalid(name, expected=f"a whole number from {least} to {most:,}", got=short_repr(value))
