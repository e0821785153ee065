"""PLY files: the published VeGaS video with its picture, 3DGS scenes that viewers open, and damage that is refused."""

import dataclasses
import json
import math
import struct

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from made_clips import one_line
from random_models import random_model, time_weights
from soft_models import soft_model

from foldgauss.envelope import TimeLikelihood
from foldgauss.io import (
    FormatError,
    frame_gaussians,
    load_video_model,
    read_3dgs_ply,
    read_vegas_ply,
    save_video_model,
    write_3dgs_frames,
    write_3dgs_ply,
    write_gaussians_ply,
    write_pseudomesh,
    write_vegas_ply,
)
from foldgauss.io.exchange.ply_file import read_ply, write_ply
from foldgauss.render import Gaussians3D, RenderOptions, Splats2D, cpu
from foldgauss.video import FrameTimes, VideoModel
from foldgauss.video.models.frame_times import make_time_logits
from foldgauss.video.models.renderer import VideoRenderer
from foldgauss.video.models.row_layout import columns as columns_of
from foldgauss.video.models.row_layout import pack, unpack

NUM, DEGREE, FRAMES = 60, 3, 5
HALF_WIDTH = math.tan(0.6911112 / 2)  # of the published frame, at distance 1


def vegas_columns(seed=0, num=NUM, degree=DEGREE):
    """Raw columns of a published video over the frame, a third so thin that the cutoff of scales takes them."""
    rng = np.random.default_rng(seed)
    columns = {"x": rng.uniform(-0.4, 0.4, num), "y": rng.normal(size=num), "z": rng.uniform(-0.3, 0.3, num)}
    columns |= {name: np.zeros(num) for name in ("nx", "ny", "nz")}
    columns |= {f"f_dc_{c}": rng.uniform(-2.5, 1.5, num) for c in range(3)}
    columns |= {"opacity": rng.normal(0, 2, num)}
    columns |= {f"scale_{k}": np.log(rng.uniform(0.02, 0.15, num)) for k in range(3)}
    columns["scale_0"][::3] = np.log(rng.uniform(1e-4, 2e-3, len(columns["scale_0"][::3])))
    columns |= {"rot_0": rng.normal(0, 2, num), "m_0": rng.normal(0, 1.5, num)}
    columns |= {"sigma_0": np.log(rng.uniform(0.15, 0.8, num))}
    columns |= {f"w1_{k}": rng.normal(0, 0.2, num) for k in range(2 * degree)}
    return {name: column.astype(np.float32) for name, column in columns.items()}


def write_raw(path, columns, weights=None, *, layout="binary_little_endian", code="f", between=""):
    """A PLY file by hand, in any of the three layouts."""
    kind = {"f": "float", "d": "double"}[code]
    elements = [("vertex", columns)]
    if weights is not None:
        elements.append(("time", {f"time_func_{k}": [weight] for k, weight in enumerate(weights)}))
    header, body = f"ply\nformat {layout} 1.0\ncomment by hand\n{between}", b""
    for name, rows in elements:
        table = np.stack([np.asarray(row, float) for row in rows.values()], axis=1)
        header += f"element {name} {len(table)}\n" + "".join(f"property {kind} {row}\n" for row in rows)
        if layout == "ascii":
            body += "".join(" ".join(map(repr, row)) + "\n" for row in table.tolist()).encode()
        else:
            order = "<" if "little" in layout else ">"
            body += struct.pack(f"{order}{table.size}{code}", *table.ravel())
    path.write_bytes(header.encode() + b"end_header\n" + body)
    return path


