"""Pruning: scores against images rendered without a part, and clips whose simplest model is known."""

import dataclasses
import functools

import jax
import numpy as np
import pytest
from foldgauss.video.models.sparse_storage import (
    OPAQUE_BIT,
    STATIC_BIT,
    clear_absent_moments,
    count_parameters,
    find_kinds,
    get_degrees,
    is_opaque,
    is_static,
)
from scenes_of_motion import SIZE, cut, disc, noise, still

from foldgauss.io.models.checkpoint import load_checkpoint, save_checkpoint
from foldgauss.render import cpu, pixels_per_unit
from foldgauss.video import Economy, FitConfig, evaluate, fit
from foldgauss.video.compression.finetune import finetune_model
from foldgauss.video.fitting.adam import sparse_adam
from foldgauss.video.fitting.codebook import Codebook, average_clusters, find_clusters
from foldgauss.video.fitting.growth import Growth
from foldgauss.video.fitting.loop import fit_steps, start, to_model
from foldgauss.video.fitting.pruning import pruner
from foldgauss.video.fitting.pruning.description_length import MAX_OPAQUE_FRACTION, prune_rows, weigh_frames
from foldgauss.video.fitting.pruning.pruner import _long_axis_first
from foldgauss.video.fitting.pruning.scores import PruningScores, measure_scores
from foldgauss.video.fitting.schedule import plan_levels
from foldgauss.video.models.conditioning import ConditioningSpec, condition, find_windows
from foldgauss.video.models.row_layout import columns, pack
from foldgauss.video.models.splats import OPAQUE_LOGIT
from foldgauss.video.selection.contributions import Contributions

STEPS = 500


@functools.cache
def fitted(name: str, **changes):
    clips = {
        "one": lambda: still(1),
        "still": lambda: still(24),
        "line": lambda: disc(lambda s: (15 + 50 * s, 24)),
        "parabola": lambda: disc(lambda s: (15 + 50 * s, 12 + 96 * (s - 0.5) ** 2)),
        "cut": cut,
        "noise": lambda: noise(24),
    }
    frames = clips[name]()
    config = FitConfig(**{"num_gaussians": 300, "steps": STEPS, "economy": Economy()} | changes)
    counts, state = [], None
    for state, info in fit_steps(frames, config):
        counts.append(info.num_gaussians)
    return frames, to_model(state, config, SIZE, 25.0), state, counts


def weights(model) -> np.ndarray:
    """(num_frames, num_gaussians): what each Gaussian adds to each frame, in pixels."""
    lit = Contributions(model)
    out = np.zeros((model.num_frames, model.num_gaussians))
    for k in range(model.num_frames):
        light = lit.at_frame(k)
        out[k, light.alive] = light.total
    return out


# ---------------------------------------------------------------------------------------------- what scenes require


@pytest.mark.slow
def test_still_clip_takes_as_many_parameters_as_one_frame():
    _, one, _, _ = fitted("one")
    frames, many, _, _ = fitted("still")
    assert many.num_parameters < 1.1 * one.num_parameters
    seen = weights(many).sum(0)
    assert seen[many.splats.degrees == 0].sum() > 0.99 * seen.sum()
    assert seen[many.splats.static].sum() > 0.99 * seen.sum()
    assert evaluate(many, frames).mean_psnr > 45


@pytest.mark.parametrize(("name", "degree"), [pytest.param("line", 1, marks=pytest.mark.slow), ("parabola", 2)])
def test_degree_is_that_of_the_motion(name, degree):
    frames, model, _, _ = fitted(name)
    assert evaluate(model, frames).mean_psnr > 38
    splats, seen = model.splats, weights(model)
    # The disc is red: what adds to it there.
    moving = np.asarray(splats.color_dc)[:, 0] > 0.5
    share = [seen[:, moving & (splats.degrees == k)].sum() / seen[:, moving].sum() for k in range(4)]
    assert share[degree] > 0.7
    assert sum(share[: degree + 1]) > 0.85  # few with more; measured 0.87 and 1.0


def test_static_background_is_static():
    """Of single fits, by the last bits of rounding, half of it to nearly all."""
    shares = []
    for seed in range(3):
        _, model, _, _ = fitted("line", seed=seed)
        still_ones = np.asarray(model.splats.color_dc)[:, 0] < 0
        seen = weights(model).sum(0)
        shares.append(seen[still_ones & model.splats.static].sum() / seen[still_ones].sum())
    assert np.mean(shares) > 0.6


def test_gaussians_end_at_a_cut():
    frames, model, _, _ = fitted("cut")
    seen = weights(model)
    first, second = seen[:12].sum(0), seen[12:].sum(0)
    both = np.minimum(first, second).sum()
    assert both < 0.02 * seen.sum()
    assert evaluate(model, frames).mean_psnr > 35


