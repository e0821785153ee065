"""`FitState`: every operation goes by the metadata of its fields, so a new array is added in one place."""

import dataclasses

import jax
import numpy as np
import pytest

from foldgauss.io.models.checkpoint import load_checkpoint, save_checkpoint
from foldgauss.video import FitConfig
from foldgauss.video.fitting.state import (
    ARRAYS,
    STATISTICS,
    DeviceArrays,
    FitState,
    Sizes,
    StateArray,
)
from foldgauss.video.fitting.steppers import jax_stepper
from foldgauss.video.fitting.steppers.jax_stepper import JaxStepper

NUM, WIDTH, FRAMES = 7, 13, 4
SIZES = Sizes(NUM, WIDTH, FRAMES, growing=True)


def random_arrays(sizes: Sizes, kinds: dict[str, StateArray]) -> dict:
    """Values of all arrays, by their metadata, such that no two rows are equal by chance."""
    rng = np.random.default_rng(0)
    fill = lambda leaf: np.asarray(rng.integers(0, 2, leaf.shape), leaf.dtype)  # noqa: E731
    arrays = jax.tree.map(fill, {name: kind.spec(sizes) for name, kind in kinds.items()})
    arrays["rows"] = rng.normal(size=(sizes.num_gaussians, sizes.width)).astype(np.float32)
    arrays["first"] = arrays["rows"] + 1
    return arrays


def make_state(sizes: Sizes = SIZES) -> FitState:
    counters = {"step": 3, "plan": 20, "seconds": 1.5, "best_error": 0.125, "backoffs": 2}
    counters |= {"compare_from": 9, "improve_by": 12, "start_errors": ((0, 0.5), (3, 0.25))}
    return FitState(**random_arrays(sizes, FitState.array_fields()), **counters, growing=sizes.growing)


def assert_equal(one: FitState, other: FitState) -> None:
    assert jax.tree.structure(one) == jax.tree.structure(other)
    jax.tree.map(np.testing.assert_array_equal, one, other)


def test_every_field_has_metadata():
    arrays, counters = FitState.array_fields(), FitState.counter_fields()
    names = {one.name for one in dataclasses.fields(FitState)}
    assert names == {*arrays, *counters, "last_finite"}
    assert tuple(arrays) == ARRAYS
    assert DeviceArrays._fields == ARRAYS


def test_sizes_describe_all_arrays():
    state = make_state()
    assert state.sizes == SIZES
    for name, kind in FitState.array_fields().items():
        value, spec = getattr(state, name), kind.spec(SIZES)
        assert (value.shape, value.dtype) == (spec.shape, spec.dtype), name


def test_a_checkpoint_holds_every_field(tmp_path):
    state = make_state()
    state.last_finite = dataclasses.replace(make_state(Sizes(NUM + 2, WIDTH, FRAMES)), step=2)
    path, config = tmp_path / "checkpoint", FitConfig()
    save_checkpoint(path, state, config=config, source={})
    assert_equal(load_checkpoint(path, config=config, source={}), state)


def test_a_copy_has_every_field_and_its_own_arrays():
    state = make_state()
    state.last_finite = make_state()
    copy = state.copy()
    assert copy.last_finite is None
    assert_equal(copy, dataclasses.replace(state, last_finite=None))
    for one, other in zip(jax.tree.leaves(copy), jax.tree.leaves(state), strict=False):
        assert not np.shares_memory(one, other)


def test_restore_takes_every_array_back():
    state, kept = make_state(), make_state(Sizes(NUM - 2, WIDTH, FRAMES))
    kept.rows += 1
    state.last_finite, state.step = kept, 17
    state.restore()
    assert state.step == 17
    for name in ARRAYS:
        np.testing.assert_array_equal(getattr(state, name), getattr(kept, name))


def test_keep_cuts_every_per_gaussian_array():
    state, before, index = make_state(), make_state(), np.array([5, 0, 3])
    state.keep(index)
    for name, kind in FitState.array_fields().items():
        if name not in STATISTICS:
            then = getattr(before, name)
            np.testing.assert_array_equal(getattr(state, name), then[index] if kind.per_gaussian else then)
    assert not any(part.any() or len(part) != 3 for part in state.statistics)
    assert state.sizes == SIZES._replace(num_gaussians=3)


def test_extend_fills_every_per_gaussian_array():
    state, before = make_state(), make_state()
    rows = np.full((2, WIDTH), 5, np.float32)
    state.extend(rows)
    given = {"rows": rows}
    for name, kind in FitState.array_fields().items():
        if kind.per_gaussian:
            new = given.get(name, kind.build(Sizes(2, WIDTH, FRAMES)))
            np.testing.assert_array_equal(getattr(state, name), np.concatenate([getattr(before, name), new]))
    assert state.sizes == Sizes(NUM + 2, WIDTH, FRAMES, growing=True)


@pytest.mark.parametrize("growing", [False, True])
def test_a_device_gives_every_array_back(monkeypatch, growing):
    """Arrays are padded there, and fetched without the padding."""
    for name in ("compile_step", "compile_error"):  # no step is taken here
        monkeypatch.setattr(jax_stepper, name, lambda program: None)
    frames = np.zeros((FRAMES, 8, 8, 3), np.uint8)
    config = FitConfig(num_gaussians=NUM, degree=1, steps=1, engine="xla")
    sizes = Sizes(NUM, 13, FRAMES)
    if growing:
        config = FitConfig.preset("paper", num_gaussians=NUM, max_gaussians=9, degree=1, steps=1, engine="xla")
        sizes = sizes._replace(growing=True)
    state, before = make_state(sizes), make_state(sizes)
    JaxStepper(frames, config, state, "xla")
    assert state.held is not None
    assert repr(state) == f"FitState(step 3, {NUM} Gaussians)"
    copy = state.copy()
    assert not state.changed
    state.rows = before.rows + 1
    assert state.changed
    for one in (state, copy):
        one.fetch_all()
        assert one.held is None
    for name in ARRAYS:
        np.testing.assert_array_equal(getattr(copy, name), getattr(before, name))
        np.testing.assert_array_equal(getattr(state, name), getattr(before, name) + (name == "rows"))