def published_picture(columns, t, size):
    """The picture as the published formulas give it, in their own geometry: camera at (0, -1, 0), plane y = 0.

    In float64 NumPy, with nothing of this package.
    """
    c = {name: column.astype(float) for name, column in columns.items()}
    height, width = size
    sigmoid = lambda x: 1 / (1 + np.exp(-x))  # noqa: E731
    u = sigmoid(c["m_0"]) - t
    degree = sum(name.startswith("w1_") for name in c) // 2
    x = c["x"] + sum(c[f"w1_{2 * j}"] * u ** (j + 1) for j in range(degree))
    z = c["z"] + sum(c[f"w1_{2 * j + 1}"] * u ** (j + 1) for j in range(degree))
    shrink = np.exp(-((u / np.exp(c["sigma_0"])) ** 2) / 2)
    first, second = np.exp(c["scale_0"]) * shrink, np.exp(c["scale_2"]) * shrink
    angle = 2 * np.pi * sigmoid(c["rot_0"])
    focal = width / (2 * HALF_WIDTH)
    rows, columns_ = np.mgrid[0:height, 0:width] + 0.5
    light, image = np.ones(size), np.zeros((*size, 3))
    for i in np.flatnonzero((shrink > 0.01) & (first > 1e-4) & (second > 1e-4)):
        turn = np.array([[np.cos(angle[i]), 0, np.sin(angle[i])], [0, 1, 0], [-np.sin(angle[i]), 0, np.cos(angle[i])]])
        space = turn @ np.diag([first[i], 1e-8, second[i]]) ** 2 @ turn.T
        right, down, depth = x[i], -z[i], 1.0  # in the camera's axes: +x, -z, +y
        view = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]])
        jacobian = focal / depth * np.array([[1, 0, -right / depth], [0, 1, -down / depth]])
        covariance = jacobian @ view @ space @ view.T @ jacobian.T + 0.3 * np.eye(2)
        offset = np.stack([columns_ - (width / 2 + focal * right), rows - (height / 2 + focal * down)], -1)
        distance = np.einsum("hwi,ij,hwj->hw", offset, np.linalg.inv(covariance), offset)
        alpha = np.minimum(0.99, sigmoid(c["opacity"][i]) * np.exp(-distance / 2))
        alpha[alpha < 1 / 255] = 0
        color = np.maximum([0.5 + 0.2820948 * c[f"f_dc_{k}"][i] for k in range(3)], 0)
        image += (light * alpha)[..., None] * color
        light *= 1 - alpha
    return image


def drawn(splats, size, model):
    """Float picture by the CPU engine."""
    leaves = (np.asarray(leaf, np.float32) for leaf in (splats.mean, splats.factor, splats.opacity, splats.color))
    return cpu.forward(*leaves, np.zeros(3, np.float32), size, options=model.options).image.transpose(1, 2, 0)


# ------------------------------------------------------------------------------------------------ VeGaS


@pytest.mark.parametrize("size", [(40, 64), (64, 40)])
def test_a_published_video_gives_the_published_picture(tmp_path, size):
    columns, weights = vegas_columns(), time_weights()
    model = read_vegas_ply(write_raw(tmp_path / "v.ply", columns, weights), size=size, fps=24)
    assert (model.num_frames, model.fps, model.size) == (FRAMES, 24.0, size)
    share = np.exp(weights.astype(float)) / np.exp(weights.astype(float)).sum()
    times = np.asarray(model.frame_times.times())
    np.testing.assert_allclose(times, [share[:k].sum() for k in range(FRAMES)], atol=1e-6)
    for t in times:
        expected = published_picture(columns, float(t), size)
        assert expected.std() > 0.05
        np.testing.assert_allclose(drawn(VideoRenderer(model).splats(t), size, model), expected, atol=1e-3)


@pytest.mark.parametrize(
    ("layout", "code"), [("ascii", "f"), ("binary_big_endian", "f"), ("binary_little_endian", "d")]
)
def test_all_layouts_hold_the_same(tmp_path, layout, code):
    columns, weights = vegas_columns(), time_weights()
    plain = read_vegas_ply(write_raw(tmp_path / "a.ply", columns, weights), size=(40, 64))
    other = read_vegas_ply(write_raw(tmp_path / "b.ply", columns, weights, layout=layout, code=code), size=(40, 64))
    np.testing.assert_array_equal(pack(plain.splats), pack(other.splats))
    np.testing.assert_array_equal(plain.frame_times.logits, other.frame_times.logits)


