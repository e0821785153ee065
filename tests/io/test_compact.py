"""Compact files: the same bits everywhere, and nothing breaks on bad ones."""

import dataclasses
import json
import os
import re
import zlib
from operator import attrgetter
from pathlib import Path

import equinox as eqx
import jax
import numpy as np
import pytest
from soft_models import NUM, SIZE, assert_same, crowd, of_degrees, on_paths, only, soft_model

import foldgauss.video.compression.chunks as chunks_module
from foldgauss.io import ModelFileError, load_compact, load_video_model, save_compact
from foldgauss.io.models.compact import (
    MAGIC,
    VERSION,
    _parse_cells,
    is_compact,
    leave_room,
    load_compact_model,
    measure_chunks,
    pack_compact,
)
from foldgauss.io.models.video_model import read_metadata
from foldgauss.render import RenderOptions
from foldgauss.video import FitConfig, compress, layers
from foldgauss.video.compression.chunks import LEAST, arrange, divide, divide_anew, find_layers, visible_spans
from foldgauss.video.compression.quantize import (
    LARGEST,
    MAX_CELL_BITS,
    MAX_CHUNKS,
    MAX_PATH_BITS,
    MAX_TIME_BITS,
    TIME_BITS,
    Rule,
    _choose_degrees,
    column_names,
    compute_columns,
    dequantize,
    is_integral,
    quantize,
    quantize_chunk,
)
from foldgauss.video.compression.quantizer import estimate_sensitivities
from foldgauss.video.models.metrics import evaluate
from foldgauss.video.models.renderer import VideoRenderer
from foldgauss.video.models.shared_paths import SharedPaths
from foldgauss.video.selection.contributions import Contributions


def clip_of(model, noise=6.0):
    """Its pictures, with noise: what it might have been fitted to."""
    rng = np.random.default_rng(5)
    pictures = np.stack(list(model.frames())).astype(float)
    return np.clip(np.rint(pictures + noise * rng.normal(size=pictures.shape)), 0, 255).astype(np.uint8)


def fine(model, exponent=-22.0, chunks=None):
    """Quantized by even steps of 2^exponent."""
    rules = {name: Rule(0.0, exponent) for name in column_names(model.degree) if not is_integral(name)}
    return quantize(compute_columns(model), np.zeros(model.num_gaussians, np.int32), rules, chunks)


def cells_of(quantized):
    """Binary logarithms of the numbers of cells, of a model in a single chunk."""
    (chunk,) = quantized.chunks
    return chunk.cells


def with_columns(quantized, **columns):
    """With other integers in its single chunk."""
    (chunk,) = quantized.chunks
    return dataclasses.replace(quantized, chunks=(dataclasses.replace(chunk, columns=chunk.columns | columns),))


def pictures(model):
    return np.stack(list(model.frames())).astype(float)


def image(model, t):
    """Not rounded, and without a compilation for each model."""
    return VideoRenderer(model).image(t)


# ------------------------------------------------------------------------------------ what is kept


@pytest.mark.parametrize("degree", [0, 1, 2, 3, 7])
def test_fine_steps_reproduce_the_image(degree):
    model = soft_model(degree=degree, options=RenderOptions())
    again = dequantize(fine(model))
    for t in (0.0, 0.37, 1.0):
        np.testing.assert_allclose(image(again, t), image(model, t), atol=2e-3)
    assert (again.size, again.fps, again.options) == (model.size, model.fps, model.options)
    assert again.degree == degree


@pytest.mark.parametrize("how", [{"power": 0.0}, {"power": 1.0}, {"floor": 0.05}, {"compositing": "sum"}])
def test_envelopes_and_compositings(tmp_path, how):
    model = soft_model(**how)
    path = save_compact(tmp_path / "m.fgz", fine(model))
    again = load_video_model(path)
    assert again.compositing == model.compositing
    assert float(again.splats.envelope.power) == float(model.splats.envelope.power)
    assert float(again.splats.envelope.floor) == pytest.approx(float(model.splats.envelope.floor))
    np.testing.assert_allclose(image(again, 0.4), image(model, 0.4), atol=2e-3)


def test_the_order_of_gaussians_is_kept():
    model = soft_model()
    np.testing.assert_allclose(dequantize(fine(model)).splats.opacity_logit, model.splats.opacity_logit, atol=1e-5)


def test_frame_times_and_cut_are_kept():
    model = soft_model()
    logits = np.float32([0.1, -0.3, 3.5, 0.0, 0.2, 40.0])
    model = eqx.tree_at(lambda m: m.frame_times.logits, model, logits)
    again = dequantize(fine(model))
    np.testing.assert_allclose(again.frame_times.times(), model.frame_times.times(), atol=1e-3)


def with_cuts(model):
    """The first two intervals are those of cuts."""
    logits = np.full(5, 0.001).cumsum()
    logits[:2] += np.log([149.7, 151.3])
    return eqx.tree_at(lambda m: m.frame_times.logits, model, np.float32(logits))


def test_frames_after_cuts_keep_their_times(tmp_path):
    model = with_cuts(soft_model(num_frames=6))
    quantized = fine(model)
    assert quantized.info.time_bits > TIME_BITS == fine(soft_model()).info.time_bits
    again = load_video_model(save_compact(tmp_path / "m.fgz", quantized))
    times = np.asarray(model.frame_times.times(), np.float64)
    assert np.abs(np.asarray(again.frame_times.times()) - times).max() < 0.006 * np.median(np.diff(times))


def test_degrees_are_kept(tmp_path):
    """Powers above a Gaussian's own degree stay +0."""
    model = of_degrees(soft_model(degree=3))
    again = load_video_model(save_compact(tmp_path / "m.fgz", fine(model)))
    np.testing.assert_array_equal(again.splats.degrees, model.splats.degrees)
    assert again.num_parameters == model.num_parameters
    absent = np.arange(3) >= model.splats.degrees[:, None]
    np.testing.assert_array_equal(np.asarray(again.splats.coefficients).view(np.int32)[absent], 0)
    for t in (0.0, 0.37, 1.0):
        np.testing.assert_allclose(image(again, t), image(model, t), atol=2e-3)


@pytest.mark.parametrize("told", ["faint", "coarse"])
def test_file_with_few_gaussians_left_can_be_read(tmp_path, told):
    """Cells are counted anew, for those that stay."""
    model = crowd(soft_model(degree=3), 40)
    if told == "faint":
        opacity = np.asarray(model.splats.opacity_logit).copy()
        opacity[np.arange(len(opacity)) % 10 > 0] = -12
        model = eqx.tree_at(lambda m: m.splats.opacity_logit, model, opacity)
    made = compress(model, quality=100 if told == "faint" else 0)
    assert made.model.num_gaussians < model.num_gaussians / 4
    assert_same(load_video_model(save_compact(tmp_path / "m.fgz", made.quantized)), made.model)


