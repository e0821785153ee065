"""A reader written from docs/format.md alone, and the decoder of browsers, return the bits that the package returns."""

import dataclasses
import shutil
import subprocess
from pathlib import Path

import equinox as eqx
import numpy as np
import pytest
from format_reader import read, split_layers
from soft_models import crowd, of_degrees, on_paths, soft_model

import foldgauss.io.page
from foldgauss.io import load_video_model, save_compact
from foldgauss.video.compression.quantize import (
    FEATURES,
    Quantized,
    Rule,
    column_names,
    compute_columns,
    is_integral,
    quantize,
)

#: Slopes of the steps by each feature; none is a multiple of 1/2.
SLOPES = (-0.11, 0.3, -0.2, 0.17, -0.08)


def quantize_unevenly(model, *, exponent=-6.3, num_chunks=1) -> Quantized:
    """By steps that depend on all features; chunks of fewer and fewer Gaussians."""
    rng, num = np.random.default_rng(3), model.num_gaussians
    rules = {}
    for name in column_names(model.degree):
        if not is_integral(name):
            known = FEATURES.index(name) if name in FEATURES else len(FEATURES)
            origin = 0.0 if name[0] in "xy" else round(rng.normal(), 3)
            rules[name] = Rule(origin, exponent + rng.uniform(), SLOPES[:known])
    chunks = np.sort((num_chunks * rng.uniform(size=num) ** 1.5).astype(int))[::-1]
    return quantize(compute_columns(model), rng.integers(0, 9, num).astype(np.int32), rules, chunks)


def make_model(copies=1, **options):
    """Gaussians that are visible during the whole clip, a part of it or for next to no time, then moving fast."""
    rng, model = np.random.default_rng(1), soft_model(**options)
    durations = rng.normal(-2.0, 1.2, model.num_gaussians)
    durations[::13] = -40.0
    coefficients = np.array(model.splats.coefficients)
    coefficients[::13, :1] *= 1e13
    leaves = durations.astype(np.float32), coefficients
    return crowd(eqx.tree_at(lambda m: (m.splats.log_time_scale, m.splats.coefficients), model, leaves), copies)


def change_times(model, *, cut):
    """Uneven frame times, some of which coincide, or even ones with a cut."""
    logits = np.random.default_rng(2).normal(size=model.num_frames - 1)
    logits[-2] = -1000.0
    if cut:
        logits = 0.001 * np.arange(len(logits))
        logits[1] += 5.0
    return eqx.tree_at(lambda m: m.frame_times.logits, model, logits.astype(np.float32))


def leaves_of(model):
    """The arrays of a model, named as the reader names them."""
    splats = model.splats
    leaves = {field.name: getattr(splats, field.name) for field in dataclasses.fields(splats)}
    del leaves["envelope"], leaves["paths"]
    if splats.paths is None:
        del leaves["path_index"]
    else:
        leaves |= {"path_times": splats.paths.times, "path_matrices": splats.paths.matrices}
    return {name: np.asarray(leaf) for name, leaf in (leaves | {"frame_times": model.frame_times.logits}).items()}


def check_bits(read_arrays, model):
    expected = leaves_of(model)
    assert set(read_arrays) == set(expected)
    for name, leaf in expected.items():
        found = read_arrays[name]
        assert (found.dtype, found.shape) == (leaf.dtype, leaf.shape), name
        assert found.tobytes() == leaf.tobytes(), name


MODELS = {
    "degree 0": lambda: make_model(degree=0),
    "degree 3": lambda: make_model(3),
    "degree 7": lambda: make_model(degree=7),
    "degree 15": lambda: make_model(degree=15),
    "several degrees": lambda: of_degrees(make_model(5)),
    "portrait": lambda: make_model(2, size=(64, 40)),
    "static": lambda: make_model(num_frames=1),
    "uneven times": lambda: change_times(make_model(), cut=False),
    "many frames": lambda: change_times(make_model(num_frames=600), cut=False),
    "cut": lambda: change_times(make_model(), cut=True),
    "paths at the frames": lambda: on_paths(change_times(make_model(3), cut=False)),
    "paths at the frames, cut": lambda: on_paths(change_times(make_model(), cut=True)),
    "paths at other times": lambda: on_paths(of_degrees(make_model(3)), at_frames=False),
    "paths that lead far": lambda: on_paths(make_model(2), reach=30.0),
    "path of one frame": lambda: on_paths(make_model(num_frames=1)),
}


