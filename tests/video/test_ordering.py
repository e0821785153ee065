"""Reordering of Gaussians for compression: constraints, costs, and unchanged images."""

import equinox as eqx
import jax
import numpy as np
from soft_models import soft_model

from foldgauss.render import RenderOptions
from foldgauss.video.compression.sort_order import find_overlaps, sort_by_cell, sort_constrained
from foldgauss.video.models.metrics import psnr
from foldgauss.video.selection.contributions import Contributions


def in_order(model, order):
    def cut(leaf):
        return np.asarray(leaf)[order] if np.ndim(leaf) else leaf

    return eqx.tree_at(lambda m: m.splats, model, jax.tree.map(cut, model.splats))


def narrow(model):
    """Small Gaussians: many do not overlap."""
    return eqx.tree_at(lambda m: m.splats.log_scale, model, np.asarray(model.splats.log_scale) - np.float32(0.9))


def far_apart(one, other):
    return min(psnr(a, b) for a, b in zip(one.frames(), other.frames(), strict=True))


def test_constrained_sort_keeps_pairs_in_order():
    rng = np.random.default_rng(0)
    cell = rng.integers(0, 16, 300)
    front, back = np.sort(rng.integers(0, 300, (2, 500)), axis=0)
    front, back = front[front < back], back[front < back]
    order = sort_constrained(cell, front, back)
    assert sorted(order) == list(range(300))
    place = np.argsort(order)
    assert (place[front] < place[back]).all()
    none = np.zeros(0, int)
    np.testing.assert_array_equal(cell[sort_constrained(cell, none, none)], np.sort(cell))


def test_reordering_within_no_budget_keeps_images():
    model = narrow(soft_model(options=RenderOptions()))
    lit, cell = Contributions(model), np.random.default_rng(1).integers(0, 4, model.num_gaussians)
    order = sort_by_cell(cell, find_overlaps(lit), 0.0)
    assert (order != np.arange(len(order))).sum() > 10
    assert far_apart(in_order(model, order), model) > 48
    mixed = np.argsort(cell, kind="stable")
    assert far_apart(in_order(model, mixed), model) < 40  # where any may pass any


def test_overlap_cost_is_the_error_of_swapping():
    """Of two Gaussians, by the pictures."""
    model = in_order(soft_model(options=RenderOptions()), np.array([20, 30]))
    lit = Contributions(model)
    front, back, cost = find_overlaps(lit)
    assert (front.tolist(), back.tolist()) == ([0], [1])
    shown = [np.stack(list(one.frames())) / 255.0 for one in (model, in_order(model, np.array([1, 0])))]
    np.testing.assert_allclose(cost[0], ((shown[0] - shown[1]) ** 2).sum(), rtol=0.2)