@pytest.mark.parametrize("layout", ["binary_little_endian", "ascii"])
def test_other_elements_are_skipped(tmp_path, layout):
    columns, weights = vegas_columns(), time_weights()
    plain = write_raw(tmp_path / "a.ply", columns, weights, layout=layout)
    head, body = plain.read_bytes().split(b"end_header\n", 1)
    start = head.index(b"element vertex")
    others = b"element camera 2\nproperty uchar flag\nproperty int number\n"
    rows = b"7 3\n9 4\n" if layout == "ascii" else struct.pack("<BiBi", 7, 3, 9, 4)
    mesh = b"element face 1\nproperty list uchar int vertex_indices\n"  # behind all that is wanted
    (tmp_path / "b.ply").write_bytes(head[:start] + others + head[start:] + mesh + b"end_header\n" + rows + body)
    model = read_vegas_ply(tmp_path / "b.ply", size=(40, 64))
    np.testing.assert_array_equal(pack(model.splats), pack(read_vegas_ply(plain, size=(40, 64)).splats))


@pytest.mark.parametrize("degree", [0, 1, 7])
@pytest.mark.parametrize("size", [(48, 80), (80, 48)])
def test_leaves_come_back_to_rounding(tmp_path, degree, size):
    model = random_model(degree=degree, size=size)
    again = read_vegas_ply(write_vegas_ply(tmp_path / "v.ply", model))
    assert (again.size, again.fps, again.options, again.compositing) == (size, 29.97, model.options, "over")
    np.testing.assert_allclose(pack(again.splats), pack(model.splats), rtol=3e-7, atol=5e-7)
    np.testing.assert_array_equal(again.frame_times.logits, model.frame_times.logits)
    assert float(again.splats.envelope.power) == 2


@pytest.mark.parametrize("power", [0.5, 1.0, 2.0, 16.0])
def test_any_power_is_the_same_envelope_in_the_file(tmp_path, power):
    """In the file the standard deviations are those of the model at any time, and again here is the model."""
    model = random_model(power=power)
    path = write_vegas_ply(tmp_path / "v.ply", model)
    columns, splats = read_ply(path, ("vertex", "time")).elements["vertex"], model.splats
    for t in (0.1, 0.5, 0.8):
        u = 1 / (1 + np.exp(-splats.time_loc_logit.astype(float))) - t
        published = np.exp(-((u / np.exp(columns["sigma_0"].astype(float))) ** 2) / 2)
        own = splats.envelope.log_a(u, time_loc=0 * u, time_scale=np.exp(splats.log_time_scale.astype(float)))
        np.testing.assert_allclose(published, np.exp(np.asarray(own) / 2), rtol=1e-5, atol=1e-12)
    again = read_vegas_ply(path)
    np.testing.assert_allclose(pack(again.splats), pack(splats), rtol=3e-7, atol=5e-7)
    assert float(again.splats.envelope.power) == power
    if power == 2:
        np.testing.assert_array_equal(columns["sigma_0"], splats.log_time_scale)


@pytest.mark.parametrize("power", [0.7, 1.0, 2.0])
def test_what_lasts_lasts_in_every_format(tmp_path, power):
    """Gaussians without beginning and end come back, and are in every frame as they are."""
    model = random_model(20, power=power)
    rows = pack(model.splats)
    place = columns_of(DEGREE)
    rows[::2, place["time_loc_logit"]], rows[::2, place["log_time_scale"]] = 0, np.log(1024)
    model = dataclasses.replace(model, splats=unpack(rows, DEGREE, model.splats.envelope))
    again = read_vegas_ply(write_vegas_ply(tmp_path / "v.ply", model))
    np.testing.assert_array_equal(again.splats.time_loc_logit, model.splats.time_loc_logit)
    np.testing.assert_allclose(again.splats.log_time_scale, model.splats.log_time_scale, atol=1e-6)
    own = np.exp(np.sort(rows[::2, place["log_scale"]]))
    write_pseudomesh(tmp_path / "mesh", model, times=[0.0, 1.0])
    for k, t in enumerate((0.0, 1.0)):
        alive = np.flatnonzero(np.asarray(model.splats.at(jnp.float32(t)).opacity) > 0)
        here = np.flatnonzero(alive % 2 == 0)
        assert len(here) == 10
        scene = read_3dgs_ply(write_3dgs_ply(tmp_path / f"{k}.ply", model, t, depth_step=0))
        lines = (tmp_path / f"mesh/frame_{k:04d}.obj").read_text().splitlines()
        vertices = np.array([line.split()[1:4] for line in lines if line.startswith("v ")], np.float64)
        edges = np.diff(vertices.reshape(-1, 3, 3)[:, [0, 1, 0, 2]], axis=1)[:, ::2]
        for scale in (np.linalg.norm(scene.factor[:, :2, :2], axis=1), np.linalg.norm(edges, axis=2)):
            assert len(scale) == len(alive)
            np.testing.assert_allclose(np.sort(scale[here]), own, rtol=1e-5)


