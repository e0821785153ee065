"""Edited videos: layers, depth and cameras; drawn as one, and on disk as they were."""

import dataclasses
import json
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from edit_cases import apart, picture
from fuzz.models import sealed, unsealed
from soft_models import NUM, OBJECT, SIZE, assert_same, soft_model

from foldgauss.io import ModelFileError, load_video_model, save_video_model
from foldgauss.io.models.model_file import read_header
from foldgauss.render import Camera, Gaussians3D, RenderOptions, project, render
from foldgauss.video import Clock, EditedVideo, VideoModel, edit, layers
from foldgauss.video.models.conditioning import PreparedModel
from foldgauss.video.models.renderer import VideoRenderer

MODEL = soft_model(options=RenderOptions())
TIMES = np.asarray(MODEL.frame_times.times())
ASPECT = SIZE[0] / SIZE[1]
BETWEEN = (0.0, 0.31, 1.0)


def laid_over(model) -> EditedVideo:
    """The model as a video of one layer, nothing changed."""
    return edit(model).apply(lambda g, t: g).video()


# ------------------------------------------------------------------------------------------------------ as a model is


def test_it_is_asked_as_a_model_is():
    video = edit(MODEL).select(OBJECT).scale(1.5).video()
    assert (video.num_frames, video.size, video.fps) == (MODEL.num_frames, MODEL.size, MODEL.fps)
    assert (video.options, video.compositing, video.num_gaussians) == (MODEL.options, "over", NUM)
    assert video.num_parameters == MODEL.num_parameters
    image = video.render(0.31, background=(0.2, 0.4, 0.6))
    assert image.shape == (*SIZE, 3)
    played = VideoRenderer(video, background=(0.2, 0.4, 0.6)).frame(0.31)
    np.testing.assert_array_equal(np.floor(np.clip(image * np.float32(255) + np.float32(0.5), 0, 255)), played)
    frames = list(video.frames())
    assert len(frames) == MODEL.num_frames
    np.testing.assert_array_equal(frames[2], VideoRenderer(video).frame(TIMES[2]))
    assert next(video.frames([0.3], (80, 128))).shape == (80, 128, 3)


def test_at_any_size_the_edit_is_the_same():
    """An overlay acts in model space: at twice the size it is twice as far."""
    chain = edit(MODEL).select(OBJECT)
    for size in ((80, 128), (50, 50)):
        baked = chain.rotate(0.5, about=(0.1, 0)).video()
        overlay = chain.rotate(0.5, about=(0.1, 0), frames=(None, None)).video()
        np.testing.assert_allclose(picture(overlay, 0.31, size), picture(baked, 0.31, size), atol=1e-4)


# --------------------------------------------------------------------------------------------------------------- layers


def test_layers_are_composited_front_to_back():
    front, back = soft_model(seed=1, options=RenderOptions()), MODEL
    both = layers(front, back)
    for t in BETWEEN:
        ahead, behind = (VideoRenderer(one).splats(t) for one in (front, back))
        together = both.at(t)
        for name in ("mean", "factor", "opacity", "color"):
            expected = np.concatenate([getattr(ahead, name), getattr(behind, name)])
            np.testing.assert_array_equal(getattr(together, name), expected)
    # By the slow judge.
    slow = render(jax.tree.map(jnp.asarray, both.at(0.31)), SIZE, engine="reference")
    np.testing.assert_allclose(both.render(0.31), slow, atol=1e-2)
    assert apart(both, layers(back, front), 0.31) > 0.05
    assert apart(layers(edit(front).vanish().video(), back), back, 0.31) == 0


def test_layers_of_different_kinds():
    """Each is conditioned by its own envelope and degree; sizes in pixels may differ; one names the timeline."""
    front = soft_model(seed=1, power=1.0, floor=0.2, degree=1, size=(80, 128), options=RenderOptions())
    both = layers(front, MODEL)
    assert (both.size, both.num_gaussians) == (SIZE, 2 * NUM)
    ahead = VideoRenderer(front, SIZE).splats(0.31)
    np.testing.assert_array_equal(both.at(0.31).mean[:NUM], ahead.mean)
    np.testing.assert_array_equal(both.at(0.31).factor[:NUM], ahead.factor)
    assert layers(front, MODEL, timeline=0).size == (80, 128)
    lower = soft_model(seed=1, size=(79, 128), options=RenderOptions())  # the same shape to a pixel, and fitted over
    fitted_over = PreparedModel(lower, SIZE, aspect=SIZE[0] / SIZE[1]).splats(0.31)
    np.testing.assert_array_equal(layers(lower, MODEL).at(0.31).mean[:NUM], fitted_over.mean)
    assert np.abs(fitted_over.mean - VideoRenderer(lower, SIZE).splats(0.31).mean).max() > 0.1
    three = layers(MODEL, layers(front, MODEL, timeline=0), timeline=1)
    assert (len(three.layers), three.timeline, three.size) == (3, 1, (80, 128))