DECODE = """
import { mkdirSync, readFileSync, writeFileSync } from "node:fs";
import { decode } from "./compact.mjs";
for (const number of process.argv.slice(2)) {
  const file = readFileSync(`${number}.fgz`);
  const { leaves } = decode(file.buffer.slice(file.byteOffset, file.byteOffset + file.length));
  mkdirSync(number);
  for (const [name, own] of Object.entries(leaves)) writeFileSync(`${number}/${name}`, new Uint8Array(own.buffer));
}
"""
#: Of each of these there is another with more of it; the long runs take them.
SLOW = ("degree 3", "degree 7", "portrait", "uneven times", "many frames", "paths at the frames, cut")
SLOW += ("path of one frame", "paths that lead far")


@pytest.mark.parametrize(
    ("name", "num_chunks"),
    [
        *(pytest.param(name, 1, marks=pytest.mark.slow if name in SLOW else []) for name in MODELS),
        ("several degrees", 4),
        ("paths at other times", 4),
    ],
)
def test_the_reader_and_the_decoder_of_browsers_return_the_same_bits(tmp_path, name, num_chunks):
    """The latter is run by node, where there is one."""
    (tmp_path / "compact.mjs").write_bytes(Path(foldgauss.io.page.__file__).with_name("compact.js").read_bytes())
    (tmp_path / "run.mjs").write_text(DECODE)
    models = []
    for exponent in (-0.5, -4.0, -13.0) if num_chunks == 1 else (-6.3,):
        quantized = quantize_unevenly(MODELS[name](), exponent=exponent, num_chunks=num_chunks)
        path = save_compact(tmp_path / f"{len(models)}.fgz", quantized)
        header, arrays = read(path.read_bytes())
        model = load_video_model(path)
        check_bits(arrays, model)
        assert header["num_frames"] == model.num_frames
        assert (tuple(header["size"]), header["degree"]) == (model.size, model.degree)
        assert [chunk["num_gaussians"] for chunk in header["chunks"]] == [chunk.num for chunk in quantized.chunks]
        models.append(model)
    if shutil.which("node"):
        numbers = [str(number) for number in range(len(models))]
        subprocess.run(["node", "run.mjs", *numbers], cwd=tmp_path, check=True, timeout=60)
        for number, model in zip(numbers, models, strict=True):
            for leaf, expected in leaves_of(model).items():
                assert (tmp_path / number / leaf).read_bytes() == expected.tobytes(), leaf


def test_some_chunks_are_the_rows_of_their_gaussians(tmp_path):
    path = save_compact(tmp_path / "m.fgz", quantize_unevenly(make_model(3), num_chunks=4))
    header, whole = read(path.read_bytes())
    numbers = [number for number, chunk in enumerate(header["chunks"]) for _ in range(chunk["num_gaussians"])]
    rows = np.isin(numbers[::-1], [0, 2])
    _, some = read(path.read_bytes(), chunks=[0, 2])
    for name, leaf in whole.items():
        np.testing.assert_array_equal(some[name], leaf if name == "frame_times" else leaf[rows])


def test_damaged_chunks_are_left_out(tmp_path):
    path = save_compact(tmp_path / "m.fgz", quantize_unevenly(make_model(3), num_chunks=3))
    data = bytearray(path.read_bytes())
    header, _ = read(bytes(data))
    lengths = [sum(chunk["streams"]) for chunk in header["chunks"]]
    data[-lengths[2] - 5] ^= 1  # in the second chunk
    path.write_bytes(data)
    with pytest.warns(UserWarning, match="1 of its 3 chunks"):
        model = load_video_model(path)
    check_bits(read(bytes(data))[1], model)
    assert model.num_gaussians == sum(header["chunks"][k]["num_gaussians"] for k in (0, 2))
    # Cut off within the last chunk, as of a file that has not arrived.
    _, arrays = read(bytes(data[:-5]))
    assert len(arrays["loc"]) == header["chunks"][0]["num_gaussians"]


def test_layers_are_told_apart_by_the_page_alone(tmp_path):
    front, back = (quantize_unevenly(model) for model in (make_model(), make_model(2)))
    parts = split_layers(save_compact(tmp_path / "a.fgz", {"front": front, "back": back}).read_bytes())
    assert list(parts) == ["back", "front"]
    for layer, name in zip(load_video_model(tmp_path / "a.fgz").layers, ("front", "back"), strict=True):
        assert layer.name == name
        _, arrays = read(parts[name])
        for leaf, values in leaves_of(layer.model).items():
            np.testing.assert_array_equal(arrays[leaf], values, leaf)