def test_columns_come_back_to_rounding(tmp_path):
    columns, weights = vegas_columns(), time_weights()
    model = read_vegas_ply(write_raw(tmp_path / "a.ply", columns, weights), size=(40, 64))
    ply = read_ply(write_vegas_ply(tmp_path / "b.ply", model), ("vertex", "time"))
    assert list(ply.names("vertex")) == list(columns)
    assert list(ply.names("time")) == [f"time_func_{k}" for k in range(FRAMES - 1)]
    for name in set(columns) - {"y", "scale_1"}:  # which the published renderer does not look at
        np.testing.assert_allclose(ply.elements["vertex"][name], columns[name], rtol=3e-7, atol=5e-7, err_msg=name)
    np.testing.assert_array_equal(ply.columns("time", ply.names("time"))[0].astype(np.float32), weights)


def test_the_cutoff_of_scales_is_one(tmp_path):
    """The slow way, the fast one and a saved model leave the same Gaussians out; models of ours none."""
    path = write_raw(tmp_path / "v.ply", vegas_columns(), time_weights())
    model = read_vegas_ply(path, size=(40, 64))
    again = load_video_model(save_video_model(tmp_path / "v.safetensors", model))
    assert again.scale_cutoff == model.scale_cutoff == pytest.approx(1e-4 / (2 * HALF_WIDTH))
    seen = np.asarray(model.at(jnp.float32(0.4)).opacity) > 0
    whole = np.asarray(model.splats.at(jnp.float32(0.4)).opacity) > 0
    assert 0 < seen.sum() < whole.sum()
    for one in (model, again, read_vegas_ply(write_vegas_ply(tmp_path / "w.ply", model))):
        assert len(VideoRenderer(one).splats(0.4).opacity) == seen.sum()
    own = random_model()
    assert read_vegas_ply(write_vegas_ply(tmp_path / "w.ply", own)).scale_cutoff == own.scale_cutoff == 0


@pytest.mark.parametrize(("power", "floor"), [(1.0, 0.0), (2.0, 0.1), (0.0, 0.0)])
def test_the_cutoff_of_scales_with_any_envelope(power, floor):
    model = random_model(300, power=power, floor=floor)
    model = eqx.tree_at(lambda m: m.splats.log_scale, model, model.splats.log_scale - 3)
    model = dataclasses.replace(model, scale_cutoff=1e-3)
    for t in (0.1, 0.7):
        seen = np.asarray(model.at(jnp.float32(t)).opacity) > 0
        assert 0 < seen.sum() < (np.asarray(model.splats.at(jnp.float32(t)).opacity) > 0).sum()
        assert len(VideoRenderer(model).splats(t).opacity) == seen.sum()


def test_size_and_rate_must_be_known(tmp_path):
    path = write_raw(tmp_path / "v.ply", vegas_columns(), time_weights())
    with one_line(FormatError, "size=(480, 854)"):
        read_vegas_ply(path)
    assert read_vegas_ply(path, size=(40, 64)).fps == 25
    for wrong in ({"size": (0, 4)}, {"size": 7}, {"size": (4, 4), "fps": 0}, {"size": (4, 4), "fps": math.nan}):
        with pytest.raises(ValueError, match=r"expected|got"):
            read_vegas_ply(path, **wrong)
    own = write_vegas_ply(tmp_path / "own.ply", random_model())
    assert read_vegas_ply(own, fps=10, size=(20, 30)).size == (20, 30)
    assert read_vegas_ply(own, fps=10).fps == 10