def test_each_layer_has_its_clock_and_edits():
    front = soft_model(seed=1, options=RenderOptions())
    frozen = layers(front, edit(MODEL).freeze(2).video())
    np.testing.assert_array_equal(frozen.at(0.9).mean[NUM:], laid_over(MODEL).at(TIMES[2]).mean)
    np.testing.assert_array_equal(frozen.at(0.9).mean[:NUM], laid_over(front).at(0.9).mean)
    chain = edit(frozen)
    assert len(chain.selection) == 2 * NUM
    moved = chain.select(OBJECT, layer=1).move((0.1, 0)).video()
    assert moved.layers[1].clocks
    assert not moved.layers[1].overlays  # a clock does not stand in the way of a shift that is baked
    np.testing.assert_allclose((moved.at(0.9).mean - frozen.at(0.9).mean)[NUM:][OBJECT, 0], 6.4, atol=1e-4)
    np.testing.assert_array_equal(moved.at(0.9).mean[:NUM], frozen.at(0.9).mean[:NUM])
    gone = chain.select(layer=0).vanish().video()
    assert apart(gone, edit(MODEL).freeze(2).video(), 0.9) == 0


def test_sums_are_layered_too():
    one, two = (soft_model(seed=k, options=RenderOptions(), compositing="sum") for k in (0, 1))
    np.testing.assert_allclose(picture(layers(one, two), 0.3), picture(one, 0.3) + picture(two, 0.3), atol=1e-5)


WRONG = {
    "timeline": (lambda: layers(MODEL, timeline=1), "timeline: expected the number of one of 1"),
    "no number": (lambda: layers(MODEL, timeline="first"), "timeline"),
    "kind": (lambda: layers(MODEL, edit(MODEL)), r"video: expected a VideoModel .*got Edit\. End .* \.video"),
    "aspect": (lambda: layers(MODEL, soft_model(size=(64, 64))), "layers: expected frames of one aspect ratio, 40x64"),
    "options": (lambda: layers(MODEL, soft_model()), "layers: expected one options for all"),
    "sum": (lambda: layers(MODEL, soft_model(options=RenderOptions(), compositing="sum")), "layers: .*compositing"),
    "camera": (
        lambda: layers(MODEL, edit(MODEL).seen_from(Camera.front(ASPECT)).video()),
        "videos: expected videos without a camera",
    ),
    "size": (lambda: laid_over(MODEL).render(0.3, (0, 3)), "size: expected"),
    "function of a camera": (
        lambda: edit(MODEL).seen_from(lambda t: 3).video().render(0.5),
        r"camera\(t\): expected a Camera, got int",
    ),
    "narrow mask": (lambda: with_mask(np.ones(NUM - 1, bool)), r"mask: expected bool \(40,\)"),
    "mask of numbers": (lambda: with_mask(np.ones(NUM)), r"mask: expected bool \(40,\)"),
}


def with_mask(mask):
    layer = edit(MODEL).rotate(0.3).video().layers[0]
    return dataclasses.replace(layer, overlays=(dataclasses.replace(layer.overlays[0], mask=mask),))


@pytest.mark.parametrize("name", WRONG)
def test_wrong_calls(name):
    call, message = WRONG[name]
    with pytest.raises(ValueError, match=f"^{message}"):
        call()


# ------------------------------------------------------------------------------------------------------------- in space


def test_any_camera_is_that_of_project():
    camera = Camera.front(ASPECT).orbit(0.5, 0.2)
    video = edit(MODEL).seen_from(camera).video()
    flat = Gaussians3D.from_flat(jax.jit(lambda splats: splats.at(jnp.float32(0.31)))(MODEL.splats))
    seen = jax.jit(partial(project, size=SIZE, order="array"))(flat, camera)
    got = video.at(0.31)
    alive = np.asarray(seen.opacity) > 0
    np.testing.assert_allclose(got.mean, seen.mean[alive], atol=1e-3)
    covariance = lambda factor: np.asarray(factor) @ np.asarray(factor).mT  # noqa: E731
    np.testing.assert_allclose(covariance(got.factor), covariance(seen.factor[alive]), atol=1e-2, rtol=1e-3)
    orbiting = edit(MODEL).seen_from(lambda t: Camera.front(ASPECT).orbit(t)).video()
    fixed = edit(MODEL).seen_from(Camera.front(ASPECT).orbit(0.31)).video()
    assert apart(orbiting, fixed, float(np.float32(0.31))) < 1e-5
    assert apart(orbiting, fixed, 0.5) > 0.05


