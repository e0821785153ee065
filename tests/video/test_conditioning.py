"""The fused conditioning kernels against `FoldedGaussian.condition_time`: values and gradients."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from path_models import moving_splats, path_model, random_paths, random_splats

from foldgauss._runtime.threads import run_tasks
from foldgauss.envelope import TimeLikelihood
from foldgauss.render import RenderOptions, Splats2D, pixels_per_unit
from foldgauss.video import FrameTimes, VideoModel
from foldgauss.video.models import conditioning
from foldgauss.video.models.conditioning import (
    ConditioningSpec,
    PreparedModel,
    backpropagate,
    condition,
    find_windows,
    mirror,
)
from foldgauss.video.models.row_layout import columns, pack, unpack
from foldgauss.video.models.shared_paths import SharedPaths
from foldgauss.video.models.splats import TAU_MAX

SIZE, T = (48, 80), np.float32(0.4)


def twin(splats, power, floor):
    rows, shape = pack(splats), ConditioningSpec(splats.degree, power, floor, SIZE, paths=splats.paths)
    return rows, shape, condition(rows, find_windows(rows, shape), T, shape)


def in_pixels(splats):
    model = VideoModel(splats, FrameTimes.uniform(2), SIZE, 25.0, RenderOptions())
    return model.at(jnp.asarray(T))


#: Splats of their own, and some on shared paths: what makes them, degree, power, floor.
CASES = [
    *((random_splats, degree, *of) for degree in (0, 1, 3, 7) for of in ((1.0, 0.0), (2.0, 0.0), (2.0, 0.05))),
    *((random_splats, degree, 0.0, 0.0) for degree in (0, 3)),
    *((moving_splats, degree, 2.0, 0.0) for degree in (0, 3)),
]


@pytest.mark.parametrize(("make", "degree", "power", "floor"), CASES)
def test_kernel_values_match_condition_time(make, degree, power, floor):
    splats = make(degree=degree, power=power, floor=floor)
    home = jax.jit(in_pixels)(splats)
    _, _, done = twin(splats, power, floor)
    alive = np.flatnonzero(np.asarray(home.opacity) > 0)
    assert 50 < len(alive) < splats.num_gaussians  # some are too far away in time
    np.testing.assert_array_equal(done.alive, alive)
    np.testing.assert_allclose(done.mean, home.mean[alive], rtol=1e-5, atol=2e-4 if splats.paths is None else 5e-4)
    np.testing.assert_allclose(done.opacity, home.opacity[alive], rtol=1e-5)
    np.testing.assert_allclose(done.color, home.color[alive], atol=1e-6)
    cov = done.factor @ np.swapaxes(done.factor, 1, 2)  # the factors differ by a rotation
    home_cov = np.asarray(home.factor @ jnp.swapaxes(home.factor, 1, 2))[alive]
    np.testing.assert_allclose(cov, home_cov, rtol=2e-4, atol=1e-5 * np.abs(home_cov).max())


@pytest.mark.parametrize(
    ("make", "degree", "power", "floor"),
    [case for case in CASES if case[0] is random_splats and case[1] in (0, 3) and case[2]]
    + [(moving_splats, 3, 1.0, 0.0)],
)
def test_kernel_gradients_match_autodiff(make, degree, power, floor):
    """Of a loss that looks at mean, covariance, opacity and color with random weights; of time, or of paths' maps."""
    splats = make(degree=degree, power=power, floor=floor)
    rows, shape, done = twin(splats, power, floor)
    rng = np.random.default_rng(1)
    w_mean, w_cov = rng.normal(size=done.mean.shape), rng.normal(size=done.factor.shape) / 50
    w_opacity, w_color = rng.normal(size=done.opacity.shape), rng.normal(size=done.color.shape)
    weights = [w.astype(np.float32) for w in (w_mean, w_cov + np.swapaxes(w_cov, 1, 2), w_opacity, w_color)]

    def loss(leaves, maps, t):
        paths = None if maps is None else SharedPaths(jnp.zeros((2, 1), maps.dtype), maps[:, None])
        model = dataclasses.replace(splats, **leaves, paths=paths)
        home = VideoModel(model, FrameTimes.uniform(2), SIZE, 25.0, RenderOptions()).at(t)
        cov = home.factor @ jnp.swapaxes(home.factor, 1, 2)
        parts = zip((home.mean, cov, home.opacity, home.color), weights, strict=True)
        return sum(jnp.sum(part[done.alive] * weight) for part, weight in parts)

    with jax.enable_x64(True):
        wide = {name: jnp.asarray(getattr(splats, name), jnp.float64) for name in columns(degree)}
        maps = None if splats.paths is None else jnp.asarray(splats.paths.at(T), jnp.float64)
        weights = [w.astype(np.float64) for w in weights]
        slopes = jax.jit(jax.grad(loss, (0, 1, 2)))(wide, maps, jnp.float64(T))
        by_leaves, by_maps, by_time = jax.tree.map(np.asarray, slopes)
        weights = [w.astype(np.float32) for w in weights]

    grad, path_grad = np.zeros_like(rows), None if maps is None else np.zeros((2, 2, 3))
    d_factor = 2 * weights[1] @ done.factor  # of sum(W * F F^T), W symmetric
    d_time = backpropagate(rows, done, (weights[0], d_factor, weights[2], weights[3]), shape, grad, path_grad)
    for name, place in columns(degree).items():
        truth = by_leaves[name].reshape(len(rows), -1)
        largest = max(np.abs(truth).max(initial=0), 1e-3)
        np.testing.assert_allclose(
            grad[:, place] / largest, truth / largest, atol=1e-5 if maps is None else 2e-5, err_msg=name
        )
    if maps is not None:
        np.testing.assert_array_equal(grad[:, -1], 0)  # the number of the path
        np.testing.assert_allclose(path_grad, by_maps, rtol=1e-4, atol=1e-5 * np.abs(by_maps).max())
    assert d_time == pytest.approx(float(by_time), rel=1e-3, abs=1e-6 * float(np.abs(grad).sum()))