# ------------------------------------------------------------------------------------------------- 3DGS


@pytest.mark.parametrize("size", [(48, 80), (80, 48)])
@pytest.mark.parametrize("axes", ["y-down", "y-up"])
def test_a_frame_in_space_is_the_frame(tmp_path, size, axes):
    """Written, read, sorted by depth and seen by the front camera: the model's own picture, in the model's order."""
    model = random_model(size=size)
    path = write_3dgs_ply(tmp_path / "f.ply", model, 0.5, axes=axes, depth_step=2e-3)  # so deep that size tells
    gaussians = read_3dgs_ply(path, axes=axes)
    splats = VideoRenderer(model).splats(0.5)
    assert len(gaussians.opacity) == len(splats.opacity) > 20
    by_chance = np.random.default_rng(0).permutation(len(splats.opacity))
    nearest_first = by_chance[np.argsort(gaussians.mean[by_chance, 2])]
    seen = from_the_front(gaussians, nearest_first, size)
    np.testing.assert_allclose(drawn(seen, size, model), drawn(splats, size, model), atol=2e-4)
    wrong = from_the_front(gaussians, by_chance, size)
    assert np.abs(drawn(wrong, size, model) - drawn(splats, size, model)).max() > 0.05  # the order matters here


def from_the_front(gaussians, order, size):
    """Flat Gaussians through a pinhole before the plane, in an order; by hand."""
    height, width = size
    distance = min(1, width / height) / (2 * HALF_WIDTH)
    focal = width / (2 * HALF_WIDTH)
    mean, factor = gaussians.mean[order], gaussians.factor[order, :2, :2]
    enlarged = focal / (distance + mean[:, 2])
    places = mean[:, :2] * enlarged[:, None] + np.array([width / 2, height / 2])
    return Splats2D(places, factor * enlarged[:, None, None], gaussians.opacity[order], gaussians.color[order])


def test_depths_keep_the_order_in_float32():
    """As many as a large model has: in space, and as distances from the front camera."""
    rng = np.random.default_rng(0)
    rows = rng.normal(size=(30_000, 11)).astype(np.float32)
    rows[:, 9:] = 0  # all alive
    splats = unpack(rows, 0, TimeLikelihood(np.float32(2), np.float32(0)))
    splats = eqx.tree_at(lambda s: (s.time_loc_logit, s.log_time_scale), splats, (0 * rows[:, 0], 0 * rows[:, 0]))
    model = VideoModel(splats, FrameTimes.uniform(3), (160, 320), 25.0, RenderOptions())
    depth = np.asarray(frame_gaussians(model, 0.5).mean)[:, 2]
    assert len(depth) == 30_000
    assert depth[0] == 0
    assert (np.diff(depth) > 0).all()
    distance = np.float32(0.5 / HALF_WIDTH)
    assert (np.diff(depth + distance) > 0).all()
    assert depth[-1] < 0.02
    assert not np.asarray(frame_gaussians(model, 0.5, depth_step=0).mean)[:, 2].any()


