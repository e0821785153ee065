"""Model files: exact round trips, and nothing but `ModelFileError` from files that are not one."""

import json
import os
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from safetensors.numpy import load_file, save_file

from foldgauss.io._atomic import atomic_path
from foldgauss.io.models.model_file import Kind, ModelFileError, load_model, read_header, register_model, save_model


class Inner(eqx.Module):
    weight: Any
    kind: str = eqx.field(static=True)


class Toy(eqx.Module):
    """A tree with a module, a dictionary, a list, a missing leaf and a function."""

    inner: Inner
    parts: dict
    layers: list
    nothing: None
    activation: Any
    fps: float = eqx.field(static=True)


def _spec_of(leaf):
    return {"dtype": leaf.dtype.name, "shape": list(leaf.shape)}


def _to_header(toy):
    return {
        "inner": _spec_of(toy.inner.weight),
        "inner_kind": toy.inner.kind,
        "parts": {name: _spec_of(leaf) for name, leaf in toy.parts.items()},
        "layers": [_spec_of(leaf) for leaf in toy.layers],
        "fps": toy.fps,
    }


def _skeleton(spec):
    return jax.ShapeDtypeStruct(tuple(spec["shape"]), jnp.dtype(spec["dtype"]))


def _from_header(header):
    return Toy(
        inner=Inner(_skeleton(header["inner"]), header["inner_kind"]),
        parts={name: _skeleton(spec) for name, spec in header["parts"].items()},
        layers=[_skeleton(spec) for spec in header["layers"]],
        nothing=None,
        activation=jax.nn.relu,
        fps=header["fps"],
    )


register_model(Kind("test-toy", Toy, to_header=_to_header, from_header=_from_header))


def _toy(weight=None, parts=None, layers=(), fps=25.0):
    weight = jnp.arange(6, dtype=jnp.float32).reshape(2, 3) if weight is None else weight
    return Toy(Inner(weight, "polynomial"), parts or {}, list(layers), None, jax.nn.relu, fps)


def _assert_same(saved, loaded):
    assert jax.tree_util.tree_structure(saved) == jax.tree_util.tree_structure(loaded)
    for old, new in zip(jax.tree_util.tree_leaves(saved), jax.tree_util.tree_leaves(loaded), strict=True):
        if callable(old):
            assert old is new
            continue
        assert old.dtype.name == new.dtype.name
        assert old.shape == new.shape
        native = np.asarray(old).astype(np.asarray(old).dtype.newbyteorder("="))
        assert native.tobytes() == np.asarray(new).tobytes()


@pytest.fixture
def saved(tmp_path):
    model = _toy(parts={"mask": np.array([True, False]), "image": np.arange(12, dtype=np.uint8)})
    return save_model(tmp_path / "toy.safetensors", model, metadata={"clip": "bunny"})


# ------------------------------------------------------------------------------------------ round trips


def test_a_header_as_long_as_the_first_bytes_of_an_archive(tmp_path):
    """Its length opens the file: 19,280 bytes are "PK", as in a zip archive."""
    path = tmp_path / "toy.safetensors"
    save_model(path, _toy(), metadata={"clip": ""})
    missing = int.from_bytes(b"PK", "little") - int.from_bytes(path.read_bytes()[:8], "little")
    save_model(path, _toy(), metadata={"clip": "x" * missing})
    assert path.read_bytes()[:8] == b"PK" + bytes(6)
    assert read_header(path)["metadata"] == {"clip": "x" * missing}


def test_every_dtype_layout_and_kind_of_leaf(tmp_path):
    numbers = np.random.default_rng(0).normal(size=(3, 4))
    parts = {
        "f64": numbers,
        "f32": jnp.asarray(numbers, jnp.float32),
        "f16": numbers.astype(np.float16),
        "bf16": jnp.asarray(numbers, jnp.bfloat16),
        "i64": np.array([-(2**62), 2**62 + 1]),
        "i32": jnp.arange(5, dtype=jnp.int32),
        "u8": np.arange(7, dtype=np.uint8),
        "bool": jnp.array([True, False, True]),
        "scalar": np.array(2.5, np.float32),
        "numpy scalar": np.float64(1 / 3),
        "empty": np.zeros((0, 3), np.float32),
        "transposed": np.arange(12, dtype=np.float32).reshape(3, 4).T,
        "strided": np.arange(20, dtype=np.int32)[::-3],
        "big-endian": np.arange(4, dtype=">f4"),
        "special": np.array([np.nan, -np.nan, np.inf, -np.inf, -0.0, 1e-45], np.float32),
    }
    model = _toy(parts=parts, layers=[np.ones(3), jnp.zeros((2, 2))])
    path = save_model(tmp_path / "all.safetensors", model)
    _assert_same(model, load_model(path))
    # An independent reader agrees, key by key.
    assert set(load_file(path)) == ({"inner.weight", "layers.0", "layers.1"} | {f"parts.{name}" for name in parts})