def test_power_that_saves_little_is_dropped():
    """Its squared error, in steps, against what a number's bits are worth."""
    saved = np.array([[9.0, 9.0, 9.0], [1.0, 0.5, 0.2], [0.8, 0.2, 4.0]])
    np.testing.assert_array_equal(_choose_degrees(saved), [1, 0, 2])
    model = soft_model(degree=3)
    coarse = fine(model, -7.0)
    degrees = dequantize(coarse).splats.degrees
    np.testing.assert_array_equal(degrees, coarse.columns["degree"])
    assert 0 < (degrees < 3).sum() < len(degrees)


def test_low_degrees_save_bytes():
    plain = crowd(soft_model(degree=3))
    assert len(pack_compact(fine(of_degrees(plain)))) < 0.9 * len(pack_compact(fine(plain)))


# ------------------------------------------------------------------------------------ shared paths


@pytest.mark.parametrize("at_frames", [True, False])
def test_shared_paths_are_kept(tmp_path, at_frames):
    model, logits = soft_model(degree=3, options=RenderOptions()), np.float32([0, 0.1, -0.3, 0.2, -7.0, 2.5])
    model = on_paths(eqx.tree_at(lambda m: m.frame_times.logits, model, logits), at_frames=at_frames)
    if not at_frames:  # two knots at one time, where a path jumps
        jumping = np.array(model.splats.paths.times)[:, [0, 1, 1, 3, 4]]
        model = eqx.tree_at(lambda m: m.splats.paths.times, model, jumping)
    quantized = fine(model)
    assert quantized.info.paths.at_frames == at_frames
    path = save_compact(tmp_path / "m.fgz", quantized)
    again = load_video_model(path)
    assert_same(again, dequantize(quantized))
    assert pack_compact(load_compact(path)) == path.read_bytes()
    np.testing.assert_array_equal(again.splats.path_index, model.splats.path_index)
    frames = np.tile(again.frame_times.times(), (2, 1))
    times, atol = (frames, 2e-7) if at_frames else (model.splats.paths.times, 1e-7)
    np.testing.assert_allclose(again.splats.paths.times, times, atol=atol)
    for t in (0.0, 0.37, 1.0):
        np.testing.assert_allclose(image(again, t), image(model, t), atol=1e-2)


@pytest.mark.parametrize("reach", [1.0, 30.0])
def test_maps_are_displaced_by_less_than_a_fiftieth_of_a_pixel(reach):
    """Also where the path leads far out of the frame."""
    model = on_paths(soft_model(options=RenderOptions()), reach=reach)
    loc = np.asarray(model.splats.loc) * reach
    model = eqx.tree_at(lambda m: m.splats.loc, model, loc.astype(np.float32))
    maps, decoded = (np.asarray(own.splats.paths.matrices, float) for own in (model, dequantize(fine(model))))
    low, high = np.quantile(loc, [0.005, 0.995], axis=0)
    corners = np.array([[x, y, 1] for x in (low[0], high[0]) for y in (low[1], high[1])])
    moved = np.abs((decoded - maps) @ corners.T).max() * max(model.size)
    assert 0.001 < moved < 0.02


def test_cells_divide_the_positions_on_paths(tmp_path):
    """Positions far out of the frame are in cells of their own, not all in those at its edge."""
    model = on_paths(crowd(soft_model(options=RenderOptions()), 20))
    where = np.asarray(model.splats.loc) * np.float32([6, 1]) + np.float32([3, 0])
    model = eqx.tree_at(lambda m: m.splats.loc, model, where)
    quantized = fine(model, -10.0)
    assert cells_of(quantized)[0] > 2
    assert len(np.unique(quantized.columns["cell"])) > 0.4 * 2 ** sum(cells_of(quantized))
    within = dataclasses.replace(quantized.info.paths, middle=(0.0, 0.0), sides=(1.0, 0.625))
    exact = compute_columns(model)
    exact = dataclasses.replace(exact, info=dataclasses.replace(exact.info, paths=within))
    by_frame = quantize(exact, quantized.columns["class"], quantized.rules)
    assert len(np.unique(by_frame.columns["cell"])) < 0.4 * 2 ** sum(cells_of(quantized))
    np.testing.assert_allclose(dequantize(by_frame).splats.loc, where, atol=2e-3)
    assert_same(load_video_model(save_compact(tmp_path / "m.fgz", by_frame)), dequantize(by_frame))


def test_shared_paths_need_few_bytes():
    """Smooth motion over 90 frames, and a number of each Gaussian that its cell's others have as well."""
    plain = crowd(soft_model(options=RenderOptions(), num_frames=90), 50)
    t = np.asarray(plain.frame_times.times())[:, None, None]
    motion = np.eye(2, 3) + np.sin(3 * t + np.arange(6).reshape(2, 3)) * np.array([0.05, 0.05, 0.2])
    motion += 0.0005 * np.random.default_rng(0).normal(size=motion.shape)  # an unsteady hand
    paths = SharedPaths(np.tile(t.ravel(), (2, 1)), np.stack([motion, motion[::-1]]).astype(np.float32))
    index = np.where(np.asarray(plain.splats.loc)[:, 0] < 0.1, 1, 2).astype(np.uint8)
    without = len(pack_compact(fine(plain, -10.0)))
    on_one = dataclasses.replace(
        plain.splats, path_index=np.ones_like(index), paths=jax.tree.map(lambda x: x[:1], paths)
    )
    one = len(pack_compact(fine(dataclasses.replace(plain, splats=on_one), -10.0)))
    on_two = dataclasses.replace(plain.splats, path_index=index, paths=paths)
    two = len(pack_compact(fine(dataclasses.replace(plain, splats=on_two), -10.0)))
    assert one - without < 800
    assert two - one < 800 + 0.5 * len(index) / 8


@pytest.mark.parametrize("how", [{}, {"steps": 30}], ids=["alone", "clip"])
def test_models_with_shared_paths_are_compressed(tmp_path, how):
    model = on_paths(soft_model(degree=3, options=RenderOptions()))
    clip = clip_of(model)
    made = compress(model, clip if how else None, quality=90, **how)
    again = load_video_model(save_compact(tmp_path / "m.fgz", made.quantized))
    assert_same(again, made.model)
    assert evaluate(model, clip).mean_psnr - evaluate(again, clip).mean_psnr < 0.5