def test_layout_is_what_viewers_expect(tmp_path):
    model = random_model()
    raw = write_3dgs_ply(tmp_path / "f.ply", model, 0.5).read_bytes()
    head, body = raw.split(b"end_header\n", 1)
    num = len(VideoRenderer(model).splats(0.5).opacity)
    names = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", *(f"f_rest_{k}" for k in range(45))]
    names += ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {num}", *(f"property float {n}" for n in names)]
    *found, note = head.decode().splitlines()  # a comment before the vertices would disturb some viewers
    assert found == lines
    assert json.loads(note.removeprefix("comment foldgauss "))["size"] == list(model.size)
    table = np.frombuffer(body, "<f4").reshape(num, 62)
    assert not table[:, 3:6].any()
    assert not table[:, 9:54].any()
    np.testing.assert_allclose(np.linalg.norm(table[:, 58:], axis=1), 1, rtol=1e-6)
    splats = VideoRenderer(model).splats(0.5)
    np.testing.assert_allclose(1 / (1 + np.exp(-table[:, 54])), splats.opacity, rtol=1e-5)
    np.testing.assert_allclose(np.maximum(0.5 + 0.28209479 * table[:, 6:9], 0), splats.color, atol=1e-6)
    small = write_3dgs_ply(tmp_path / "g.ply", model, 0.5, sh_degree=0)
    assert small.stat().st_size < 0.31 * len(raw)
    np.testing.assert_array_equal(read_3dgs_ply(small).mean, read_3dgs_ply(tmp_path / "f.ply").mean)


def test_gaussians_in_space_come_back(tmp_path):
    """Any of them, not flat ones alone: needles, mirrored factors, opacity 0 and 1."""
    rng = np.random.default_rng(0)
    factor = rng.normal(size=(50, 3, 3)) * np.exp(rng.normal(-3, 2, (50, 1, 3)))
    factor[:10] *= np.array([-1, 1, 1])
    opacity = np.concatenate([[0, 1], rng.uniform(0, 1, 48)])
    gaussians = Gaussians3D(rng.normal(size=(50, 3)), factor, opacity, rng.uniform(0, 2, (50, 3)))
    again = read_3dgs_ply(write_gaussians_ply(tmp_path / "g.ply", gaussians))
    np.testing.assert_allclose(again.mean, gaussians.mean, rtol=1e-6)
    for one, other in zip(again.factor.astype(float), factor, strict=True):
        np.testing.assert_allclose(one @ one.T, other @ other.T, atol=3e-6 * np.abs(other @ other.T).max())
    np.testing.assert_allclose(again.opacity, opacity, atol=1e-6)
    np.testing.assert_allclose(again.color, gaussians.color, atol=1e-6)


def test_frames_go_to_a_folder(tmp_path):
    model = random_model()
    folder = write_3dgs_frames(tmp_path / "out", model)
    assert [path.name for path in sorted(folder.iterdir())] == [f"frame_{k:04d}.ply" for k in range(FRAMES)]
    one = write_3dgs_ply(tmp_path / "one.ply", model, float(model.frame_times.times()[2]))
    assert (folder / "frame_0002.ply").read_bytes() == one.read_bytes()


def write_changed(path, name, change):
    gaussians = frame_gaussians(random_model(), 0.5)
    write_gaussians_ply(path, eqx.tree_at(lambda own: getattr(own, name), gaussians, replace_fn=change))