_dtypes = st.sampled_from(["float32", "float64", "int32", "int64", "uint8", "bool", ">f8"])
_arrays = _dtypes.flatmap(
    lambda dtype: hnp.arrays(dtype, hnp.array_shapes(min_dims=0, max_dims=3, min_side=0, max_side=4))
)
_json = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False) | st.text(),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(), inner, max_size=3),
    max_leaves=6,
)


@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    weight=_arrays,
    parts=st.dictionaries(st.text("abc é_/0", min_size=1, max_size=5), _arrays, max_size=4),
    metadata=st.dictionaries(st.text(), _json, max_size=3),
)
def test_round_trip_law(tmp_path, weight, parts, metadata):
    model = _toy(weight, parts, fps=29.97)
    path = save_model(tmp_path / "m", model, metadata=metadata)
    first = path.read_bytes()
    loaded = load_model(path)
    _assert_same(model, loaded)
    assert read_header(path)["metadata"] == metadata
    assert save_model(path, loaded, metadata=metadata).read_bytes() == first


def test_with_64_bits_on_every_leaf_is_a_jax_array(tmp_path):
    path = save_model(tmp_path / "m", _toy(np.array([1 / 3])))
    assert isinstance(load_model(path).inner.weight, np.ndarray)
    with jax.enable_x64(True):
        weight = load_model(path).inner.weight
        assert isinstance(weight, jax.Array)
        assert weight.dtype == jnp.float64


def test_header_tells_without_loading(saved):
    header = read_header(saved)
    assert (header["format"], header["version"], header["kind"]) == ("foldgauss-model", "1", "test-toy")
    assert header["header"]["fps"] == 25.0
    assert header["metadata"] == {"clip": "bunny"}
    assert header["tensors"]["inner.weight"] == {"dtype": "F32", "shape": [2, 3]}


def test_metadata_takes_what_a_fit_produces(tmp_path):
    metadata = {"psnr": np.float32(31.5), "perfect": float("inf"), "frames": (0, 24), "clip": tmp_path}
    header = read_header(save_model(tmp_path / "m", _toy(), metadata=metadata))
    assert header["metadata"] == {"psnr": 31.5, "perfect": None, "frames": [0, 24], "clip": str(tmp_path)}


# --------------------------------------------------------------------------------------- refused to save


class Stranger(eqx.Module):
    weight: jax.Array


@pytest.mark.parametrize(
    ("model", "word"),
    [
        (Stranger(jnp.zeros(2)), "Stranger"),
        (_toy(parts={"rate": 0.5}), "parts.rate"),
        (_toy(parts={"z": np.zeros(2, np.complex64)}), "parts.z"),
        (_toy(parts={"key": jax.random.key(0)}), "parts.key"),
        (_toy(fps=float("nan")), "header"),
    ],
)
def test_what_would_be_lost_is_refused(tmp_path, model, word):
    with pytest.raises(ModelFileError, match=word) as caught:
        save_model(tmp_path / "m", model)
    assert "\n" not in str(caught.value)
    assert list(tmp_path.iterdir()) == []


def test_a_header_that_forgets_a_field_is_refused(tmp_path):
    class Forgetful(eqx.Module):
        weight: Any
        extra: Any
        degree: int = eqx.field(static=True)

    def skeleton(header):
        return Forgetful(jax.ShapeDtypeStruct((2,), jnp.float32), header.get("extra"), 3)

    register_model(Kind("test-forgetful", Forgetful, to_header=lambda _: {}, from_header=skeleton))
    with pytest.raises(ModelFileError, match="structure"):
        save_model(tmp_path / "m", Forgetful(jnp.zeros(2), None, 4))
    with pytest.raises(ModelFileError, match="extra"):
        save_model(tmp_path / "m", Forgetful(jnp.zeros(2), jnp.zeros(1), 3))
    save_model(tmp_path / "m", Forgetful(jnp.zeros(2), None, 3))


def test_one_name_names_one_type():
    register_model(Kind("test-toy", Toy, to_header=_to_header, from_header=_from_header))
    with pytest.raises(ValueError, match="test-toy"):
        register_model(Kind("test-toy", Inner, to_header=_to_header, from_header=_from_header))


# -------------------------------------------------------------------------------------------- bad files


def _refused(path, match=None):
    for read in (read_header, load_model):
        with pytest.raises(ModelFileError, match=match) as caught:
            read(path)
        assert "\n" not in str(caught.value)
        assert str(path) in str(caught.value)


def test_missing_file(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"nowhere\.safetensors"):
        load_model(tmp_path / "nowhere.safetensors")