def test_sensitivity_is_that_to_parameters_before_the_path():
    """A path that doubles all sizes makes positions matter more, by about the factor of the image's area."""
    model = soft_model(degree=1, options=RenderOptions())
    half = np.float32([[[[0.5, 0, 0], [0, 0.5, 0]]]])
    splats = dataclasses.replace(
        model.splats,
        loc=model.splats.loc * 2,
        log_scale=model.splats.log_scale + np.float32(np.log(2)),
        coefficients=model.splats.coefficients * 2,
        path_index=np.ones(model.num_gaussians, np.uint8),
        paths=SharedPaths(np.zeros((1, 1), np.float32), half),
    )
    found = [
        estimate_sensitivities(Contributions(one), compute_columns(one))[0]
        for one in (model, dataclasses.replace(model, splats=splats))
    ]
    for name in found[0]:
        by = 4 if name in ("x0", "y0", "x1", "y1") else 1
        np.testing.assert_allclose(by * found[1][name], found[0][name], rtol=2e-2, atol=1e-3 * found[0][name].max())


def with_paths(quantized, **changed):
    """With another fact of its paths."""
    paths = dataclasses.replace(quantized.info.paths, **changed)
    return dataclasses.replace(quantized, info=dataclasses.replace(quantized.info, paths=paths))


def test_wrong_paths_are_refused(tmp_path):
    quantized, path = fine(on_paths(soft_model())), tmp_path / "m.fgz"
    index, maps = np.full_like(quantized.columns["path"], 3), np.full_like(quantized.maps, 2**30)
    maps[:, 0] = 2**29  # each step is within the range
    falling = fine(on_paths(soft_model(), at_frames=False))
    falling.knots[1, 1] = falling.knots[1, 0] - 1
    files = {
        "knots: .* got times that decrease": falling,
        "path: .* got numbers out of range": with_columns(quantized, path=index),
        "maps: .* got numbers out of range": dataclasses.replace(quantized, maps=maps),
        "bits": with_paths(quantized, bits=29),
        "at_frames": with_paths(quantized, at_frames=1),
        "middle": with_paths(quantized, middle=(0.0, 1e10)),
        "sides": with_paths(quantized, sides=(1e-9, 1.0)),
    }
    for message, wrong in files.items():
        save_compact(path, wrong)
        with pytest.raises(ModelFileError, match=message):
            load_compact(path)
    data = pack_compact(quantized)
    for key, value in [
        ("num_paths", 0),
        ("num_paths", 256),
        ("num_knots", 0),
        ("num_knots", "7"),
        ("at_frames", 1),
        ("bits", -1),
        ("bits", MAX_PATH_BITS + 1),
        ("middle", "ab"),
        ("middle", [0.0]),
        ("sides", [0.0, 1.0]),
    ]:
        refused(tmp_path, resealed(data, lambda header: header["paths"].update({key: value})), f"{key}: expected")  # noqa: B023
    refused(tmp_path, resealed(data, lambda header: header["paths"].update(num_knots=6)), "at_frames: expected")


# ------------------------------------------------------------------------------------ fewer bits


def test_a_lower_quality_makes_a_smaller_file():
    model = soft_model(options=RenderOptions())
    sizes = [len(pack_compact(compress(model, quality=quality).quantized)) for quality in (100, 70, 40)]
    assert sizes == sorted(sizes, reverse=True)
    assert sizes[-1] < 0.85 * sizes[0]


@pytest.mark.parametrize("how", ["opaque", "alpha", "sum"])
def test_a_clip_makes_better_models(how):
    """A model that is not at its best is fitted further while its parameters are rounded."""
    best = soft_model(options=RenderOptions(), compositing="sum" if how == "sum" else "over")
    if how == "sum":  # where they add up to no more than white
        best = eqx.tree_at(lambda m: m.splats.opacity_logit, best, best.splats.opacity_logit - np.float32(2.5))
    rng = np.random.default_rng(0)
    color = best.splats.color_dc + 0.1 * rng.normal(size=best.splats.color_dc.shape).astype(np.float32)
    model = eqx.tree_at(lambda m: m.splats.color_dc, best, color)
    clip = clip_of(best, noise=2.0)
    if how == "alpha":  # as the model itself lets light through
        over_white = np.stack(list(best.frames(background=(1.0, 1.0, 1.0)))).astype(float)
        alpha = 255 - (over_white - pictures(best)).mean(-1, keepdims=True)
        clip = np.concatenate([np.minimum(clip, alpha), alpha], -1).round().astype(np.uint8)
    plain, fitted = (
        compress(model, frames, quality=80, **more) for frames, more in ((None, {}), (clip, {"steps": 200}))
    )
    assert evaluate(fitted.model, clip).mean_psnr > evaluate(plain.model, clip).mean_psnr + 0.5
    assert len(pack_compact(fitted.quantized)) < 1.1 * len(pack_compact(plain.quantized))


def test_the_order_found_shortens_the_column_of_cells():
    """Nine in ten steps go on in a sweep; in the model's own order half of them go back."""
    model = crowd(soft_model(degree=3, options=RenderOptions()))
    order, _ = arrange(model, np.inf, layered=False)
    assert sorted(order) == list(range(model.num_gaussians))
    sweep = only(model, order)
    back = [(np.diff(fine(one).columns["cell"]) < 0).mean() for one in (model, sweep)]
    assert back[0] > 0.4
    assert back[1] < 0.15


# ------------------------------------------------------------------------------------ chunks


def thirds(model):
    """Numbers of three chunks, the front one first, which decrease."""
    return 2 - 3 * np.arange(model.num_gaussians) // model.num_gaussians


def short_lived(model, num_chunks=3):
    """Each chunk visible in a part of the clip only, but the first, which is visible throughout; and their numbers."""
    chunks = num_chunks - 1 - num_chunks * np.arange(model.num_gaussians) // model.num_gaussians
    middle = (chunks - 0.5) / (num_chunks - 1)
    place = np.where(chunks == 0, 0.0, np.log(middle.clip(1e-3) / (1 - middle.clip(1e-3)))).astype(np.float32)
    duration = np.where(chunks == 0, 0.0, np.log(0.2 / (num_chunks - 1) / 3)).astype(np.float32)
    leaves = lambda m: (m.splats.time_loc_logit, m.splats.log_time_scale)  # noqa: E731
    return eqx.tree_at(leaves, model, (place, duration)), chunks