@pytest.mark.parametrize(
    ("power", "floor", "cutoff"), [(1.0, 0.0, 0.02), (2.0, 0.02, 0.02), (1.0, 0.3, 0.03), (0.0, 0.0, 0.05)]
)
def test_scale_cutoff_keeps_the_times_when_both_scales_exceed_it(power, floor, cutoff):
    rows, spec, _ = twin(random_splats(power=power, floor=floor), power, floor)
    window = find_windows(rows, spec)
    cut = find_windows(rows, dataclasses.replace(spec, scale_cutoff=cutoff))
    at = columns(spec.degree)
    center, spread = 1 / (1 + np.exp(-rows[:, at["time_loc_logit"]])), np.exp(rows[:, at["log_time_scale"]])
    t = np.linspace(window.min(1), window.max(1), 102, axis=1)[:, 1:-1]
    a = floor + (1 - floor) * np.exp(-0.5 * power * ((t - center) / spread) ** 2)
    smaller = np.exp(rows[:, at["log_scale"]].min(1, keepdims=True)) * np.sqrt(a)
    kept = (cut[:, :1] < t) & (t < cut[:, 1:])
    np.testing.assert_array_equal(kept, smaller > cutoff)
    assert 0.2 < kept.mean() < 0.8


def test_a_scale_that_equals_the_cutoff_is_left_out():
    # With power 0 the scale is constant. Otherwise it is the scale at tau = 0, times exp(-power tau^2 / 4).
    rows, spec = np.zeros((1, 11), np.float32), ConditioningSpec(0, 0.0, 0.0, SIZE)
    for power, cutoff, reach in ((0, 1.0, 0), (0, 0.999, TAU_MAX), (1e3, 1e-200, np.sqrt(800 * np.log(10) / 1e3))):
        window = find_windows(rows, dataclasses.replace(spec, power=float(power), scale_cutoff=cutoff))
        np.testing.assert_allclose(window, [[0.5 - reach, 0.5 + reach]], rtol=1e-6)


def test_windows_are_open_intervals_and_only_members_are_alive():
    rows, spec, _ = twin(random_splats(), 2.0, 0.0)
    window, members = np.float32([[T, 1], [0, T], [0, 1], [0, 1]]), np.array([True, True, True, False])
    np.testing.assert_array_equal(condition(rows, window, T, spec).alive, [2, 3])
    np.testing.assert_array_equal(condition(rows, window, T, spec, members).alive, [2])


def random_gradients(done):
    rng = np.random.default_rng(2)
    return [rng.normal(size=of.shape).astype(np.float32) for of in (done.mean, done.factor, done.opacity, done.color)]


def test_results_do_not_depend_on_the_tasks(monkeypatch):
    # Tasks of 24 Gaussians, from the last to the first, give the windows, splats and gradients of a single task.
    results = []
    for chunk, run in ((4096, run_tasks), (24, lambda task, starts: [task(start) for start in reversed(starts)])):
        monkeypatch.setattr(conditioning, "CHUNK", chunk)
        monkeypatch.setattr(conditioning, "run_tasks", run)
        rows, spec, done = twin(moving_splats(), 2.0, 0.0)
        grad, path_grad = np.zeros_like(rows), np.zeros((2, 2, 3))
        d_time = backpropagate(rows, done, random_gradients(done), spec, grad, path_grad)
        splats = [getattr(done, name) for name in ("alive", "mean", "factor", "opacity", "color", "kept")]
        results.append([find_windows(rows, spec), grad, *splats, path_grad, d_time])
    for one, other in zip(*results, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-5, atol=1e-7 * np.abs(one).max())