def test_noise_ends_births():
    _, model, _, counts = fitted("noise", steps=700)
    assert max(counts) <= 1.5 * 300  # those born once do not pay, and none are born after them
    assert counts[-1] < 0.5 * 300
    assert model.num_gaussians == counts[-1]


def test_detail_causes_births():
    config = FitConfig(num_gaussians=160, steps=STEPS, economy=Economy())
    counts = [info.num_gaussians for _, info in fit_steps(cut(), config)]
    assert max(counts) > 1.4 * 160


# ---------------------------------------------------------------------------------------------- the scores


@pytest.fixture(scope="module")
def scene():
    """Frames, and the rows of a model fitted to them, which nobody may change."""
    frames = disc(lambda s: (15 + 50 * s, 12 + 96 * (s - 0.5) ** 2), num_frames=8)
    model = fit(frames, FitConfig(num_gaussians=120, steps=250, degree=2, power=1.0)).model
    rows = pack(model.splats)
    rows.setflags(write=False)
    shape = ConditioningSpec(2, 1.0, 0.0, SIZE)
    times = np.asarray(model.frame_times.times())
    drawn = {"compositing": "over", "options": model.options}
    return frames, rows, shape, times, drawn


def _target(frames):
    def target(k):
        planes = frames[k] if frames[k].dtype == np.float32 else np.moveaxis(frames[k], -1, 0) * np.float32(1 / 255)
        return planes, np.zeros(3, np.float32)

    return target


def _pictures(rows, shape, times, drawn) -> list[np.ndarray]:
    """Planes (3, height, width), float32."""
    window = find_windows(rows, shape)
    pictures = []
    for t in times:
        done = condition(rows, window, t, shape)
        leaves = done.mean, done.factor, done.opacity, done.color, np.zeros(3, np.float32)
        pictures.append(cpu.forward(*leaves, SIZE, **drawn).image)
    return pictures


def _error(rows, frames, shape, times, drawn) -> float:
    shown = _pictures(rows, shape, times, drawn)
    return sum(float(((shown[k] - _target(frames)(k)[0]).astype(float) ** 2).sum()) for k in range(len(times)))


def _measured(rows, frames, shape, times, drawn, **how):
    window = find_windows(rows, shape)
    return measure_scores(rows, window, times, shape, _target(frames), **drawn, **how)


def _mean_scores(scene, draws=24):
    all_scores = [_measured(*(scene[1], scene[0], *scene[2:]), seed=seed) for seed in range(draws)]
    fields = {
        field.name: np.mean([getattr(each, field.name) for each in all_scores], axis=0)
        for field in dataclasses.fields(all_scores[0])
        if field.name not in ("num_samples", "size")
    }
    return dataclasses.replace(all_scores[0], **fields)


@pytest.fixture(scope="module")
def mean_scores(scene):
    """Against the clip."""
    return _mean_scores(scene)


@pytest.fixture(scope="module")
def own(scene):
    """The model's own pictures, and the scores against them."""
    pictures = _pictures(*scene[1:])
    return pictures, _mean_scores((pictures, *scene[1:]))


def test_scores_have_the_errors_of_the_frames(scene):
    frames, rows, shape, times, drawn = scene
    scores = _measured(rows, frames, shape, times, drawn)
    assert scores.squared_error == pytest.approx(_error(rows, frames, shape, times, drawn), rel=1e-4)