def blocks_of(data):
    """The first byte of motion and of each chunk, and the end."""
    header, body = parts_of(data)
    sizes = [sum(own["streams"]) for own in (header["motion"], *header["chunks"])]
    return [int(x) for x in len(data) - len(body) + np.cumsum([0, *sizes])]


def flipped(data, place):
    return data[:place] + bytes([data[place] ^ 16]) + data[place + 1 :]


CUT_OFF = r"m.fgz'?: (\d) of its 3 chunks (?:is|are) cut off or damaged; (\d+) of 402 Gaussians are missing"


@pytest.fixture(scope="module")
def chunked():
    """A model of 402 Gaussians in three chunks, and its file."""
    model = only(crowd(soft_model(degree=2, options=RenderOptions()), 11), np.arange(402))
    model, chunks = short_lived(model)
    quantized = fine(model, -12.0, chunks)
    return quantized, pack_compact(quantized, {"clip": "x"})


@pytest.mark.parametrize("how", [{"degree": 2}, {"degree": 0}, {"num_frames": 1}, {"compositing": "sum"}, "paths"])
def test_chunks_do_not_change_the_model(tmp_path, how):
    model = crowd(soft_model(**({} if how == "paths" else how)), 5)
    model = on_paths(model) if how == "paths" else model
    one, several = fine(model, -9.0), fine(model, -9.0, thirds(model))
    assert [chunk.num for chunk in several.chunks] == [66, 67, 67]
    path = save_compact(tmp_path / "m.fgz", several)
    assert_same(load_video_model(path), dequantize(one))
    assert pack_compact(load_compact(path)) == path.read_bytes()


def test_only_visible_chunks_are_read(tmp_path, chunked):
    """The bytes of the others may be anything. Images are the same at all times for which the model was read."""
    quantized, data = chunked
    path, model, ends = tmp_path / "m.fgz", dequantize(quantized), blocks_of(data)
    spans = [own["visible"] for own in parts_of(data)[0]["chunks"]]
    assert spans[0] == [0, 1]
    assert spans[1][1] < spans[2][0]
    first, last = spans[2][0], spans[1][1]  # visible then, too
    for number, visible in (
        (1, (0.0, last)),
        (1, (0.2, 0.2)),
        (1, (last, last + 0.001)),
        (2, (first, 1.0)),
        (2, (0.7, 0.8)),
        (2, (first - 0.001, first)),
    ):
        other = 3 - number
        start, end = ends[other + 1 : other + 3]
        path.write_bytes(data[:start] + bytes(end - start) + data[end:])
        own = load_compact(path, visible=visible)
        assert [chunk.num for chunk in own.chunks] == [134, 134]
        for t in np.linspace(*visible, 3):
            np.testing.assert_array_equal(image(dequantize(own), t), image(model, t))
        with pytest.warns(UserWarning, match=CUT_OFF):
            load_compact(path)
    between = (spans[1][1] + 0.001, spans[2][0] - 0.001)
    assert load_compact(path, visible=between).num_gaussians == 134


def test_the_first_chunk_is_read_even_if_nothing_is_visible(tmp_path):
    model = soft_model()
    early = np.full(model.num_gaussians, -5.0, np.float32)
    leaves = lambda m: (m.splats.time_loc_logit, m.splats.log_time_scale)  # noqa: E731
    path = save_compact(tmp_path / "m.fgz", fine(eqx.tree_at(leaves, model, (early, early))))
    assert load_compact(path, visible=(0.5, 0.6)).num_gaussians == 40


@pytest.mark.parametrize("time", [0.93, 0.999999])
def test_spans_hold_what_is_visible_at_times_that_coarse_steps_move(tmp_path, time):
    """A decoded time may lie beyond the clip; the model has it within."""
    model = soft_model(degree=1)
    names = [name for name in column_names(1) if not is_integral(name)]
    rules = {name: Rule(1.05 if name == "time" else 0.0, -12.0) for name in names}
    where = np.full(model.num_gaussians, np.log(time / (1 - time)), np.float32)
    leaves = lambda m: (m.splats.time_loc_logit, m.splats.log_time_scale)  # noqa: E731
    model = eqx.tree_at(leaves, model, (where, np.full_like(where, -4.0)))
    rules["time"] = Rule(1.05, 0.0)
    quantized = quantize(compute_columns(model), np.zeros(40, np.int32), rules)
    (first, last), splats = parts_of(pack_compact(quantized))[0]["chunks"][0]["visible"], dequantize(quantized).splats
    at = 1 / (1 + np.exp(-np.asarray(splats.time_loc_logit, float)))
    reach = np.sqrt(-2 * np.log(0.01)) * np.exp(np.asarray(splats.log_time_scale, float))
    assert first <= (at - reach).min() < first + 3e-4
    assert last >= min((at + reach).max(), 1) > last - 3e-4


def test_visible_span_is_rounded_outward():
    """To steps of 1e-4, with a margin for the rounding to float32."""
    quantized = fine(only(soft_model(degree=0), np.arange(2)))
    (chunk,), zeros = quantized.chunks, np.zeros(2, np.int32)
    columns = chunk.columns | {"cell": zeros, "duration": zeros, "time": np.int32([0, 2])}
    rules = quantized.rules | {"time": Rule(0.3, 0.0), "duration": Rule(-40.0, 0.0)}  # momentary, at 0.3 and 0.55
    momentary = dataclasses.replace(
        quantized, rules=rules, chunks=(dataclasses.replace(chunk, cells=(0, 0, 0), columns=columns),)
    )
    assert parts_of(pack_compact(momentary))[0]["chunks"][0]["visible"] == [0.2999, 0.5501]


@pytest.mark.parametrize("visible", [(0.5, 0.2), (0.0, 1.5), (0.5,), 0.5, "ab", (np.nan, 1.0), None])
def test_times_to_be_read_are_checked(tmp_path, good, visible):
    path = tmp_path / "m.fgz"
    path.write_bytes(good)
    with pytest.raises(ValueError, match=r"visible: expected the first and the last time, in \[0, 1\], got"):
        load_compact(path, visible=visible)