@pytest.mark.parametrize(
    ("content", "word"),
    [
        (b"", "empty"),
        (b"\x89PNG\r\n\x1a\n" + bytes(60), "PNG"),
        (b"ply\nformat binary_little_endian 1.0\n", "PLY"),
        (b"PK\x03\x04" + bytes(60), "zip"),
        (b"hello, I am a text", "another kind"),
        (b"{", "another kind"),
        ((2**63).to_bytes(8, "little") + b"{" + bytes(50), "claims 9223372036854775808"),
        ((40).to_bytes(8, "little") + b"{" + bytes(50), "damaged"),
        ((2).to_bytes(8, "little") + b"{}", "format 'unknown'"),
        ((4000).to_bytes(8, "little") + b'{"a":' * 800, "damaged"),
    ],
)
def test_files_of_another_kind(tmp_path, content, word):
    path = tmp_path / "other.safetensors"
    path.write_bytes(content)
    _refused(path, word)


def test_a_folder_and_a_foreign_safetensors(tmp_path):
    _refused(tmp_path, "a folder")
    save_file({"a": np.zeros(2)}, tmp_path / "foreign.safetensors")
    _refused(tmp_path / "foreign.safetensors", "format 'unknown'")


def _rewritten(path, change):
    """The same file with `change` applied to its JSON header and tensor bytes."""
    data = path.read_bytes()
    length = int.from_bytes(data[:8], "little")
    entries, body = json.loads(data[8 : 8 + length]), data[8 + length :]
    body = change(entries, body) or body
    text = json.dumps(entries).encode()
    path.write_bytes(len(text).to_bytes(8, "little") + text + body)


def _setter(*keys, to):
    def change(entries, _):
        for key in keys[:-1]:
            entries = entries[key]
        if to is None:
            del entries[keys[-1]]
        else:
            entries[keys[-1]] = to

    return change


def _append(entries, body):
    entries["parts.more"] = {"dtype": "U8", "shape": [1], "data_offsets": [len(body), len(body) + 1]}
    return body + b"\0"


@pytest.mark.parametrize(
    ("change", "word"),
    [
        (_setter("__metadata__", "version", to="2"), "version 2"),
        (_setter("__metadata__", "version", to=None), "version None"),
        (_setter("__metadata__", "format", to="other"), "format 'other'"),
        (_setter("__metadata__", "kind", to=None), "'kind'"),
        (_setter("__metadata__", "header", to="{"), "'header' is not JSON"),
        (_setter("__metadata__", "header", to="[1]"), "'header' is not a JSON object"),
        (_setter("__metadata__", "metadata", to="[" * 100_000), "'metadata' is not JSON"),
    ],
)
def test_a_damaged_header(saved, change, word):
    _rewritten(saved, change)
    _refused(saved, word)


@pytest.mark.parametrize(
    ("change", "word"),
    [
        (_setter("__metadata__", "kind", to="cake"), "kind 'cake'"),
        (_setter("__metadata__", "header", to="{}"), "KeyError"),
        (_setter("inner.weight", "shape", to=[3, 2]), r"inner\.weight.*\[2, 3\].*\[3, 2\]"),
        (_setter("inner.weight", "dtype", to="I32"), r"inner\.weight.*F32.*I32"),
        (_append, r"parts\.more.*no such tensor, got U8"),
        (lambda entries, _: entries.update(other=entries.pop("parts.mask")), "other"),
        (lambda entries, body: body[:-2] + b"\x02\x01", r"parts\.mask.*the byte 2"),
    ],
)
def test_tensors_that_the_header_does_not_describe(saved, change, word):
    _rewritten(saved, change)
    read_header(saved)
    with pytest.raises(ModelFileError, match=word):
        load_model(saved)


def test_a_missing_tensor_is_named(tmp_path, saved):
    with_two = _toy(parts={"a": np.zeros(2, np.uint8), "b": np.zeros(2, np.uint8)})
    path = save_model(tmp_path / "two", with_two)
    one = _toy(parts={"a": np.zeros(2, np.uint8)})
    header = json.dumps(_to_header(with_two))
    path = save_model(tmp_path / "one", one)
    _rewritten(path, _setter("__metadata__", "header", to=header))
    with pytest.raises(ModelFileError, match=r"parts\.b.*got no such tensor"):
        load_model(path)


# ------------------------------------------------------------------------------------------ atomic files


def test_an_error_leaves_the_old_file_and_no_other(tmp_path):
    path = tmp_path / "out.bin"
    path.write_text("old")

    def fail():
        with atomic_path(path) as temporary:
            temporary.write_text("half")
            assert temporary.suffix == ".bin"
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fail()
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_a_new_file_has_the_mode_that_umask_leaves(tmp_path):
    old = os.umask(0o027)
    try:
        with atomic_path(tmp_path / "out") as temporary:
            temporary.write_text("new")
    finally:
        os.umask(old)
    assert (tmp_path / "out").stat().st_mode & 0o777 == 0o640
