r"""Bake edits into a folded model: new parameters for the selected Gaussians, all others unchanged to the bit.

An affine map m -> c + A (m - c) + b turns the conditionals N(m_s + f(m_t - t), a(t) Sigma_s) of a Folded-Gaussian into
those with m_s mapped, A f and A Sigma_s A^T; f is a polynomial, so its coefficients become A c_k. A change of time
t -> t_0 + shift + r (t - t_0) maps m_t; sigma_t becomes abs(r) sigma_t, and the argument of the fold grows by r, so c_k
becomes c_k / r^k. Source: VeGaS eq:cond_dens.

Gaussians on a shared path A(t) are rendered at A(t) (q + f), and E A(t) (q + f) = (E A(t) E^-1) E (q + f): an affine
map E is baked as above, and they get the path E A E^-1. With a change of time, the times of the path are mapped as m_t
is.
"""

import dataclasses
from collections.abc import Sequence
from functools import partial

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy.special import expit, logit

from foldgauss._runtime.checks import require
from foldgauss.video.editing.overlays import Affine, Recolor
from foldgauss.video.models.shared_paths import PathChange, change_paths
from foldgauss.video.models.splats import SH_C0, FoldedSplats
from foldgauss.video.selection.selectors import Mask

#: With a mean lightness below this, the lightness of the Gaussians does not tell the shading of an object.
MIN_LIGHTNESS = 1e-4


def apply_affine(splats: FoldedSplats, mask: Mask, map_: Affine) -> FoldedSplats | None:
    """Apply an affine map; None for one about the selection's own center, unless it is a translation."""
    loc, shift = _as_float64(splats.loc)[mask], np.array(map_.offset)
    if map_.is_translation:
        return _replace_rows(splats, mask, partial(_map_path, np.eye(2), shift), loc=loc + shift)
    if map_.about is None:
        return None
    matrix, center = map_.matrix(), np.array(map_.about)
    log_scale, angle = _map_axes(splats, mask, matrix)
    return _replace_rows(
        splats,
        mask,
        partial(_map_path, matrix, center + shift - matrix @ center),
        loc=(loc - center) @ matrix.T + (center + shift),
        coefficients=_as_float64(splats.coefficients)[mask] @ matrix.T,
        log_scale=log_scale,
        # It is defined modulo pi; in [pi/2, 3 pi/2) its logit is best conditioned.
        angle_logit=logit(((angle - np.pi / 2) % np.pi + np.pi / 2) / (2 * np.pi)),
    )