def test_a_file_cut_off_after_a_chunk_is_a_smaller_model(tmp_path, chunked):
    quantized, data = chunked
    path, ends = tmp_path / "m.fgz", blocks_of(data)
    for length, num in ((ends[2], 1), (ends[2] + 1, 1), (ends[3] - 1, 1), (ends[3], 2), (len(data) - 1, 2)):
        path.write_bytes(data[:length])
        with pytest.warns(UserWarning, match=CUT_OFF) as caught:
            model = load_video_model(path)
        (note,) = caught
        assert note.filename == __file__
        assert re.search(CUT_OFF, str(note.message)).groups() == (str(3 - num), str(134 * (3 - num)))
        assert_same(model, dequantize(dataclasses.replace(quantized, chunks=quantized.chunks[:num])))
        assert measure_chunks(path) == (np.diff(ends[1:]).tolist(), len(data))


def test_a_damaged_chunk_is_left_out(tmp_path, chunked):
    quantized, data = chunked
    path, ends = tmp_path / "m.fgz", blocks_of(data)
    for number in range(3):
        path.write_bytes(flipped(data, ends[number + 1] + 50))
        with pytest.warns(UserWarning, match=CUT_OFF) as caught:
            own = load_compact(path)
        assert [(note.filename, "134 of 402" in str(note.message)) for note in caught] == [(__file__, True)]
        assert ("among them the largest" in str(caught[0].message)) == (number == 0)
        left = quantized.chunks[:number] + quantized.chunks[number + 1 :]
        assert_same(dequantize(own), dequantize(dataclasses.replace(quantized, chunks=left)))


def test_a_file_without_header_motion_or_any_chunk_is_rejected(tmp_path, chunked):
    _, data = chunked
    ends = blocks_of(data)
    refused(tmp_path, flipped(data, 60), "the checksum of its header")
    refused(tmp_path, data[:19], "cut off after 19 bytes")
    refused(tmp_path, data[:20], "the checksum of its header")
    listed = json.dumps([parts_of(data)[0]]).encode()
    numbers = (VERSION, len(listed), zlib.crc32(listed))
    refused(tmp_path, MAGIC + np.array(numbers, "<u4").tobytes() + listed, "one whose header is not JSON of a model")
    refused(
        tmp_path,
        flipped(data, ends[0]),
        "^path: expected a compact model, got one whose frame times are cut off or damaged",
    )
    refused(tmp_path, data[: ends[2] - 1], "3 of its 3 chunks are cut off or damaged; 402 of 402 Gaussians are missing")
    for start in ends[1:-1]:
        data = flipped(data, start + 3)
    refused(tmp_path, data, "one without a chunk that can be read .3 of its 3 chunks are cut off or damaged")


def test_divide_by_size_and_by_time():
    rng = np.random.default_rng(0)
    num = 20 * LEAST
    volume, first = rng.normal(size=num), rng.uniform(0, 0.95, num)
    last = first + rng.choice([0.01, 0.04, 0.6], num)
    numbers = np.unique(divide(find_layers(volume), first, last), return_inverse=True)[1]
    num_chunks = numbers.max() + 1
    assert sorted(set(numbers)) == list(range(num_chunks))
    assert num_chunks > 4
    assert (numbers == 0).sum() == round(0.08 * num)
    assert volume[numbers == 0].min() > volume[numbers > 0].max()
    assert np.bincount(numbers)[1:].min() >= LEAST
    layers = np.searchsorted([0.08 * num, 0.4 * num], np.argsort(np.argsort(-volume)), side="right")
    assert all(len(set(layers[numbers == number])) == 1 for number in range(num_chunks))
    for layer in (1, 2):
        around, before = sorted(set(numbers[layers == layer]))[:2]
        assert (first[numbers == around] <= 0.5).all()
        assert (last[numbers == around] >= 0.5).all()
        assert (last[numbers == before] < 0.5).all()
        assert first[numbers == max(numbers[layers == layer])].min() > 0.5


def test_chunks_follow_visible_spans_that_have_changed(monkeypatch):
    """Gaussians that live longer than before move to the chunk around; the others stay in their order."""
    monkeypatch.setattr(chunks_module, "LEAST", 50)
    model = crowd(soft_model(degree=1, options=RenderOptions()), 20)
    model = only(model, np.argsort(np.asarray(model.splats.time_loc_logit), kind="stable"))
    short = np.full(model.num_gaussians, -5.0, np.float32)
    short[::3] = 0
    model = eqx.tree_at(lambda m: m.splats.log_time_scale, model, short)
    order, chunks = arrange(model, 0.0)
    model = only(model, order)
    assert len(np.unique(chunks)) > 4
    np.testing.assert_array_equal(divide_anew(model, chunks)[0], np.arange(len(order)))
    longer = np.asarray(model.splats.log_time_scale).copy()
    longer[7::40] = 0
    model = eqx.tree_at(lambda m: m.splats.log_time_scale, model, longer)
    order, anew = divide_anew(model, chunks)
    moved = order != np.arange(len(order))
    assert moved.any()
    assert (np.diff(anew) <= 0).all()
    stayed = np.isin(order, np.flatnonzero(np.arange(len(order)) % 40 != 7))
    np.testing.assert_array_equal(np.sort(order[stayed]), order[stayed])
    spans = visible_spans(compute_columns(model).values["time"][order], longer[order])
    for number in np.unique(anew)[2:]:  # a chunk before or after the middle
        within = anew == number
        assert not (spans[0][within].min() < 0.5 < spans[1][within].max()) or number % 1024 == 0


@pytest.mark.parametrize("compositing", ["over", "sum"])
def test_large_gaussians_are_behind_in_the_first_chunk(monkeypatch, compositing):
    monkeypatch.setattr(chunks_module, "LEAST", 100)
    model = crowd(soft_model(degree=1, options=RenderOptions(), compositing=compositing), 20)
    order, chunks = arrange(model, np.inf)
    assert sorted(order) == list(range(800))
    assert chunks.max() >= 2
    assert (np.diff(chunks) <= 0).all()
    values = compute_columns(model).values
    volume = 2 * values["size"][order] + np.log(np.minimum(np.exp(values["duration"][order]), 1))
    assert volume[chunks == 0].mean() > volume[chunks > 0].mean() + 0.5
    assert (chunks == 0).sum() == 64
    made = fine(only(model, order), -9.0, chunks)
    for chunk in made.chunks if compositing == "sum" else ():  # sorted by the cells of the chunk itself
        assert (np.diff(chunk.columns["cell"]) >= 0).all()


# ------------------------------------------------------------------------------------ exactness


def test_equal_numbers_are_equal_files_and_equal_models(tmp_path):
    quantized = compress(soft_model(options=RenderOptions())).quantized
    path = save_compact(tmp_path / "m.fgz", quantized, metadata={"clip": "x", "bad": float("nan")})
    again = load_compact(path)
    assert pack_compact(again, read_metadata(path)) == path.read_bytes()
    assert_same(dequantize(again), dequantize(quantized))
    assert_same(load_video_model(path), dequantize(quantized))
    assert read_metadata(path) == {"clip": "x", "bad": None}


