r"""Edits that a folded model holds exactly, over all time: new leaves for those selected, all others to the bit.

Space: with m -> c + A (m - c) + b, a Folded-Gaussian's conditionals N(m_s + f(m_t - t), a(t) Sigma_s) become those with
m_s mapped alike, A f and A Sigma_s A^T; f being a polynomial, its coefficients become A c_k. Time: with
t -> t_0 + shift + r (t - t_0), m_t is mapped alike, sigma_t becomes abs(r) sigma_t, and the fold's argument grows by
r, so c_k becomes c_k / r^k. Source: VeGaS eq:cond_dens.

All in float64, then rounded to the leaves' dtype. A function returns None where no leaves hold the edit.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.special import expit, logit

from foldgauss.video.editing.overlays import Affine, Recolor
from foldgauss.video.models.splats import SH_C0, FoldedSplats

Mask = Bool[np.ndarray, "num"]


def gather_splats(splats: FoldedSplats, source: Int[np.ndarray, " num_new"]) -> FoldedSplats:
    """The splats numbered `source`, in that order: some may be left out, some come twice."""
    num = splats.num_gaussians

    def take(leaf):
        return jnp.asarray(np.asarray(leaf)[source]) if np.ndim(leaf) and np.shape(leaf)[0] == num else leaf

    envelope = jax.tree.map(take, splats.envelope)  # one for all, or one for each
    leaves = {name: take(getattr(splats, name)) for name in _leaf_names()}
    return FoldedSplats(**leaves, envelope=envelope)


def apply_affine(splats: FoldedSplats, mask: Mask, map_: Affine) -> FoldedSplats | None:
    """Through an affine map; None where it has no fixed centre, and is more than a shift."""
    loc, shift = _as_float64(splats.loc)[mask], np.array(map_.offset)
    if map_.is_translation:
        return _replace_rows(splats, mask, loc=loc + shift)
    if map_.about is None:
        return None
    matrix, centre = map_.matrix(), np.array(map_.about)
    log_scale, angle = _map_axes(splats, mask, matrix)
    return _replace_rows(
        splats,
        mask,
        loc=(loc - centre) @ matrix.T + (centre + shift),
        coefficients=_as_float64(splats.coefficients)[mask] @ matrix.T,
        log_scale=log_scale,
        angle_logit=_angle_logit(angle),
    )


def _map_axes(splats: FoldedSplats, mask: Mask, matrix: Float[np.ndarray, "2 2"]) -> tuple[np.ndarray, np.ndarray]:
    """Logarithms of the standard deviations, and the angle, of A R S: by its singular values."""
    log_scale, angle = _as_float64(splats.log_scale)[mask], 2 * np.pi * expit(_as_float64(splats.angle_logit)[mask])
    stretch = np.sqrt(abs(np.linalg.det(matrix)))
    conformal = np.abs(matrix @ matrix.T - stretch**2 * np.eye(2)).max() <= 1e-14 * stretch**2
    if conformal and np.linalg.det(matrix) > 0:
        return log_scale + np.log(stretch), angle + np.arctan2(matrix[1, 0], matrix[0, 0])  # the axes stay axes
    cos, sin = np.cos(angle), np.sin(angle)
    turn = np.stack([np.stack([cos, -sin], -1), np.stack([sin, cos], -1)], -2)
    largest = log_scale.max(-1)  # apart, so that no square is out of range
    axes, sizes, _ = np.linalg.svd(matrix @ turn * np.exp(log_scale - largest[:, None])[:, None, :])
    first = np.log(sizes[:, 0]) + largest
    # By the determinant, which does not cancel where one axis is much the shorter.
    second = np.log(abs(np.linalg.det(matrix))) + log_scale.sum(-1) - first
    return np.stack([first, second], -1), np.arctan2(axes[:, 1, 0], axes[:, 0, 0])


def _angle_logit(angle: Float[np.ndarray, " num"]) -> Float[np.ndarray, " num"]:
    """The angle counts modulo pi; in [pi/2, 3 pi/2) the sigmoid is best conditioned."""
    return logit(((angle - np.pi / 2) % np.pi + np.pi / 2) / (2 * np.pi))


def scale_opacity(splats: FoldedSplats, mask: Mask, factor: float) -> FoldedSplats | None:
    """Opacity times `factor`; None where it would be 0, or 1 and more."""
    raw = _as_float64(splats.opacity_logit)[mask]
    opacity = factor * expit(raw)
    if not ((opacity > 0) & (opacity < 1)).all():
        return None
    # 1 / (f rho) - 1 = ((1 - f) + e^-raw) / f: near opacity 1 nothing is lost.
    return _replace_rows(splats, mask, opacity_logit=np.log(factor) - np.log((1 - factor) + np.exp(-raw)))


def apply_recolor(splats: FoldedSplats, mask: Mask, recolor: Recolor) -> FoldedSplats | None:
    """Other colours."""
    color = recolor.map_colors(opacities_and_colors(splats, mask)[1])
    return _replace_rows(splats, mask, color_dc=(color - 0.5) / SH_C0)


def opacities_and_colors(
    splats: FoldedSplats, mask: Mask
) -> tuple[Float[np.ndarray, " num"], Float[np.ndarray, "num 3"]]:
    """Opacities and colours."""
    return expit(_as_float64(splats.opacity_logit)[mask]), np.maximum(
        0.5 + SH_C0 * _as_float64(splats.color_dc)[mask], 0.0
    )


def apply_retiming(
    splats: FoldedSplats, mask: Mask, *, shift: float, stretch: float, about: float
) -> FoldedSplats | None:
    """What was at time t comes at `about + shift + stretch (t - about)`; None where an own time leaves (0, 1)."""
    time_loc = about + shift + stretch * (expit(_as_float64(splats.time_loc_logit)[mask]) - about)
    if not ((time_loc > 0) & (time_loc < 1)).all():
        return None
    power = np.arange(1, splats.degree + 1)[:, None]
    return _replace_rows(
        splats,
        mask,
        time_loc_logit=logit(time_loc),
        log_time_scale=_as_float64(splats.log_time_scale)[mask] + np.log(abs(stretch)),
        coefficients=_as_float64(splats.coefficients)[mask] / np.float64(stretch) ** power,
    )


def _replace_rows(splats: FoldedSplats, mask: Mask, **leaves: np.ndarray) -> FoldedSplats | None:
    """New values for the masked; None if one is not finite in the leaves' dtype."""
    new = {}
    for name, values in leaves.items():
        leaf = np.array(getattr(splats, name))
        with np.errstate(over="ignore"):
            leaf[mask] = values
        if not np.isfinite(leaf[mask]).all():
            return None
        new[name] = jnp.asarray(leaf)
    return dataclasses.replace(splats, **new)


def _as_float64(leaf) -> np.ndarray:
    return np.asarray(leaf, np.float64)


def _leaf_names() -> list[str]:
    return [field.name for field in dataclasses.fields(FoldedSplats) if field.name != "envelope"]