#: What is written, and the text of the error.
REFUSED = {
    "power 0": (lambda path: write_vegas_ply(path, random_model(power=0.0)), "expected .*--power"),
    "floor": (lambda path: write_vegas_ply(path, random_model(floor=0.01)), "expected .*floor"),
    "sum": (lambda path: write_vegas_ply(path, random_model(compositing="sum")), "sum"),
    "3DGS of a sum": (
        lambda path: write_3dgs_ply(path, random_model(compositing="sum"), 0.5),
        "sum",
    ),
    "NaN": (
        lambda path: write_vegas_ply(
            path, eqx.tree_at(lambda m: m.splats.loc, random_model(), replace_fn=lambda loc: loc * np.float32(np.nan))
        ),
        "finite",
    ),
    "splats": (lambda path: write_vegas_ply(path, random_model().splats), "VideoModel"),
    **{
        f"{name} {value}": (
            lambda path, name=name, value=value: write_3dgs_ply(path, random_model(), **({"t": 0.5} | {name: value})),
            name,
        )
        for name, value in (
            ("depth_step", -1),
            ("depth_step", math.nan),
            ("axes", "z-up"),
            ("sh_degree", 4),
            ("t", 1.5),
        )
    },
    **{
        f"times {times}": (lambda path, times=times: write_3dgs_frames(path, random_model(), times), "times")
        for times in ([], [1.5], [math.nan], "0.5")
    },
    "gray": (lambda path: write_changed(path, "color", lambda color: color[:, :1]), "channels"),
    "NaN in space": (lambda path: write_changed(path, "mean", lambda mean: mean * np.float32(np.nan)), "finite"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_cannot_be_written_is_refused(tmp_path, name):
    write, text = REFUSED[name]
    with pytest.raises(ValueError, match=rf"^[^\n]*{text}[^\n]*$"):
        write(tmp_path / "v.ply")
    assert list(tmp_path.iterdir()) == []


def test_a_time_with_nothing_to_see(tmp_path):
    model = eqx.tree_at(lambda m: m.splats.log_time_scale, random_model(), np.full(NUM, -20, np.float32))
    gaussians = read_3dgs_ply(write_3dgs_ply(tmp_path / "f.ply", model, 0.0))
    assert gaussians.mean.shape == (0, 3)
    assert gaussians.factor.shape == (0, 3, 3)


# ----------------------------------------------------------------------------------------------- damage


def _header(*lines, layout="binary_little_endian"):
    return "\n".join(["ply", f"format {layout} 1.0", *lines, "end_header", ""]).encode()


DAMAGED = {
    "empty": (b"", "empty"),
    "another file": (b"\x89PNG\r\n", "PNG"),
    "no end": (b"ply\nformat ascii 1.0\n", "end_header"),
    "a long header": (b"ply\n" + b"comment\n" * 600_000, "end_header"),
    "no format": (b"ply\nelement vertex 1\nproperty float x\nend_header\n", "format"),
    "another format": (b"ply\nformat binary_middle_endian 1.0\nend_header\n", "line 2"),
    "property first": (_header("property float x"), "line 3"),
    "unknown type": (_header("element vertex 1", "property half x"), "line 4"),
    "a negative count": (_header("element vertex -1"), "line 3"),
    "no number": (_header("element vertex many"), "line 3"),
    "a count that lies": (_header("element vertex 999999999999", "property float x"), "truncated"),
    "a count that lies in text": (_header("element vertex 99999999999", "property int x", layout="ascii"), "truncated"),
    "more digits": (_header("element vertex " + "9" * 5000, "property float x"), "line 3"),
    "twice": (_header("element vertex 1", "property float x", "property float x"), "line 5"),
    "two elements": (_header("element vertex 1", "property float x", "element vertex 1"), "line 5"),
    "no properties": (_header("element vertex 5"), "none"),
    "a list": (_header("element vertex 1", "property list uchar float x") + b"\0", "list"),
    "a mesh": (_header("element vertex 1", "property float x") + bytes(4), "m_0"),
    "no vertices": (_header("element face 1", "property float x") + bytes(4), "no element 'vertex'"),
    "lists before": (_header("element face 1", "property list int int x", "element vertex 1", "property int x")
                     + bytes(8), "the list 'x'"),
    "words": (_header("element vertex 1", "property float x", layout="ascii") + b"north", "b'north'"),
    "a long word": (_header("element vertex 1", "property float x", layout="ascii") + b"n" * 10**6, "expected numbers"),
}  # fmt: skip


@pytest.mark.parametrize("kind", DAMAGED)
def test_damaged_files(tmp_path, kind):
    data, text = DAMAGED[kind]
    (tmp_path / "v.ply").write_bytes(data)
    with one_line(FormatError, text, "v.ply"):
        read_vegas_ply(tmp_path / "v.ply", size=(40, 64))
    with pytest.raises(FormatError):
        read_3dgs_ply(tmp_path / "v.ply")


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"x": np.full(NUM, np.nan)}, "nan in x of vertex 0"),
        ({"w1_3": np.where(np.arange(NUM) == 7, np.inf, 0)}, "inf in w1_3 of vertex 7"),
        ({"m_0": None}, "m_0"),
        ({"scale_2": None}, "scale_2"),
        ({"w1_5": None}, "even number"),
        ({"w1_2": None, "w1_9": np.zeros(NUM)}, "w1_2"),
        ({"f_rest_0": np.ones(NUM)}, "degree 0"),
        ({"scale_0": np.full(NUM, 1e38), "x": np.full(NUM, 3e38)}, "float32"),
    ],
)
def test_wrong_columns(tmp_path, change, text):
    columns = {name: column for name, column in (vegas_columns() | change).items() if column is not None}
    with one_line(FormatError, text):
        read_vegas_ply(write_raw(tmp_path / "v.ply", columns, time_weights(), code="d"), size=(40, 64))