@pytest.mark.parametrize("change", [lambda model: model, crowd, of_degrees])
def test_a_decoded_model_by_the_same_rules_is_the_same_file(change):
    """Quantising is a projection: what was rounded is not rounded further."""
    quantized = compress(change(soft_model(options=RenderOptions()))).quantized
    columns = quantized.columns
    exact = compute_columns(dequantize(quantized))
    again = quantize_chunk(exact, columns["class"], quantized.rules, columns["cell"])
    assert pack_compact(dataclasses.replace(quantized, chunks=(again,))) == pack_compact(quantized)


def test_a_quarter_turn_stays_one_where_angles_have_few_values():
    """float32 decodes it to a little less, which is the other end of the half turn."""
    exact, classes = compute_columns(soft_model()), np.zeros(NUM, np.int32)
    rules = fine(soft_model()).rules | {"angle": Rule(0.0, 30.0)}  # steps of an eighth
    once = quantize(exact, classes, rules)
    again = quantize(compute_columns(dequantize(once)), classes, rules)
    assert (once.columns["angle"] == 2).any()
    np.testing.assert_array_equal(again.columns["angle"], once.columns["angle"])


# ------------------------------------------------------------------------------------ extremes


def test_one_gaussian(tmp_path):
    model = only(soft_model(options=RenderOptions()), np.array([20]))
    made = compress(model, clip_of(model), quality=90, steps=20)
    path = save_compact(tmp_path / "m.fgz", made.quantized)
    assert_same(load_video_model(path), made.model)
    assert path.stat().st_size < 2500


@pytest.mark.parametrize(
    ("leaf", "value"),
    [
        ("log_scale", 12.0),
        ("coefficients", 1e4),
        *(
            pytest.param(*case, marks=pytest.mark.slow)
            for case in [
                ("log_time_scale", -30.0),
                ("opacity_logit", 60.0),
                ("log_scale", -60.0),
                ("log_time_scale", 30.0),
                ("time_loc_logit", 40.0),
                ("time_loc_logit", -40.0),
                ("angle_logit", 50.0),
                ("loc", 1e4),
                ("color_dc", 1e3),
            ]
        ),
    ],
)
def test_extremes_of_values(leaf, value):
    model = soft_model(options=RenderOptions())
    changed = np.asarray(getattr(model.splats, leaf)).copy()
    changed[5] = value
    model = eqx.tree_at(lambda m: getattr(m.splats, leaf), model, changed)
    clip = clip_of(model)
    before = evaluate(model, clip).mean_psnr
    for made, most in ((compress(model, quality=90), 0.05), (compress(model, clip, quality=90, steps=200), 0.3)):
        assert all(np.isfinite(one).all() for one in jax.tree.leaves(made.model))
        # Training sees a color of 1000 as it is, pictures clip it: what is around it is fitted anew.
        if not (leaf == "color_dc" and most == 0.3):
            assert evaluate(made.model, clip).mean_psnr > before - most


def changed(path, change, model=None):
    """A model with other values of a leaf, named by its path."""
    leaf = attrgetter(path)
    return eqx.tree_at(leaf, soft_model() if model is None else model, replace_fn=change)


def spread(distance):
    """A change of a path's arrays: the values at the first knot become `-distance`, the others `distance`."""
    return lambda own: (
        np.where(np.arange(own.shape[1]) > 0, distance, -distance).astype(np.float32).reshape(-1, *[1] * (own.ndim - 2))
        + 0 * own
    )