def test_rows_without_a_column_of_paths_are_not_moved():
    rows, spec, done = twin(random_splats(), 2.0, 0.0)
    resting = condition(rows, find_windows(rows, spec), T, dataclasses.replace(spec, paths=random_paths()))
    np.testing.assert_array_equal(resting.mean, done.mean)
    path_grad = np.zeros((2, 2, 3))
    backpropagate(rows, resting, random_gradients(done), spec, np.zeros_like(rows), path_grad)
    np.testing.assert_array_equal(path_grad, 0)


def test_scales_far_from_their_time_are_accurate():
    # Down to exp(-70), where the envelope is no normal float32; the gradient is finite.
    rows, spec = np.zeros((1, 11), np.float32), ConditioningSpec(0, 280 / 9, 0.0, SIZE)
    done, grad = condition(rows, find_windows(rows, spec), 3.5, spec), np.zeros_like(rows)  # at tau = -3
    scale = pixels_per_unit(SIZE) * np.exp(-70)
    np.testing.assert_allclose(np.sqrt(np.sum(np.float64(done.factor) ** 2, axis=1)), [[scale, scale]], rtol=1e-4)
    assert np.isfinite([backpropagate(rows, done, random_gradients(done), spec, grad), *grad[0]]).all()


def test_mirror_reverses_x():
    mean, factor = np.float32([[3, 5], [50, -1]]), np.arange(8, dtype=np.float32).reshape(2, 2, 2)
    expected = [[37, 5], [-10, -1]], [[[0, -1], [2, 3]], [[-4, -5], [6, 7]]]
    for found, truth in zip(mirror(mean, factor, 40), expected, strict=True):
        np.testing.assert_array_equal(found, truth)


@pytest.mark.parametrize(("own", "aspect"), [({}, 0.6), ({"aspect": 1.5}, 1.5)])
def test_prepared_models_have_the_models_settings(own, aspect):
    # The envelope, the cutoff of scales, and the aspect of the model's frame unless another is given.
    splats = random_splats(floor=0.02)
    model = VideoModel(splats, FrameTimes.uniform(2), SIZE, 25.0, RenderOptions(), scale_cutoff=0.02)
    prepared = PreparedModel(model, (48, 200), **own)
    spec = ConditioningSpec(3, 2.0, np.float32(0.02), (48, 200), aspect=aspect, scale_cutoff=0.02)
    done = condition(pack(splats), find_windows(pack(splats), spec), T, spec)
    expected = Splats2D(done.mean, done.factor, done.opacity, done.color)
    jax.tree.map(np.testing.assert_array_equal, prepared.splats(T), expected)
    for value, field in ((spec, "size"), (done, "mean")):
        with pytest.raises(dataclasses.FrozenInstanceError):
            setattr(value, field, None)


BROKEN = np.where(np.isin(np.arange(300), [3, 5, 7])[:, None], [np.nan, 0], 0).astype(np.float32)


def test_models_that_cannot_be_prepared_raise():
    splats = dataclasses.replace(random_splats(), loc=BROKEN)
    with pytest.raises(ValueError, match=r"^model: .* others in 3 Gaussians"):
        PreparedModel(VideoModel(splats, FrameTimes.uniform(2), SIZE, 25.0, RenderOptions()), SIZE)


@pytest.mark.parametrize("name", ["power", "floor"])
@pytest.mark.parametrize("shape", [(300,), (1,)])
def test_splats_have_one_envelope(name, shape):
    """Whichever way they are rendered."""
    with pytest.raises(ValueError, match=r"^envelope: expected a TimeLikelihood with one power and one floor.*layers"):
        dataclasses.replace(random_splats(), envelope=TimeLikelihood(**{name: np.full(shape, 0.5, np.float32)}))


@pytest.mark.parametrize("missing", ["paths", "path_index"])
def test_splats_have_paths_and_their_index_or_neither(missing):
    with pytest.raises(ValueError, match=r"^path_index: expected one where there are paths"):
        dataclasses.replace(path_model().splats, **{missing: None})


@pytest.mark.parametrize("degree", [0, 3])
def test_unpack_inverts_pack(degree):
    splats = random_splats(degree=degree)
    again = unpack(pack(splats), degree, splats.envelope)
    jax.tree.map(np.testing.assert_array_equal, splats, again)
    places = np.concatenate([np.arange(place.start, place.stop) for place in columns(degree).values()])
    np.testing.assert_array_equal(np.sort(places), np.arange(11 + 2 * degree))