@pytest.mark.parametrize(
    "rows", [None, {"time_func_0": [1, 2], "time_func_1": [1, 2]}, {"time_func_1": [1], "time_func_2": [2]}, {"a": []}]
)
def test_frame_weights_are_needed(tmp_path, rows):
    tables = {"vertex": vegas_columns()} | ({} if rows is None else {"time": rows})
    with pytest.raises(FormatError, match="time"):
        read_vegas_ply(write_ply(tmp_path / "v.ply", tables), size=(40, 64))


def test_frame_weights_may_be_a_column_and_gaussians_are_needed(tmp_path):
    tables = {"vertex": vegas_columns(), "time": {"time_func_0": time_weights()}}
    model = read_vegas_ply(write_ply(tmp_path / "c.ply", tables), size=(40, 64))
    np.testing.assert_array_equal(model.frame_times.logits, time_weights())
    tables["vertex"] = {name: column[:0] for name, column in vegas_columns().items()}
    with pytest.raises(FormatError, match="Gaussians"):
        read_vegas_ply(write_ply(tmp_path / "v.ply", tables), size=(40, 64))


@pytest.mark.parametrize(
    "note", ['{"size": [1, "a"]}', "[1]", "{", '{"options": 3}', '{"size": [4, 4], "options": {"low_pass": -1}}',
             '{"size": [4, 4], "options": {"color": 1}}', '{"size": [4, 4], "fps": "many"}', "[" * 100_000,
             '{"size": [4, 4], "power": 0}', '{"size": [4, 4], "power": "two"}', '{"size": [4, 4], "power": 1e300}']
)  # fmt: skip
def test_notes_that_are_none(tmp_path, note):
    tables = {"vertex": vegas_columns(), "time": {f"time_func_{k}": [0.0] for k in range(3)}}
    with one_line(FormatError, "v.ply"):
        read_vegas_ply(write_ply(tmp_path / "v.ply", tables, comments=["foldgauss " + note]))


def test_3dgs_files_that_are_none(tmp_path):
    with pytest.raises(FormatError, match="read_vegas_ply"):
        read_3dgs_ply(write_raw(tmp_path / "v.ply", vegas_columns(), time_weights()))
    path = write_3dgs_ply(tmp_path / "f.ply", random_model(), 0.5, sh_degree=0)
    with pytest.raises(FormatError, match="read_3dgs_ply"):
        read_vegas_ply(path)
    rows = read_ply(path, ["vertex"]).elements["vertex"]
    for names, value, text in (
        (("rot_0", "rot_1", "rot_2", "rot_3"), 0, "vertex 1"),
        (("scale_1",), 1e3, "float32"),
        (("y",), np.nan, "y of vertex 1"),
    ):
        columns = {name: np.array(rows[name]) for name in rows.dtype.names}
        for name in names:
            columns[name][1] = value
        with pytest.raises(FormatError, match=text):
            read_3dgs_ply(write_ply(tmp_path / "g.ply", {"vertex": columns}))
    with pytest.raises(ValueError, match="axes"):
        read_3dgs_ply(path, axes="up")


def test_within_a_cut_it_is_the_nearer_frame():
    model = dataclasses.replace(soft_model(), frame_times=FrameTimes(make_time_logits(7, [3])))
    times = np.asarray(model.frame_times.times())
    for share, k in ((0.1, 2), (0.9, 3)):
        inside = (1 - share) * times[2] + share * times[3]
        found, expected = frame_gaussians(model, inside), frame_gaussians(model, times[k])
        np.testing.assert_array_equal(found.mean, expected.mean)