def test_depth_makes_smaller_and_hides():
    """Twice as far from the camera is half as large about the middle, and behind all that stays in the plane."""
    distance = -float(Camera.front(ASPECT).position[2])
    chain = edit(MODEL).select(OBJECT)
    far, half = chain.place(depth=distance).video(), chain.scale(0.5, about=(0, 0)).video()
    got, expected = far.at(0.31), VideoRenderer(half).splats(0.31)
    last = np.argsort(OBJECT, kind="stable")  # behind all others, in their order
    np.testing.assert_allclose(got.mean, expected.mean[last], atol=1e-3)
    np.testing.assert_array_equal(got.opacity, expected.opacity[last])
    near = chain.place(depth=-0.2).video().at(0.31)
    np.testing.assert_array_equal(near.opacity, expected.opacity[np.argsort(~OBJECT, kind="stable")])
    behind = chain.place(depth=-2 * distance).video()
    assert apart(behind, chain.vanish().video(), 0.31) == 0  # nothing is seen of what is behind the camera
    # The same order from behind: what was near is far.
    other_side = chain.place(depth=-0.2).seen_from(Camera.opposing(ASPECT)).video().at(0.31)
    np.testing.assert_array_equal(other_side.opacity, expected.opacity[last])


def test_turns_in_space():
    chain = edit(MODEL).select(OBJECT)
    # About z it is a turn of the plane.
    flat, turned = chain.rotate(0.7, about=(0.1, 0)).video(), chain.place(rotate=(0, 0, 0.7), about=(0.1, 0)).video()
    np.testing.assert_allclose(np.sort(turned.at(0.31).mean, 0), np.sort(flat.at(0.31).mean, 0), atol=1e-3)
    # Half a turn about the vertical is a mirror, in the plane again.
    mirrored = chain.transform([[-1, 0], [0, 1]], about=(-0.15, 0)).video()
    around = chain.place(rotate=(0, np.pi, 0), about=(-0.15, 0)).video()
    np.testing.assert_allclose(np.sort(around.at(0.31).mean, 0), np.sort(mirrored.at(0.31).mean, 0), atol=1e-3)
    # About its own center, that stays: and on the way it is narrower.
    spun = chain.place(rotate=(0, np.pi / 2, 0)).video().at(0.31)
    width = lambda splats: np.sqrt(np.median((splats.factor[..., 0, :] ** 2).sum(-1)))  # noqa: E731
    only = edit(MODEL).select(~OBJECT).vanish().select().place(rotate=(0, 1.4, 0)).video().at(0.31)
    whole = VideoRenderer(edit(MODEL).select(~OBJECT).vanish().video()).splats(0.31)
    assert width(only) < 0.4 * width(whole)
    assert len(spun.opacity) == NUM


def test_edits_go_on_in_space():
    """Placed first, then moved, recolored, and given to a function that sees three coordinates."""
    dims = []
    chain = edit(MODEL).select(OBJECT).place(depth=-0.3).move((0.1, 0)).recolor((1, 0, 0)).rotate(0.3)
    video = chain.apply(lambda g, t: dims.append(g.mean.shape[1]) or g).video()
    assert apart(video, edit(MODEL).select(OBJECT).place(depth=-0.3).video(), 0.31) > 0.05
    assert dims == [3]
    plain = edit(MODEL).select(OBJECT).move((0.1, 0)).recolor((1, 0, 0)).rotate(0.3).place(depth=-0.3).video()
    assert apart(video, plain, 0.31) < 1e-4  # a shift of depth commutes with what is done in the plane

    def lift(gaussians, t):
        lifted = gaussians.in_space()
        return dataclasses.replace(lifted, mean=lifted.mean + np.float32([0, 0, -0.3]))

    lifted = edit(MODEL).select(OBJECT).apply(lift).video()
    assert apart(lifted, edit(MODEL).select(OBJECT).place(depth=-0.3).video(), 0.31) < 1e-3


# ------------------------------------------------------------------------------------------------------------- on disk