#: What is made, and the error.
REFUSED = {
    "a map out of range": (
        lambda: fine(changed("splats.paths.matrices", lambda own: own + np.float32(1e9), on_paths(soft_model()))),
        "paths whose maps are within the range",
    ),
    "NaN in a map": (
        lambda: fine(changed("splats.paths.matrices", lambda own: own * np.float32(np.nan), on_paths(soft_model()))),
        "finite times and matrices",
    ),
    "late knots": (
        lambda: fine(changed("splats.paths.times", lambda own: own + np.float32(100), on_paths(soft_model()))),
        "shared paths whose knots are within the range",
    ),
    "maps far apart": (
        lambda: fine(changed("splats.paths.matrices", spread(200_000), on_paths(soft_model()))),
        "paths whose maps are within the range",
    ),
    "maps far from the identity": (
        lambda: fine(
            changed("splats.paths.matrices", lambda own: 0 * own - np.float32(262_143), on_paths(soft_model()))
        ),
        "paths whose maps are within the range",
    ),
    "knots far apart": (
        lambda: fine(changed("splats.paths.times", spread(60), on_paths(soft_model(), at_frames=False))),
        "shared paths whose knots are within the range",
    ),
    "another path": (
        lambda: compress(changed("splats.path_index", lambda own: 0 * own + np.uint8(3), on_paths(soft_model()))),
        "path_index: expected paths from 0 to 2, got 3",
    ),
    "chunks that increase": (
        lambda: fine(crowd(soft_model(), 30), -9.0, np.arange(1200, dtype=np.uint16) // 400),
        "chunks: expected numbers that do not increase",
    ),
    "many chunks": (
        lambda: fine(crowd(soft_model(), 30), -9.0, np.arange(1200)[::-1]),
        "chunks: expected at most 1024 of them, got 1200",
    ),
    **{
        str(value): (
            lambda value=value: compress(changed("splats.loc", lambda own: np.where(own == own[0], value, own))),
            "expected finite numbers",
        )
        for value in np.float32([np.nan, np.inf])
    },
    "edits": (
        lambda: compress(layers(soft_model(), soft_model())),
        "model: expected a VideoModel, got EditedVideo",
    ),
    "degree 16": (lambda: compress(soft_model(degree=16)), "degree: expected at most 15"),
    "degree 16 of a fit": (lambda: FitConfig(degree=16), "degree: expected .* 15"),
    "two frames": (lambda: compress(soft_model(), np.zeros((2, *SIZE, 3), np.uint8)), "frames: expected uint8"),
    **{
        f"quality {quality}": (
            lambda quality=quality: compress(soft_model(), quality=quality),
            r"quality: expected a number in \[0, 100\]",
        )
        for quality in (-1, 101, np.nan, "a")
    },
    "nothing visible": (
        lambda: compress(changed("splats.opacity_logit", lambda own: np.full_like(own, -90))),
        "model: expected visible Gaussians",
    ),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_the_format_cannot_hold_is_rejected(name):
    make, text = REFUSED[name]
    with pytest.raises(ValueError, match=text):
        make()


# ------------------------------------------------------------------------------------ bad files


@pytest.fixture(scope="module")
def good():
    return pack_compact(fine(soft_model(), -12.0), {"clip": "x"})


def parts_of(data):
    """The header and the bytes after it."""
    start = len(MAGIC) + 12
    end = start + int.from_bytes(data[len(MAGIC) + 4 : len(MAGIC) + 8], "little")
    return json.loads(data[start:end]), data[end:]


def resealed(data, change=lambda header: None, cut=None, spaces=0):
    """The file with another header, spaces after it, and the checksums it then has: what a stranger may send."""
    header, body = parts_of(data)
    body, end = body[:cut], 0
    for own in (header["motion"], *header["chunks"]):
        start, end = end, end + sum(own["streams"])
        own["crc"] = zlib.crc32(body[start:end])
    change(header)
    text = json.dumps(header).encode() + b" " * spaces
    numbers = (VERSION, len(text), zlib.crc32(text))
    return MAGIC + b"".join(number.to_bytes(4, "little") for number in numbers) + text + body


def refused(tmp_path, data, match):
    path = tmp_path / "m.fgz"
    path.write_bytes(data)
    with pytest.raises(ModelFileError, match=match):
        load_video_model(path)


@pytest.mark.parametrize(("version", "cure"), [(7, "Update foldgauss"), (5, "Compress the model again")])
def test_another_version_is_rejected(tmp_path, good, version, cure):
    data = bytearray(good)
    data[len(MAGIC)] = version
    refused(tmp_path, bytes(data), f"expected a compact model of version 6, .* got version {version} .* {cure}")


def test_changed_by_a_transfer_as_text(tmp_path, good):
    refused(tmp_path, good.replace(b"\r\n", b"\n", 1), "a transfer as text has changed")


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        *(
            (key, value, f"{key}: expected")
            for key, value in [
                ("num_gaussians", 10**12),
                ("num_gaussians", 0),
                ("num_gaussians", 3.5),
                ("num_frames", 10**12),
                ("num_frames", 0),
                ("degree", -1),
                ("degree", 10**9),
                ("size", [0, 5]),
                ("size", [10**12, 5]),
                ("size", "no"),
                ("fps", -1),
                ("power", 1e300),
                ("floor", 1.0),
                ("reach", 0),
                ("compositing", "under"),
                ("rules", []),
                ("rules", 5),
                ("chunks", []),
                ("chunks", 5),
                ("chunks", [{}] * (MAX_CHUNKS + 1)),
                ("streams", []),
                ("streams", 5),
                ("streams", [10**30] * 24),
                ("visible", [0.5]),
                ("visible", ["a", "b"]),
                ("visible", {"0": 0, "1": 1}),
                ("visible", [0.6, 0.4]),
                ("visible", [0, 1.5]),
                ("visible", 5),
                ("cells", [0, 0]),
                ("cells", [0, 0, -1]),
                ("cells", [30, 30, 30]),
                ("cells", [2, 2, 2]),
                ("cells", [5, 0, 0]),
                ("cells", [0, 3, 0]),
                ("cells", 5),
                ("scale_cutoff", True),
                ("time_bits", 25),
                ("time_bits", -1),
                ("time_bits", 10.5),
            ]
        ),
        ("num_gaussians", 39, "a column of numbers is damaged"),
        ("cells", [0, 0, 5], "a column of numbers is damaged"),
        ("cells", [2, 2, 0], "a column of numbers is damaged"),
        ("degree", 2, "streams: expected"),
        ("options", {"low_pass": -1}, "low_pass: expected"),
        ("options", {"unknown": 1}, "unexpected keyword argument"),
        ("chunks", [5], "one that does not fit together"),
        ("motion", 0, "one that does not fit together"),
        ("motion", {"streams": [0, 0], "crc": 0}, "streams: expected"),
        ("metadata", 5, "one whose header is not JSON of a model"),
    ],
)
def test_forged_header_is_rejected(tmp_path, good, key, value, message):
    def change(header):
        where = header if key in header else header["chunks"][0]
        assert key in where
        where[key] = value

    refused(tmp_path, resealed(good, change), message)


@pytest.mark.parametrize("cells", [[0, 0], [0, 0, -1], {"a": 0, "b": 0, "c": 0}])
def test_the_error_names_the_entry(tmp_path, good, cells):
    refused(tmp_path, resealed(good, lambda header: header["chunks"][0].update(cells=cells)), "cells: expected")


def test_largest_sizes_and_degrees_are_read(tmp_path):
    quantized, path = fine(soft_model(degree=15), -12.0), tmp_path / "m.fgz"

    def pack(size):
        info = dataclasses.replace(quantized.info, size=size, time_bits=MAX_TIME_BITS)
        return pack_compact(dataclasses.replace(quantized, info=info))

    path.write_bytes(pack((1 << 20, 5)))
    again = load_video_model(path)
    assert (again.size, again.degree) == ((1 << 20, 5), 15)
    refused(tmp_path, pack((5, (1 << 20) + 1)), "size")


@pytest.mark.parametrize("number", [4, -1])
def test_forged_degrees_are_rejected(tmp_path, number):
    quantized = fine(of_degrees(soft_model(degree=3)), -12.0)
    degree = quantized.columns["degree"].copy()
    degree[7] = number
    refused(tmp_path, pack_compact(with_columns(quantized, degree=degree)), "degree: .* got numbers out of range")


def test_smallest_and_largest_constants_are_read(tmp_path, good):
    quantized, path = fine(on_paths(soft_model()), -12.0), tmp_path / "m.fgz"
    quantized.maps[0, :, 0, 2] = LARGEST
    for size, time_bits, bits in (((1, 1), 0, 0), ((1 << 20, 5), MAX_TIME_BITS, MAX_PATH_BITS)):
        own = with_paths(quantized, bits=bits)
        own = dataclasses.replace(own, info=dataclasses.replace(own.info, size=size, time_bits=time_bits))
        again = load_compact(save_compact(path, own))
        assert again.info == own.info
        np.testing.assert_array_equal(again.maps, own.maps)
    path.write_bytes(resealed(good, lambda header: header["chunks"][0].update(visible=[0.5, 0.5])))
    assert load_compact(path).num_gaussians == NUM
    assert _parse_cells([8, 8, 8], 1 << MAX_CELL_BITS) == (8, 8, 8)