def _map_path(
    matrix: Float[np.ndarray, "2 2"], offset: Float[np.ndarray, "2"], times: np.ndarray, maps: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The path E A E^-1 with E(x) = `matrix` x + `offset`, which moves what is already mapped by E."""
    linear = matrix @ maps[..., :2] @ np.linalg.inv(matrix)
    moved = maps[..., 2] @ matrix.T + offset - linear @ offset
    return times, np.concatenate([linear, moved[..., None]], -1)


def _map_axes(splats: FoldedSplats, mask: Mask, matrix: Float[np.ndarray, "2 2"]) -> tuple[np.ndarray, np.ndarray]:
    """Log standard deviations and angle of the covariance factor A R S, from its singular value decomposition."""
    log_scale, angle = _as_float64(splats.log_scale)[mask], 2 * np.pi * expit(_as_float64(splats.angle_logit)[mask])
    stretch = np.sqrt(abs(np.linalg.det(matrix)))
    conformal = np.abs(matrix @ matrix.T - stretch**2 * np.eye(2)).max() <= 1e-14 * stretch**2
    if conformal and np.linalg.det(matrix) > 0:  # a similarity: the axes stay axes
        return log_scale + np.log(stretch), angle + np.arctan2(matrix[1, 0], matrix[0, 0])
    cos, sin = np.cos(angle), np.sin(angle)
    turn = np.stack([np.stack([cos, -sin], -1), np.stack([sin, cos], -1)], -2)
    largest = log_scale.max(-1)  # factored out, so that no square overflows
    axes, sizes, _ = np.linalg.svd(matrix @ turn * np.exp(log_scale - largest[:, None])[:, None, :])
    first = np.log(sizes[:, 0]) + largest
    # From the determinant: no cancellation where one axis is much shorter.
    second = np.log(abs(np.linalg.det(matrix))) + log_scale.sum(-1) - first
    return np.stack([first, second], -1), np.arctan2(axes[:, 1, 0], axes[:, 0, 0])


def scale_opacity(splats: FoldedSplats, mask: Mask, factor: float) -> FoldedSplats | None:
    """Opacity times `factor`; None if a result is not in (0, 1)."""
    raw = _as_float64(splats.opacity_logit)[mask]
    opacity = factor * expit(raw)
    if not ((opacity > 0) & (opacity < 1)).all():
        return None
    # 1 / (f rho) - 1 = ((1 - f) + e^-raw) / f, which loses no digits near opacity 1.
    return _replace_rows(splats, mask, opacity_logit=np.log(factor) - np.log((1 - factor) + np.exp(-raw)))


def apply_recolor(splats: FoldedSplats, mask: Mask, recolor: Recolor) -> FoldedSplats | None:
    """Map the colors."""
    color = recolor.map_colors(opacities_and_colors(splats, mask)[1])
    return _replace_rows(splats, mask, color_dc=(color - 0.5) / SH_C0)


def opacities_and_colors(
    splats: FoldedSplats, mask: Mask
) -> tuple[Float[np.ndarray, " num"], Float[np.ndarray, "num 3"]]:
    """Opacities and colors of the selected Gaussians."""
    color = 0.5 + SH_C0 * _as_float64(splats.color_dc)[mask]
    return expit(_as_float64(splats.opacity_logit)[mask]), np.maximum(color, 0.0)


def mean_lightness(sums: Sequence[tuple[float, float]]) -> float:
    """The mean lightness from sums over parts of an object: of lightness times opacity, and of opacity.

    Raises ValueError if it is about 0.
    """
    weighted, opacity = (sum(parts) for parts in zip(*sums, strict=True))
    mean = weighted / max(opacity, np.finfo(float).tiny)
    require(
        mean >= MIN_LIGHTNESS,
        "color",
        expected="an object that is not black",
        got=f"mean lightness {mean:g}",
        cure="A black object has no shading to keep: use offset=.",
    )
    return mean


def apply_retiming(
    splats: FoldedSplats, mask: Mask, *, shift: float, stretch: float, about: float
) -> FoldedSplats | None:
    """Map time t to `about + shift + stretch (t - about)`; None if an m_t leaves (0, 1)."""
    time_loc = about + shift + stretch * (expit(_as_float64(splats.time_loc_logit)[mask]) - about)
    if not ((time_loc > 0) & (time_loc < 1)).all():
        return None
    power = np.arange(1, splats.degree + 1)[:, None]

    def retime(times: np.ndarray, maps: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        order = slice(None, None, -1 if stretch < 0 else 1)
        return (about + shift + stretch * (times - about))[order], maps[order]

    return _replace_rows(
        splats,
        mask,
        retime,
        time_loc_logit=logit(time_loc),
        log_time_scale=_as_float64(splats.log_time_scale)[mask] + np.log(abs(stretch)),
        coefficients=_as_float64(splats.coefficients)[mask] / np.float64(stretch) ** power,
    )


def _replace_rows(
    splats: FoldedSplats, mask: Mask, path_change: PathChange | None = None, **leaves: np.ndarray
) -> FoldedSplats | None:
    """Replace parameters of the selected Gaussians, and their paths if these change, see `change_paths`.

    None if a value is not finite in the parameters' dtype, and for too many paths.
    """
    new = {}
    for name, values in leaves.items():
        leaf = np.array(getattr(splats, name))
        with np.errstate(over="ignore"):
            leaf[mask] = values
        if not np.isfinite(leaf[mask]).all():
            return None
        new[name] = jnp.asarray(leaf)
    replaced = dataclasses.replace(splats, **new)
    return replaced if path_change is None else change_paths(replaced, mask, path_change)


def _as_float64(leaf) -> np.ndarray:
    return np.asarray(leaf, np.float64)