SPAN = {"frames": (1, 6), "ease": (1, 2), "curve": "smooth"}
KEPT = {
    "affine": lambda e: e.rotate(0.3).transform([[1, 0.2], [0.1, -2]], (0.1, 0), about=(0, 0), **SPAN),
    "opacity": lambda e: e.vanish(**SPAN).opacity(3),
    "copies": lambda e: e.multiply([(0.1, 0), (0.2, 0)], delays=0.3, **SPAN),
    "colors": lambda e: e.recolor(hue=0.2, frame=2).recolor((1, 0, 0), times=(0.2, 0.4)),
    "time": lambda e: e.retime(shift=0.5).retime(clock=Clock((0, 0.3, 1), (0.2, 0.9, 0)), **SPAN).freeze(2),
    "space": lambda e: e.place(depth=0.3, rotate=(0.1, 0.2, 0.3), about=(0, 0), **SPAN).place(depth=1),
    "camera": lambda e: e.seen_from(Camera.front(ASPECT).orbit(0.3)),
    "camera by matrices": lambda e: e.seen_from(
        Camera.from_matrices(Camera.front(ASPECT).viewmat, [[70, 0, 30], [0, 80, 25], [0, 0, 1]], SIZE)
    ),
    "camera of the picture's aspect": lambda e: e.seen_from(Camera.look_at((0.1, 0.2, -1.4))),
}


#: Of each kind one; the long runs take the rest.
QUICK = ("affine", "copies", "time", "space", "camera by matrices")


@pytest.mark.parametrize("name", [pytest.param(k, marks=[] if k in QUICK else pytest.mark.slow) for k in KEPT])
def test_round_trip_is_exact(tmp_path, name):
    path = tmp_path / "edited.safetensors"
    video = KEPT[name](edit(layers(soft_model(seed=1, options=RenderOptions()), MODEL)).select(OBJECT, layer=1)).video()
    assert isinstance(video, EditedVideo)
    save_video_model(path, video, metadata={"by": "hand"})
    again = load_video_model(path)
    assert_same(again, video)
    np.testing.assert_array_equal(list(again.frames()), list(video.frames()))
    further, other = (edit(one).select(layer=1).move((0.05, 0)).video() for one in (again, video))  # and edited further
    assert apart(further, other, 0.31) == 0
    assert read_header(path)["metadata"] == {"by": "hand"}


def test_a_folded_model_stays_one_on_disk(tmp_path):
    video = edit(MODEL).select(OBJECT).rotate(0.3, about=(0, 0)).multiply([(0.1, 0)]).video()
    save_video_model(tmp_path / "m", video)
    assert isinstance(load_video_model(tmp_path / "m"), VideoModel)
    assert read_header(tmp_path / "m")["kind"] == "video"


@pytest.mark.parametrize(
    ("make", "got"),
    [
        (lambda e: e.apply(lambda g, t: g), "overlays: .* got GaussianFunction"),
        (lambda e: e.seen_from(lambda t: Camera.front(ASPECT)), "camera: .* got a function"),
    ],
)
def test_code_is_not_saved(tmp_path, make, got):
    with pytest.raises(ModelFileError, match=f"^{got}"):
        save_video_model(tmp_path / "m", make(edit(MODEL)).video())
    assert not list(tmp_path.iterdir())


BROKEN = {
    "unknown edit": lambda h: h["layers"][1]["overlays"][0].update(kind="code"),
    "no kind": lambda h: h["layers"][1]["overlays"][0].pop("kind"),
    "no angle": lambda h: h["layers"][1]["overlays"][0].pop("angle"),
    "angle": lambda h: h["layers"][1]["overlays"][0].update(angle="steep"),
    "span": lambda h: h["layers"][1]["overlays"][0].update(span={"start": 1.0, "stop": 0.0}),
    "span of more": lambda h: h["layers"][1]["overlays"][0].update(span={"run": "this"}),
    "clock": lambda h: h["layers"][1]["clocks"][0].update(clock={"times": [0], "own_times": []}),
    "no layers": lambda h: h.update(layers=[]),
    "layers": lambda h: h.update(layers=3),
    "fewer layers": lambda h: h["layers"].pop(),
    "fewer edits": lambda h: h["layers"][1]["overlays"].pop(),
    "timeline": lambda h: h.update(timeline=7),
    "no timeline": lambda h: h.update(timeline="first"),
    "camera": lambda h: h.update(camera={"aspect": -1, "dtype": "float32"}),
    "camera's type": lambda h: h.update(camera={"aspect": None, "dtype": "object"}),
    "no camera": lambda h: h.pop("camera"),
    "sizes": lambda h: h["layers"][0]["model"].update(size=[10, 10]),
}


@pytest.mark.parametrize("name", BROKEN)
def test_files_that_describe_no_video(tmp_path, name):
    path = tmp_path / "m"
    chain = edit(layers(MODEL, MODEL)).select(OBJECT, layer=1).rotate(0.3).freeze(1)
    save_video_model(path, chain.seen_from(Camera.front(ASPECT)).video())
    about, tensors = unsealed(path.read_bytes())
    header = json.loads(about["__metadata__"]["header"])
    BROKEN[name](header)
    about["__metadata__"]["header"] = json.dumps(header)
    path.write_bytes(sealed(about, tensors))
    with pytest.raises(ModelFileError):
        load_video_model(path)