def test_values_beyond_float32_are_rejected(tmp_path):
    """One value of one Gaussian is enough."""
    quantized = fine(soft_model(degree=3))
    own = with_columns(quantized, x3=np.eye(1, NUM, dtype=np.int32)[0], degree=np.full(NUM, 3, np.int32))
    rules = own.rules | {"duration": Rule(-40.0, 0.0), "x3": Rule(0.0, 60.0)}
    refused(tmp_path, pack_compact(dataclasses.replace(own, rules=rules)), "one with values beyond float32")


def test_rules_have_the_numbers_that_they_may_have(tmp_path, good):
    """Origin, exponent, and at most as many slopes as there are columns of features before."""
    names, path = column_names(3), tmp_path / "m.fgz"

    def with_more(name, more):
        return resealed(good, lambda header: header["rules"][names.index(name)].extend(more))

    for name, slopes in (("size", 1), ("stretch", 2), ("green", 5)):
        path.write_bytes(with_more(name, [0.0] * slopes))
        assert load_compact(path).rules[name].slopes == (0.0,) * slopes
        refused(tmp_path, with_more(name, [0.0] * (slopes + 1)), f"rule: expected .* got {name}")
    refused(tmp_path, with_more("green", [2e9]), "rule: expected .* got green")
    refused(tmp_path, with_more("class", [0.0, 0.0]), "rules: expected .* got some of columns of integers")


def test_file_has_a_byte_for_every_32_numbers(tmp_path):
    """All alike, they need next to nothing, and the file is filled up: none may claim more than its length allows."""
    num, num_frames = 10_000, soft_model().num_frames
    described = compute_columns(only(soft_model(degree=0), np.full(num, 20)))
    origins = {name: float(value[0]) for name, value in described.values.items()}
    rules = {name: Rule(origins.get(name, 0.0), 3.0) for name in column_names(0) if not is_integral(name)}
    quantized = quantize(described, np.zeros(num, np.int32), rules)
    num_bytes = -(-(num * len(quantized.columns) + num_frames) // 32)
    path = save_compact(tmp_path / "m.fgz", quantized)
    assert num_bytes <= path.stat().st_size < num_bytes + 30
    assert load_video_model(path).num_gaussians == num
    data = path.read_bytes()
    header, _ = parts_of(data)
    own = header["chunks"][0]["streams"]
    spaces = -(-num * len(own) // 32) - sum(own) - len(json.dumps(header))
    path.write_bytes(resealed(data, spaces=spaces))
    assert load_video_model(path).num_gaussians == num
    refused(tmp_path, resealed(data, spaces=spaces - 1), "num_gaussians: expected .* got 10000")


@pytest.mark.parametrize(
    ("num_frames", "num_paths", "num_knots"),
    [(64_000, 0, 0), (5001, 2, 5001), (7, 255, 40), (7, 1, 9001), (7, 3, 1)],
)
def test_motion_has_a_byte_for_every_32_numbers(tmp_path, num_frames, num_paths, num_knots):
    """Frame times, the six numbers of each map, and its time unless that is a frame's."""
    own, path = fine(on_paths(soft_model()) if num_paths else soft_model(), -12.0), tmp_path / "m.fgz"
    own = dataclasses.replace(own, intervals=np.zeros(num_frames - 1, np.int32))
    if num_paths:
        at_frames = num_knots == num_frames
        own = with_paths(own, num_paths=num_paths, num_knots=num_knots, at_frames=at_frames)
        own = with_columns(own, path=np.minimum(own.columns["path"], num_paths))
        maps = np.tile(np.eye(2, 3, dtype=np.int32) << own.info.paths.bits, (num_paths, num_knots, 1, 1))
        own = dataclasses.replace(own, maps=maps, knots=None if at_frames else np.zeros(maps.shape[:2], np.int32))
    data = path.write_bytes(pack_compact(own)) and path.read_bytes()
    assert pack_compact(load_compact(path)) == data
    header, body = parts_of(data)
    needed = -(-(num_frames + num_paths * num_knots * (6 if num_knots == num_frames else 7)) // 32)
    spaces = needed - sum(header["motion"]["streams"]) - len(json.dumps(header))
    assert len(data) - len(body) - len(MAGIC) - 12 == len(json.dumps(header)) + max(spaces, 0)
    if spaces > 0:
        path.write_bytes(resealed(data, spaces=spaces))
        assert pack_compact(load_compact(path)) == data
        refused(tmp_path, resealed(data, spaces=spaces - 1), "num_frames: expected")


def test_long_metadata_leave_less_room():
    """A thousand bytes of them are planned for."""
    for size, excess, left in (
        (2, -500, 2),
        (1e-9, 0, 1e-9),
        (2, 1, 2 - 1e-6),
        (2, 500_000, 1.5),
        (2, 3_000_000, 1e-6),
    ):
        about = {"clip": "x" * (1000 + excess - len(json.dumps({"clip": ""})))}
        assert leave_room(size, about) == pytest.approx(left, rel=1e-12)
        assert leave_room(None, about) is None


def test_bytes_of_a_part_of_a_file_are_a_model(tmp_path, good):
    (tmp_path / "m.fgz").write_bytes(good)
    assert_same(load_compact_model(Path("whole.file"), good), load_video_model(tmp_path / "m.fgz"))


def test_names(tmp_path):
    path = save_compact(tmp_path / "m.fgz", fine(soft_model()))
    plain = path.rename(tmp_path / "other.name")  # told by its bytes
    assert load_video_model(plain).num_gaussians == 40
    with pytest.raises(FileNotFoundError):
        load_video_model(tmp_path / "missing.fgz")


def test_a_file_that_cannot_be_read_is_not_compact(tmp_path):
    assert not is_compact(tmp_path / "missing.fgz")
    assert not is_compact(tmp_path)
    assert not is_compact("/proc/self/mem")  # where there is one, its first bytes cannot be read
    (tmp_path / "other.fgz").write_bytes(b"something else")
    with pytest.raises(ModelFileError, match="a file of another kind"):
        load_compact(tmp_path / "other.fgz")


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="this system has no named pipes")
def test_a_pipe_is_not_compact(tmp_path):
    """Whatever it holds: reading would take it out."""
    os.mkfifo(tmp_path / "pipe.fgz")
    with open(os.open(tmp_path / "pipe.fgz", os.O_RDWR), "r+b", buffering=0) as pipe:
        pipe.write(MAGIC)
        assert not is_compact(tmp_path / "pipe.fgz")