def test_cost_of_removal_is_as_predicted(scene, mean_scores):
    frames, rows, shape, times, drawn = scene
    scores, before = mean_scores, _error(rows, frames, shape, times, drawn)
    chosen = np.argsort(-scores.second_order)[:: len(rows) // 12]
    cost = [_error(np.delete(rows, i, 0), frames, shape, times, drawn) - before for i in chosen]
    told = scores.added_by_removal[chosen]
    scale = max(map(abs, cost))
    assert np.abs(told - cost).max() < 0.25 * scale
    assert np.corrcoef(told, cost)[0, 1] > 0.97


@pytest.mark.parametrize("degree", [0, 1])
def test_cost_of_a_lower_degree_is_as_predicted(scene, own, degree):
    """Against the pictures themselves, where nothing but the path is wrong, and by little."""
    (_, rows, shape, times, drawn), (pictures, scores) = scene, own
    at, pixels = columns(shape.degree), pixels_per_unit(SIZE)
    place = np.concatenate([rows[:, at["loc"]], rows[:, at["coefficients"]]], 1).reshape(len(rows), -1, 2) * pixels
    added, path = scores.lower_degree(place.astype(float), degree, np.arange(len(rows)))
    assert (path[:, degree + 1 :] == 0).all()
    ratios = []
    for i in np.flatnonzero((added > 1e-5) & (added < 1e-3))[:15]:
        changed = rows.copy()
        changed[i, at["loc"]] = path[i, 0] / pixels
        changed[i, at["coefficients"]] = (path[i, 1:] / pixels).ravel()
        ratios.append(_error(changed, pictures, shape, times, drawn) / added[i])
    assert len(ratios) >= 6
    assert 0.6 < np.median(ratios) < 1.4


@pytest.mark.parametrize("degree", [0, 1, 2])
def test_lower_degree_path_is_optimal(degree):
    """Against least squares over the frames, written out."""
    rng = np.random.default_rng(degree)
    u, factors = rng.uniform(-1, 1, 9), rng.normal(size=(9, 2, 2))
    weights, path = factors @ factors.transpose(0, 2, 1), rng.normal(size=(4, 2))
    parts = np.stack([weights[:, 0, 0], weights[:, 0, 1], weights[:, 1, 1]], 1)
    span = 0.7
    moments = ((u / span)[:, None, None] ** np.arange(7)[:, None] * parts[:, None]).sum(0)
    none = np.zeros(1)
    scores = PruningScores(none, none, 1, none, none, none, moments[None], np.array([span]), none, none, none, none)
    added, lower = scores.lower_degree(path[None], degree, np.array([0]))
    powers = u[:, None] ** np.arange(4)
    # sum over frames of |F^T (powers (path - lower))|^2
    design = np.einsum("tij,tk->tjki", factors, powers).reshape(18, 4, 2)
    low = design[:, : degree + 1].reshape(18, -1)
    wanted = design[:, degree + 1 :].reshape(18, -1) @ path[degree + 1 :].ravel()
    best, left, *_ = np.linalg.lstsq(low, wanted, rcond=None)
    assert added[0] == pytest.approx(left[0], rel=1e-3)
    np.testing.assert_allclose(lower[0, : degree + 1], path[: degree + 1] + best.reshape(-1, 2), rtol=1e-3, atol=1e-4)


def test_correlated_errors_count_once(scene):
    frames, rows, shape, times, drawn = scene
    same = np.repeat(frames[:1], 8, 0)
    still_rows = rows.copy()
    still_rows[:, columns(2)["coefficients"]] = 0
    still_rows[:, columns(2)["log_time_scale"]] = 6
    one = _measured(still_rows, same[:1], shape, times[:1], drawn)
    many = _measured(still_rows, same, shape, times, drawn)
    assert many.correlation[0] > 0.999
    assert many.effective_samples < 1.02 * one.effective_samples
    rough = _measured(still_rows, noise(8), shape, times, drawn)
    assert rough.effective_samples > 0.9 * rough.num_samples


# ---------------------------------------------------------------------------------------------- kinds, colors


def test_kinds_match_the_stored_model():
    _, model, state, _ = fitted("line")
    kinds = model.splats.degrees + STATIC_BIT * model.splats.static + OPAQUE_BIT * model.splats.opaque
    np.testing.assert_array_equal(find_kinds(state.rows, model.degree), kinds)
    np.testing.assert_array_equal(is_static(state.kinds), model.splats.static)
    np.testing.assert_array_equal(is_opaque(state.kinds), model.splats.opaque)
    assert (get_degrees(state.kinds) >= model.splats.degrees).all()  # a power may be there and be 0


def test_absent_parameters_never_move():
    _, model, state, _ = fitted("line")
    at, kinds = columns(model.degree), state.kinds
    powers = np.repeat(np.arange(1, model.degree + 1), 2)
    assert (get_degrees(kinds) < model.degree).any()
    assert (state.rows[:, at["coefficients"]][powers > get_degrees(kinds)[:, None]] == 0).all()
    assert is_static(kinds).any()
    assert is_opaque(kinds).any()
    assert (state.rows[is_opaque(kinds), at["opacity_logit"].start] == OPAQUE_LOGIT).all()


def test_moments_of_absent_parameters_are_cleared():
    first, second = np.ones((2, 3, 11 + 4), np.float32)
    clear_absent_moments(first, second, np.array([2, 1 + OPAQUE_BIT, STATIC_BIT], np.uint8), 2)
    at = columns(2)
    assert first[:, at["coefficients"]].tolist() == [[1, 1, 1, 1], [1, 1, 0, 0], [0, 0, 0, 0]]
    assert second[:, at["log_time_scale"].start].tolist() == [1, 1, 0]
    assert second[:, at["time_loc_logit"].start].tolist() == [1, 1, 0]
    assert second[:, at["opacity_logit"].start].tolist() == [1, 0, 1]
    assert (first[:, at["color_dc"]] == 1).all()


@pytest.mark.parametrize("width", [2, 3])
def test_values_are_shared_where_it_pays(width):
    rng, weight = np.random.default_rng(0), np.ones((400, width))
    few = rng.normal(size=(8, width))[rng.integers(0, 8, 400)].astype(np.float32)
    many = rng.normal(size=(400, width)).astype(np.float32)
    np.testing.assert_allclose(average_clusters(few, find_clusters(few, weight, 1e-3, 0)), few, atol=1e-5)
    assert find_clusters(many, weight, 1e-6, 0) is None
    assert len(np.unique(find_clusters(many, weight, 10.0, 0))) == 8  # dear numbers: few rows
    bounded = find_clusters(many, weight, 10.0, 0, max_error=0.05 * width * 400)  # of an error of about width a row
    assert len(np.unique(bounded)) > 8
    assert ((many - average_clusters(many, bounded)) ** 2).sum() <= 0.05 * width * 400
    assert find_clusters(many, weight, 10.0, 0, max_error=0.0) is None


def test_shared_values_are_learned_as_one():
    """Adam on the sum of the gradients of those that took part; who did not moves along."""
    index = np.array([0, 1, 0, 2, 1])
    palette, values = Codebook.create(index, 2), np.array([[1, 2], [3, 4], [1, 2], [5, 6], [3, 4]], np.float32)
    grad = np.array([[1, 0], [9, 9], [2, -4], [0.5, 1], [9, 9]], np.float32)
    before, rate = values.copy(), np.float32([0.1, 0.01])
    palette.step(values, grad, np.array([0, 2, 3]), rate)
    moved = values - before
    np.testing.assert_allclose(moved[[0, 2]], [[-0.1, 0.01]] * 2, rtol=1e-4)  # by the signs of 3 and -4: a first step
    np.testing.assert_allclose(moved[3], [-0.1, -0.01], rtol=1e-4)
    assert (moved[[1, 4]] == 0).all()
    assert (grad[[0, 2, 3]] == 0).all()
    assert palette.counts.tolist() == [1, 0, 1]
    np.testing.assert_allclose(palette.first[0], 0.1 * np.array([3, -4]), rtol=1e-5)
    alone, shown = Codebook.create(np.zeros(1, int), 2), np.zeros((1, 2), np.float32)
    row, grad, moments = np.zeros((1, 11), np.float32), np.zeros((1, 11), np.float32), np.zeros((2, 1, 11), np.float32)
    counts, rates = np.zeros(1, np.int32), np.full(11, 0.1, np.float32)
    for gradient in np.random.default_rng(1).normal(size=(6, 1, 2)).astype(np.float32):
        grad[:, :2] = gradient
        sparse_adam(row, grad, *moments, counts, np.array([0]), rates)
        alone.step(shown, gradient.copy(), np.array([0]), np.float32([0.1, 0.1]))
    np.testing.assert_allclose(shown, row[:, :2], rtol=1e-4)


def test_shared_values_stay_shared():
    frames = disc(lambda s: (15 + 50 * s, 12 + 96 * (s - 0.5) ** 2))
    config = FitConfig(num_gaussians=400, steps=300, economy=Economy(bits=200.0))
    for state, _ in fit_steps(frames, config):
        pass
    at = columns(config.degree)
    for palette, leaf in ((state.colors, "color_dc"), (state.shapes, "log_scale")):
        assert len(palette.index) == len(state.rows)
        rows = np.unique(state.rows[:, at[leaf]], axis=0)
        assert len(rows) == len(np.unique(palette.index)) < len(state.rows) / 2
    model = to_model(state, config, SIZE, 25.0)
    assert model.num_parameters < count_parameters(state.kinds) - len(state.rows)


def test_quarter_turn_changes_no_image(scene):
    frames, rows, shape, times, drawn = scene
    state = start(frames, FitConfig(num_gaussians=len(rows), steps=1, degree=shape.degree))
    state.rows = rows.copy()
    state.first, state.second = (np.random.default_rng(k).random(rows.shape).astype(np.float32) for k in (0, 1))
    first, at = state.first.copy(), columns(shape.degree)["log_scale"]
    turned = _long_axis_first(state, shape.degree)
    assert 0 < turned.sum() < len(rows)
    assert (state.rows[:, at.start] >= state.rows[:, at.start + 1]).all()
    for one, other in zip(
        _pictures(rows, shape, times, drawn), _pictures(state.rows, shape, times, drawn), strict=True
    ):
        np.testing.assert_allclose(one, other, atol=2e-5)
    np.testing.assert_array_equal(state.first[turned][:, at], first[turned][:, at][:, ::-1])
    np.testing.assert_array_equal(state.rows[~turned], rows[~turned])


def test_frames_are_weighted_by_inverse_error():
    assert (weigh_frames(np.zeros(3, np.float32)) == 1).all()
    weights = weigh_frames(np.float32([1e-3, 2e-3, 4e-3, 0]))
    np.testing.assert_allclose(weights, np.array([4, 2, 1, 2]) / 9 * 4, rtol=1e-6)
    one_black = weigh_frames(np.float32([1e-12] + [1e-3] * 99))
    assert 3 < one_black[0] / one_black[1] < 6  # an exact frame does not outweigh the others
    assert one_black.mean() == pytest.approx(1)


def test_scores_are_linear_in_the_weights(scene):
    """Linear in the weights, frame by frame: the first frames' and the last frames' add up to all."""
    frames, rows, shape, times, drawn = scene
    parts = np.linspace(0.2, 1.8, len(times))
    all_scores = [_measured(rows, frames, shape, times, drawn, weights=w) for w in (parts, 2 - parts, None)]
    for name in ("first_order", "second_order", "by_path", "by_color", "by_axes", "by_size", "squared_error"):
        first, second, plain = (np.asarray(getattr(scores, name)) for scores in all_scores)
        np.testing.assert_allclose(first + second, 2 * plain, rtol=1e-6, atol=1e-9 * np.abs(plain).max())
    assert not np.allclose(all_scores[0].second_order, all_scores[2].second_order, rtol=0.01)
    assert all_scores[0].psnr == all_scores[2].psnr


def test_cost_of_another_shape_is_as_predicted(scene, own):
    """Against the pictures themselves, one axis longer by a little."""
    (_, rows, shape, times, drawn), (pictures, scores) = scene, own
    at = columns(shape.degree)["log_scale"]
    for axis in (0, 1):
        chosen = np.argsort(-scores.by_axes[:, axis])[: len(rows) // 2 : 4]
        cost = []
        for i in chosen:
            changed = rows.copy()
            changed[i, at.start + axis] += 0.05
            cost.append(_error(changed, pictures, shape, times, drawn))
        ratios = np.array(cost) / (0.05**2 * scores.by_axes[chosen, axis])
        assert 0.8 < np.median(ratios) < 1.25


def test_one_gaussian_always_stays():
    _, model, state, _ = fitted("noise", steps=700)
    rows = state.rows[:3]
    shape = ConditioningSpec(3, 1.0, 0.0, SIZE)
    window = find_windows(rows, shape)
    times = np.asarray(model.frame_times.times())
    scores = measure_scores(rows, window, times, shape, _target(noise(24)), compositing="over", options=model.options)
    dear = Economy(bits=1e12, most_dropped=1.0)
    assert len(prune_rows(rows, np.full(3, 3, np.uint8), scores, dear, degree=3, pixels=80.0).stay) == 1


def test_count_of_parameters_is_that_of_the_file():
    """Of each kind, one Gaussian among others of its own, so that kinds are told."""
    _, model, _, _ = fitted("parabola")
    kinds = find_kinds(pack(model.splats), model.degree)
    assert len(np.unique(kinds)) > 5
    alone = dataclasses.replace(model.splats, color_dc=distinct(model, 3), log_scale=distinct(model, 2))
    whole = dataclasses.replace(model, splats=alone)
    others = 2 + model.num_frames - 1  # of the envelope and the frame times
    paths = whole.splats.paths
    if paths is not None:
        others += paths.times.size + paths.matrices.size + -(-len(kinds) // 4)
    assert whole.num_parameters == count_parameters(kinds) + -(-len(kinds) // 4) + others


def distinct(model, width) -> np.ndarray:
    return np.random.default_rng(0).normal(size=(model.num_gaussians, width)).astype(np.float32)


def test_cost_of_opaque_is_as_predicted(scene, mean_scores):
    """Exactly, for one at a time: pictures are linear in an opacity."""
    frames, rows, shape, times, drawn = scene
    at = columns(shape.degree)["opacity_logit"].start
    scores, before = mean_scores, _error(rows, frames, shape, times, drawn)
    told = scores.added_by_opaque(1 / (1 + np.exp(-rows[:, at].astype(float))))
    chosen = np.flatnonzero(told > 0)[:: max(len(rows) // 15, 1)]
    cost = []
    for i in chosen:
        changed = rows.copy()
        changed[i, at] = OPAQUE_LOGIT
        cost.append(_error(changed, frames, shape, times, drawn) - before)
    assert len(cost) >= 8
    assert np.corrcoef(told[chosen], cost)[0, 1] > 0.97
    assert np.abs(told[chosen] - cost).max() < 0.25 * max(map(abs, cost))


def test_few_become_opaque_in_one_round(scene):
    """However dear a number: what is behind one solid Gaussian depends on the others."""
    frames, rows, shape, times, drawn = scene
    scores, kinds = _measured(rows, frames, shape, times, drawn), np.full(len(rows), shape.degree, np.uint8)
    how = {"degree": shape.degree, "pixels": pixels_per_unit(SIZE)}
    made = prune_rows(rows, kinds, scores, Economy(bits=1e6, most_dropped=1e-9), **how)
    solid = is_opaque(made.kinds)
    assert 0 < solid.sum() <= np.ceil(MAX_OPAQUE_FRACTION * len(rows))
    logit = rows[:, columns(2)["opacity_logit"].start].astype(float)
    predicted = scores.added_by_opaque(1 / (1 + np.exp(-logit)))[made.stay]
    assert predicted[solid].max() <= predicted[~solid].min()
    again = prune_rows(made.rows, made.kinds, _measured(made.rows, frames, shape, times, drawn), Economy(), **how)
    assert is_opaque(again.kinds).sum() >= is_opaque(made.kinds)[again.stay].sum()  # those that are stay so


def test_opacities_stay_without_allow_opaque(scene):
    frames, rows, shape, times, drawn = scene
    scores, dear = _measured(rows, frames, shape, times, drawn), Economy(bits=200.0)
    kinds, how = np.full(len(rows), shape.degree, np.uint8), {"degree": shape.degree, "pixels": pixels_per_unit(SIZE)}
    assert is_opaque(prune_rows(rows, kinds, scores, dear, **how).kinds).any()
    assert not is_opaque(prune_rows(rows, kinds, scores, dear, **how, allow_opaque=False).kinds).any()


@pytest.mark.parametrize("sigma", [0.3, 0.6, 2.0])
def test_cost_of_static_is_as_predicted(sigma):
    """One Gaussian that is there at all frames, against pictures of itself."""
    row, at = np.zeros((1, 11 + 2), np.float32), columns(1)
    row[:, at["log_scale"]], row[:, at["opacity_logit"]] = np.log([0.12, 0.08]), 1.0
    row[:, at["color_dc"]], row[:, at["log_time_scale"]] = 1.0, np.log(sigma)
    shape, times = ConditioningSpec(1, 1.0, 0.0, SIZE), np.linspace(0, 1, 9)
    drawn = {"compositing": "over", "options": FitConfig().options}
    own = _pictures(row, shape, times, drawn)
    scores = _mean_scores((own, row, shape, times, drawn), draws=4)
    assert scores.misses[0] == 0
    made = prune_rows(row, np.zeros(1, np.uint8), scores, Economy(bits=1e12), degree=1, pixels=80.0, allow_opaque=False)
    assert made.kinds.tolist() == [STATIC_BIT]
    cost = _error(made.rows, own, shape, times, drawn)
    assert cost == pytest.approx(scores.added_by_static(scores.mean_log_envelope)[0], rel=0.5, abs=1e-6)


def test_finetuning_keeps_the_kinds():
    frames, model, _, _ = fitted("line")
    again = finetune_model(model, lambda k, _: _target(frames)(k), 2)
    np.testing.assert_array_equal(again.splats.static, model.splats.static)
    assert (again.splats.degrees <= model.splats.degrees).all()
    assert evaluate(again, frames).mean_psnr > 45


def test_finetuning_leaves_what_is_fixed():
    """To the bit, and the others come closer to the frames."""
    frames, model, _, _ = fitted("line")
    darker = np.asarray(model.splats.color_dc) * np.float32(0.8)
    worse = dataclasses.replace(model, splats=dataclasses.replace(model.splats, color_dc=darker))
    which = np.arange(model.num_gaussians) % 2 == 0
    fixed = {name: ~which if name == "loc" else which for name in columns(model.degree)}
    again = finetune_model(worse, lambda k, _: _target(frames)(k), 4, fixed=fixed)
    for name, same in fixed.items():
        before, after = (np.asarray(getattr(one.splats, name)) for one in (worse, again))
        np.testing.assert_array_equal(after[same], before[same])
    for name in ("loc", "color_dc", "log_scale"):
        before, after = (np.asarray(getattr(one.splats, name)) for one in (worse, again))
        assert (after[~fixed[name]] != before[~fixed[name]]).any()
    assert evaluate(again, frames).mean_psnr > evaluate(worse, frames).mean_psnr + 1


# ---------------------------------------------------------------------------------------------- settings


@pytest.mark.parametrize(
    "changes",
    [
        {"economy": Economy(rounds=1)},
        {"economy": Economy(), "batch_size": 3, "two_cameras": True, "power": 2.0, "floor": 0.1},
        {"economy": Economy(psnr=25), "minutes": 0.03, "steps": None},
        pytest.param(
            {"economy": Economy(), "degree": 0, "learn_frame_times": False, "follow_motion": False},
            marks=pytest.mark.slow,
        ),
    ],
    ids=str,
)
def test_every_setting_ends_well(changes):
    frames = disc(lambda s: (15 + 50 * s, 24), num_frames=8)
    result = fit(frames, FitConfig(**({"num_gaussians": 120, "steps": 200} | changes)))
    assert result.model.num_gaussians >= 1
    assert evaluate(result.model, frames).mean_psnr > 24


def test_growth_and_economy_together():
    """Dimming leaves so short a plan faint; what does not pay is no loss."""
    frames = disc(lambda s: (15 + 50 * s, 24), num_frames=8)
    growth = Growth(until_step=29_000, from_step=0)
    reached = [
        evaluate(fit(frames, FitConfig(steps=200, economy=economy, **how)).model, frames).mean_psnr
        for economy in (None, Economy())
        for how in [{"num_gaussians": 120, "growth": growth, "max_gaussians": 200}]
    ]
    assert reached[1] > reached[0] - 0.5


def test_rates_decayed_to_zero_stay_zero():
    """In overtime they would else be below 0, and climb."""
    frames = disc(lambda s: (15 + 50 * s, 24), num_frames=8)
    config = FitConfig(num_gaussians=120, steps=200, final_rate=0.0, economy=Economy(psnr=60))
    states = [(info.step, info.loss) for _, info in fit_steps(frames, config)]
    assert states[-1][0] == 300
    late = [loss for step, loss in states if step > 200]
    assert max(late) < 1.5 * max(loss for step, loss in states if 180 < step <= 200)  # below 0: 200 times


@pytest.mark.parametrize("value", [0, 255])
def test_clip_of_one_color_is_fitted(value):
    frames = np.full((8, *SIZE, 3), value, np.uint8)
    model = fit(frames, FitConfig(num_gaussians=200, steps=300, economy=Economy())).model
    assert evaluate(model, frames).mean_psnr > 40
    assert model.num_gaussians <= (20 if value == 0 else 300)  # white has to be covered


@pytest.mark.slow
def test_description_length_decreases():
    frames = disc(lambda s: (15 + 50 * s, 24), num_frames=8)

    def length(economy):
        config = FitConfig(num_gaussians=200, steps=600, economy=economy)
        model = fit(frames, config).model
        squares = [((a.astype(float) - b) ** 2).mean() for a, b in zip(frames, model.frames(), strict=True)]
        return 8 * model.num_parameters + frames.size / 2 * np.log2(1 + np.mean(squares) * 12)

    assert length(Economy()) < length(None)


def test_large_frames_grow_too(monkeypatch):
    """They are seen at half their size at first, which says nothing of what pays."""
    monkeypatch.setattr("foldgauss.video.fitting.schedule.MIN_SIDE", 30)
    frames = np.kron(noise(1)[:, :30, :40], np.ones((1, 2, 2, 1), np.uint8)).repeat(8, 0)
    config = FitConfig(num_gaussians=60, steps=90, half_fraction=0.3, economy=Economy(psnr=60))
    assert [level.size for level in plan_levels(config, frames.shape[1:3])] == [(30, 40), (60, 80)]
    assert max(info.num_gaussians for _, info in fit_steps(frames, config)) > 60


# ---------------------------------------------------------------------------------------------- a PSNR asked for


def test_smallest_model_reaches_its_psnr():
    frames = disc(lambda s: (15 + 50 * s, 12 + 96 * (s - 0.5) ** 2))
    smallest = fit(frames, FitConfig(num_gaussians=300, steps=STEPS, seed=1, economy=Economy(psnr=34)))
    plain = fit(frames, FitConfig(num_gaussians=300, steps=STEPS, degree=1)).model
    assert smallest.history[-1].stopped_by == "smallest_at_psnr"
    assert 34 <= evaluate(smallest.model, frames).mean_psnr < 35.5
    assert smallest.model.num_parameters < 0.35 * plain.num_parameters


def test_a_round_that_falls_far_below_is_tried_again_with_less(monkeypatch):
    """Costs are predicted; where full rounds would leave one Gaussian, smaller ones still reach the target."""
    tried = []

    def misjudged(rows, kinds, scores, economy, **options):
        found = prune_rows(rows, kinds, scores, economy, **options)
        tried.append(economy.most_dropped)
        if economy.most_dropped < Economy().most_dropped:
            return found
        return found._replace(stay=found.stay[:1], rows=found.rows[:1], kinds=found.kinds[:1])

    monkeypatch.setattr(pruner, "prune_rows", misjudged)
    frames = disc(lambda s: (15 + 50 * s, 24), num_frames=8)
    result = fit(frames, FitConfig(num_gaussians=150, steps=300, economy=Economy(psnr=28)))
    assert tried[:2] == [Economy().most_dropped, 0.5 * Economy().most_dropped]
    assert 2 < result.model.num_gaussians < 150
    assert evaluate(result.model, frames).mean_psnr >= 28


def test_psnr_of_alpha_is_over_black():
    """Frames with alpha are measured over other colors than they are held to: half of them are seen through."""
    shape = disc(lambda s: (15 + 50 * s, 24), num_frames=8)
    alpha = np.where(np.abs(shape.astype(int) - shape[0, 0, 0]).max(-1, keepdims=True) > 20, 255, 0).astype(np.uint8)
    frames = np.concatenate([shape * (alpha > 0), alpha], -1)
    result = fit(frames, FitConfig(num_gaussians=200, steps=400, economy=Economy(psnr=26)))
    assert result.history[-1].stopped_by == "smallest_at_psnr"
    assert 26 <= evaluate(result.model, frames).mean_psnr < 28


def test_unreachable_psnr_is_reported():
    result = fit(noise(8), FitConfig(num_gaussians=60, steps=60, economy=Economy(psnr=60)))
    assert result.history[-1].stopped_by == "steps"
    assert result.history[-1].step == 90  # in vain for half as long again
    assert result.model.num_gaussians <= 4 * 60  # births have an end


@pytest.mark.parametrize(
    ("changes", "at"),
    [
        pytest.param({"economy": Economy(rounds=4)}, (30, 60, 110), marks=pytest.mark.slow),
        ({"economy": Economy(psnr=60)}, (60, 130)),  # in overtime
        pytest.param(
            {"growth": Growth(from_step=0, screen_gradient=1e-6), "economy": Economy(rounds=2)},
            (50, 90),
            marks=pytest.mark.slow,
        ),
    ],
    ids=["priced", "smallest", "grown"],
)
def test_resuming_keeps_the_bits(tmp_path, changes, at):
    frames = disc(lambda s: (15 + 50 * s, 24), num_frames=8)
    config = FitConfig(num_gaussians=200, steps=120, **changes)
    kept = {}
    for state, info in fit_steps(frames, config):
        if info.step in at:
            kept[info.step] = save_checkpoint(tmp_path / f"{info.step}.ck", state, config=config, source={})
    for path in kept.values():
        again = load_checkpoint(path, config=config, source={})
        for state_again, _ in fit_steps(frames, config, again):
            pass
        for name in ("rows", "first", "second", "counts", "kinds", "newborn", "frame_errors", "time_logits"):
            np.testing.assert_array_equal(getattr(state_again, name), getattr(state, name))
        for one, other in ((state_again.colors, state.colors), (state_again.shapes, state.shapes)):
            jax.tree.map(np.testing.assert_array_equal, one, other)


@pytest.mark.parametrize(
    ("changes", "name"),
    [
        ({"psnr": 0.0}, r"economy\.psnr"),
        ({"psnr": float("nan")}, r"economy\.psnr"),
        ({"bits": 0}, r"economy\.bits"),
        ({"rounds": 0}, r"economy\.rounds"),
        ({"first_fraction": 0.9}, r"economy\.first_fraction, last_fraction"),
        ({"most_dropped": 2}, r"economy\.most_dropped"),
        ({"grows": "no"}, r"economy\.grows"),
    ],
)
def test_bad_settings_are_refused(changes, name):
    with pytest.raises(ValueError, match=rf"^{name}: expected"):
        Economy(**changes)


@pytest.mark.parametrize("psnr", [None, 30])
def test_target_psnr_and_sums_are_refused(psnr):
    with pytest.raises(ValueError, match=r"^compositing: expected 'over' with an economy"):
        FitConfig(compositing="sum", economy=Economy(psnr=psnr))
    with pytest.raises(ValueError, match=r"^target_psnr: expected None with an economy"):
        FitConfig(target_psnr=30, economy=Economy(psnr=psnr))


def test_rounds_follow_coarse_levels_at_intervals():
    economy = Economy(rounds=3, first_fraction=0.2, last_fraction=0.8)
    assert economy.steps(1000, passes=100, coarse=0.6).tolist() == [650, 725, 800]
    assert economy.steps(1000, passes=100, coarse=0).tolist() == [200, 500, 800]
    assert economy.steps(1000, passes=11, coarse=0).tolist() == [200, 800]
    assert economy.steps(3, passes=0.1, coarse=0).tolist() == [2]
