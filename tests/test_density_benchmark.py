"""`python -m benchmarks.density` on tiny sets: splits, failures, the judgement, and that it goes on after a stop."""

import json

import jax
import numpy as np
import pytest

pytest.importorskip("sklearn", reason="needs the extra sklearn")

from benchmarks import _density_methods, density
from benchmarks._density_data import DATA, DataSet, split
from benchmarks._density_methods import Effort

EFFORT = Effort(components=3, starts=1, max_iter=50, epochs=2)
TINY = ["--points", "200", "--components", "3", "--starts", "1", "--epochs", "2"]
#: Packages that carry a measured set.
MEASURED = {"ECG": "pywt", "CO2": "statsmodels", "El Nino": "statsmodels"}


@pytest.mark.parametrize("name", DATA)
def test_sets_are_standardized_and_the_same_each_time(name):
    if name in MEASURED:
        pytest.importorskip(MEASURED[name], reason="needs the extra bench")
    data = DATA[name](300)
    assert len(data.x) == len(data.groups) == 300
    np.testing.assert_allclose(data.x.mean(0), 0, atol=1e-12)
    np.testing.assert_allclose(data.x.std(0), 1)
    np.testing.assert_array_equal(data.x, DATA[name](300).x)


def test_splits_keep_groups_whole():
    data = DataSet(np.arange(40.0)[:, None], np.repeat(np.arange(10), 4))
    train, test = split(data, 0)
    assert len(train) == len(test) == 20
    assert not set(train.ravel() // 4) & set(test.ravel() // 4)
    assert (split(data, 1)[0] != train).any()


@pytest.mark.parametrize(
    "name",
    [
        name if name == "KernelDensity" else pytest.param(name, marks=pytest.mark.slow)
        for name in _density_methods.METHODS
    ],
)
def test_every_method_is_a_density(name):
    if name == "flow":
        pytest.importorskip("flowjax", reason="needs the extra bench")
    train, _ = split(DATA["moons"](200), 0)
    # flowjax is not written for the suite's strict promotion.
    with jax.numpy_rank_promotion("allow"), jax.numpy_dtype_promotion("standard"):
        fitted = _density_methods.METHODS[name](train, 0, EFFORT)
    axis = np.linspace(-12, 12, 401)
    grid = np.stack(np.meshgrid(axis, axis), -1).reshape(-1, 2)
    with jax.numpy_rank_promotion("allow"), jax.numpy_dtype_promotion("standard"):
        log_density = fitted.log_density(grid)
    assert np.exp(log_density).sum() * (axis[1] - axis[0]) ** 2 == pytest.approx(1, abs=0.02)
    assert fitted.parameters > 0


def run(path, *more):
    density.main([*TINY, "--data", "moons", "--methods", "foldgauss", "KernelDensity", "--json", str(path), *more])
    return json.loads(path.read_text())


@pytest.mark.parametrize("ours", ["stand-in", pytest.param("fitted", marks=pytest.mark.slow)])
def test_it_writes_a_table_and_goes_on_after_a_stop(tmp_path, monkeypatch, ours):
    if ours == "stand-in":  # which takes no time
        monkeypatch.setitem(_density_methods.METHODS, "foldgauss", _density_methods.METHODS["KernelDensity"])
    path = tmp_path / "density.json"
    one = run(path, "--splits", "1")
    asked = []
    fit = density._fit
    monkeypatch.setattr(density, "_fit", lambda *a: asked.append(a[:3]) or fit(*a))
    two = run(path, "--splits", "2")
    assert asked == [("moons", "foldgauss", 1), ("moons", "KernelDensity", 1)]
    assert {name: two["runs"][name] for name in one["runs"]} == one["runs"]
    assert [row["splits"] for row in two["table"]] == [2, 2]
    assert set(two["judged"]) == {"moons"}


def test_failures_are_counted(tmp_path, monkeypatch):
    def fail(x, seed, effort):
        raise ValueError("no density")

    monkeypatch.setitem(_density_methods.METHODS, "foldgauss", fail)
    found = run(tmp_path / "density.json", "--splits", "1")
    assert "no density" in found["runs"]["moons: foldgauss, split 0"]["failed"]
    failed = {row["method"]: row["failed"] for row in found["table"]}
    assert failed == {"foldgauss": 1, "KernelDensity": 0}
    assert not found["judged"]["moons"]["ours_near_the_best"]


def test_the_best_is_judged_by_paired_differences():
    def result(held_out, parameters):
        return {"held_out": held_out, "parameters": parameters, "cpu_seconds": 1.0}

    # Splits differ by far more than methods do: unpaired, all would be within one standard error.
    runs = {}
    for seed, level in enumerate((0.0, 5.0, -5.0)):
        jitter = (0.0, 0.1, -0.1)[seed]
        runs[f"moons: GaussianMixture, split {seed}"] = result(level, 50)
        runs[f"moons: foldgauss, split {seed}"] = result(level - 0.01 + jitter, 20)
        runs[f"moons: flow, split {seed}"] = result(level - 0.5 + jitter, 9)
    rows = density.summarize(runs, "moons", ["foldgauss", "GaussianMixture", "flow"], 3)
    assert [row.method for row in rows] == ["GaussianMixture", "foldgauss", "flow"]
    assert rows[1].below == pytest.approx(-0.01)
    assert rows[1].below_error == pytest.approx(0.1 / 3**0.5)
    judged = density.judge(rows)
    assert judged["near_the_best"] == ["GaussianMixture", "foldgauss"]
    assert judged["ours_at_the_fewest_parameters"]
