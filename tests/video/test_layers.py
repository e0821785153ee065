"""Fits in layers: clips taken apart, models of each object and of the whole background, and their files."""

import re
from pathlib import Path

import cv2
import numpy as np
import pytest
from commands import call
from panned_clips import SIZE, disc_clip, panned, texture
from test_moving_object import overlap

from foldgauss.io import load_video_model, read_video, save_compact, save_video_model, write_frames
from foldgauss.io.edit_script import EditScriptError, parse_edit_script
from foldgauss.io.media.masks import read_object_masks
from foldgauss.io.models.model_file import ModelFileError
from foldgauss.io.models.video_model import read_metadata
from foldgauss.jobs import runner
from foldgauss.video import EditedVideo, FitConfig, edit, evaluate, psnr
from foldgauss.video.layered import fit_layers, plan_layers
from foldgauss.video.motion.background_plate import complete_background, cover, fill_with_texture
from foldgauss.video.motion.layer_clips import separate

pytestmark = pytest.mark.filterwarnings(
    "default:What moves covers", "default:.*behind objects is", "default:The object is followed"
)
CONFIG = FitConfig(quality=60.0, steps=300)


@pytest.fixture(scope="module")
def clip():
    return disc_clip(num_frames=8)


@pytest.fixture(scope="module")
def fitted(clip):
    frames, _, masks = clip
    return fit_layers(frames, {"disc": masks}, CONFIG, fps=20.0)


def composite(layers):
    """The layers over one another, the last one behind."""
    *objects, image = [one.astype(float) for one in layers.values()]
    for one in reversed(objects):
        image = one[..., :3] + (1 - one[..., 3:] / 255) * image
    return image.round().astype(np.uint8)


# ------------------------------------------------------------------------------------------- clips taken apart


def test_layers_make_up_the_clip_and_are_those_it_was_made_of(clip):
    frames, empty, masks = clip
    layers, unknown = separate(frames, {"disc": masks})
    assert list(layers) == ["disc", "background"]
    assert unknown < 0.35
    assert min(map(psnr, frames, composite(layers))) > 40
    alpha = layers["disc"][..., 3]
    assert (alpha[masks] == 255).all()
    assert (alpha[~cover(masks)] == 0).all()
    assert (layers["disc"][..., :3] <= layers["disc"][..., 3:]).all()
    known = np.stack([cv2.erode(np.uint8(one), np.ones((3, 3))) for one in ~masks]) > 0
    assert (layers["background"][known] == frames[known]).mean() > 0.95
    assert np.mean(list(map(psnr, empty, layers["background"]))) > 26


def test_a_shadow_goes_with_its_object_or_stays():
    frames, empty, masks = disc_clip(2.0, 8.0, num_frames=10)
    y, x = np.mgrid[: SIZE[0], : SIZE[1]]
    shadow = np.stack([np.hypot((x - 62 - 8 * k) / 14, (y - 60 - 0.5 * k) / 7) < 1 for k in range(10)]) & ~masks
    light = 1 - 0.5 * cv2.GaussianBlur(np.float32(shadow).transpose(1, 2, 0), (0, 0), 1).transpose(2, 0, 1)[..., None]
    shaded = np.where(masks[..., None], frames, frames * light).round().astype(np.uint8)
    core = np.stack([cv2.erode(np.uint8(one), np.ones((5, 5))) for one in shadow & ~cover(masks, 0.02)]) > 0
    with_it, _ = separate(shaded, {"disc": masks}, shadows=True)
    without, _ = separate(shaded, {"disc": masks})
    assert np.abs(with_it["disc"][core][:, 3] / 255 - 0.5).mean() < 0.1
    assert with_it["disc"][core][:, :3].mean() < 12
    assert (without["disc"][core] == 0).all()
    off = [np.abs(one["background"].astype(float) - empty)[core].mean() for one in (with_it, without)]
    assert off[0] < 8 < 50 < off[1]
    assert min(map(psnr, shaded, composite(with_it))) > 40
    late = np.zeros_like(masks)
    late[5:, :9, :9] = True
    both, _ = separate(shaded, {"late": late, "disc": masks}, shadows=True)
    assert (both["disc"] == with_it["disc"])[core].mean() > 0.9
    none, _ = separate(frames, {"disc": masks}, shadows=True)
    assert (none["disc"][..., 3] > 0)[~cover(masks, 0.02)].mean() < 0.002


def test_soft_edges_are_found_where_the_colors_differ():
    behind, front = np.full((4, 60, 80, 3), (30, 60, 200), np.uint8), np.array([220, 120, 20])
    x = np.arange(80)
    alpha = np.clip((40 - x) / 4 + 0.5, 0, 1)[:, None]
    frames = (alpha * front + (1 - alpha) * behind).round().astype(np.uint8)
    rows = np.arange(60)[:, None] < 30  # where there is no object, the background is seen
    frames = np.where(rows[..., None], frames, behind)
    masks = np.broadcast_to((alpha[:, 0] > 0.9) & rows, (4, 60, 80))
    layers, _ = separate(frames, {"edge": masks})
    found = layers["edge"][1, 10, :, 3] / 255
    band = (found > 0.02) & (found < 0.98)
    assert band.any()
    assert np.abs(found - alpha[:, 0])[band].max() < 0.35


def test_two_objects_that_touch_leave_no_gap():
    rng = np.random.default_rng(0)
    frames = np.stack([cv2.resize(rng.integers(0, 255, (6, 8, 3), np.uint8), (80, 60))] * 4)
    one, other = (np.zeros((4, 60, 80), bool) for _ in range(2))
    one[:, 10:40, 10:40], other[:, 10:40, 40:70] = True, True
    layers, _ = separate(frames, {"one": one, "other": other})
    assert list(layers) == ["one", "other", "background"]
    assert np.abs(composite(layers).astype(int) - frames)[one | other].max() <= 1


@pytest.mark.parametrize("num", [1, 2])
def test_short_clips_have_layers(clip, num):
    frames, masks = clip[0][:num], clip[2][:num]
    layers, unknown = separate(frames, {"disc": masks})
    assert unknown > 0.5
    assert min(map(psnr, frames, composite(layers))) > 40
    assert (layers["background"][masks] > 20).any(-1).mean() > 0.99  # nothing black


@pytest.mark.parametrize(
    ("masks", "told"),
    [
        ({}, "masks: expected at least one"),
        ({"background": np.ones((4, 8, 8), bool)}, "not called 'background'"),
        ({"it": np.zeros((4, 8, 8), bool)}, "masks that are not empty, got an empty one"),
        ({"it": np.ones((4, 8, 9), bool)}, r"expected bool \(4, 8, 8\), got bool \(4, 8, 9\)"),
        ({"it": np.ones((4, 8, 8))}, "got float64"),
    ],
)
def test_wrong_masks_are_refused(masks, told):
    with pytest.raises(ValueError, match=told):
        separate(np.zeros((4, 8, 8, 3), np.uint8), masks)


def test_what_no_frame_shows_is_filled_once_and_moves_with_the_background():
    ground = texture(3)
    frames = np.stack([panned(ground, (20 + 2 * k, 15)) for k in range(8)]).clip(0, 255).round().astype(np.uint8)
    covered = np.zeros(frames.shape[:3], bool)
    for k in range(8):
        covered[k, 30:55, 60 - 2 * k : 90 - 2 * k] = True  # always the same part of the ground
    filled, unknown = complete_background(np.where(covered[..., None], 0, frames).astype(np.uint8), covered)
    assert unknown > 0.9
    patches = np.stack([one[33:52, 63 - 2 * k : 87 - 2 * k] for k, one in enumerate(filled)]).astype(float)
    assert np.abs(patches - patches[4]).mean() < 6
    assert patches.min(axis=(0, 3)).mean() > 40  # nothing black
    assert patches.std(axis=(1, 2)).mean() > 0.4 * ground.std()
    assert (filled[~covered] == frames[~covered]).all()


def test_texture_replaces_only_what_is_unknown():
    image = texture(1, (60, 90)).clip(0, 255).astype(np.uint8)
    unknown = np.zeros((60, 90), bool)
    unknown[20:40, 30:60] = True
    holed = np.where(unknown[..., None], 0, image).astype(np.uint8)
    fill_with_texture(holed, unknown)
    assert (holed[~unknown] == image[~unknown]).all()
    assert abs(float(holed[unknown].mean()) - image.mean()) < 25


# ------------------------------------------------------------------------------------------------------ fits


def test_budgets_are_divided(clip):
    frames, _, masks = clip
    plans = plan_layers(frames, {"disc": masks}, FitConfig(minutes=2.0, size_mb=0.5))
    assert sum(plan.config.minutes for plan in plans) == pytest.approx(2)
    assert sum(plan.config.size_mb for plan in plans) == pytest.approx(0.5)
    assert all(not plan.config.learns_frame_times for plan in plans)
    disc, ground = (
        10 ** (-0.1 * one.config.psnr) for one in plan_layers(frames, {"disc": masks}, FitConfig(psnr=30.0))
    )
    area = masks.mean()
    assert disc / area == pytest.approx(3 * ground, rel=0.01)
    assert disc + (1 - area) * ground == pytest.approx(1e-3, rel=0.01)  # the errors of what is seen


def test_layers_composited_are_the_clip(fitted, clip):
    video, results = fitted
    frames, empty, _ = clip
    assert [layer.name for layer in video.layers] == list(results) == ["disc", "background"]
    assert evaluate(video, frames).mean_psnr > 27
    assert video.fps == 20
    gone = edit(video).select(layer="disc").vanish().video()
    assert evaluate(gone, empty).mean_psnr > 25
    assert gone.num_gaussians == results["background"].model.num_gaussians
    assert (edit(video).select(layer="background").vanish().video().render(0.5)[:8] == 0).all()


def test_layers_are_edited_by_name(fitted):
    video, results = fitted
    num = results["disc"].model.num_gaussians
    assert edit(video).select(layer="disc").selection == edit(video).select(layer=0).selection
    copied = edit(video).select(layer="disc").multiply([(0.2, 0.0)]).video()
    assert copied.num_gaussians == video.num_gaussians + num
    assert copied.layers[0].name == "disc"
    script = '[selections.it]\nlayer = "disc"\n[[edits]]\nselect = "it"\ndo = "vanish"\n'
    assert parse_edit_script(script).apply(video).num_gaussians == video.num_gaussians - num
    with pytest.raises(ValueError, match=r"layer: expected a whole number in \[0, 1\] or 'disc' or 'background', got"):
        edit(video).select(layer="disk")
    with pytest.raises(EditScriptError, match=r"\[selections.it\]: layer: expected a whole number"):
        parse_edit_script(script.replace('"disc"', '"disk"')).apply(video)


# ----------------------------------------------------------------------------------------------------- files


def test_files_hold_layers_by_name(fitted, tmp_path):
    video, results = fitted
    save_compact(tmp_path / "a.fgz", {name: result.quantized for name, result in results.items()}, metadata={"a": 1})
    save_video_model(tmp_path / "a.safetensors", video)
    wanted = video.render(0.4)
    for name in ("a.fgz", "a.safetensors"):
        found = load_video_model(tmp_path / name)
        assert [layer.name for layer in found.layers] == ["disc", "background"]
        assert (found.render(0.4) == wanted).all()


def test_a_part_of_a_file_has_the_background(fitted, tmp_path):
    _, results = fitted
    path = save_compact(tmp_path / "a.fgz", {name: result.quantized for name, result in results.items()})
    data, alone = path.read_bytes(), save_compact(tmp_path / "b.fgz", {"background": results["background"].quantized})
    size = len(alone.read_bytes())
    assert data[:size] == alone.read_bytes()
    for damaged in (data[: size + 10], data[:size] + bytes(20), data[: size + 40] + b"#" + data[size + 41 :]):
        path.write_bytes(damaged)
        with pytest.warns(
            UserWarning, match="what follows layer 1 is no layer that can be read, but cut off or damaged"
        ):
            found = load_video_model(path)
        assert isinstance(found, EditedVideo)
        assert [layer.name for layer in found.layers] == ["background"]
    path.write_bytes(data[: size // 2])
    with pytest.raises(ModelFileError, match="cut off or damaged"):
        load_video_model(path)


@pytest.fixture
def folders(clip, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    frames, _, masks = clip
    write_frames(tmp_path / "clip", frames)
    write_frames(tmp_path / "masks", np.repeat(255 * np.uint8(masks)[..., None], 3, -1))
    return tmp_path


FIT = ("fit", "clip", "--masks", "masks", "--steps", 60, "--out", "a.fgz", "--quiet")


@pytest.mark.filterwarnings("default:.*no shared paths")
def test_the_command_fits_layers(folders, clip):
    told = "of what is behind objects is shown by no frame"
    call(*FIT[:-1], out=["object: 8 frames of 90x160 with alpha", "background: 8 frames"], err=told)
    whole = (folders / "a.fgz").read_bytes()
    assert [layer.name for layer in load_video_model("a.fgz").layers] == ["object", "background"]
    assert not list(folders.glob("*.checkpoint"))
    call("info", "a.fgz", out="layer 0 (object): none")
    call("export", "a.fgz", "--format", "ply", "--out", "a.ply", err="no shared paths")
    call("evaluate", "a.fgz", "clip")
    call(*FIT, "--overwrite")
    assert (folders / "a.fgz").read_bytes() == whole
    found = r"What moves covers \d.\d% to \d.\d% of the image, in 8 of 8 frames. Parts that stand still"
    told = call(*FIT[:2], "--masks", "moving", *FIT[4:], "--overwrite").err
    assert re.search(found, " ".join(told.split()))
    assert len(load_video_model("a.fgz").layers) == 2
    call("fit", "clip", "--masks", "masks", "--shadows", "--steps", 40, "--out", "a.safetensors", "--quiet")
    call("fit", "clip", "--shadows", code=2, err="--shadows: expected a fit with --masks, got one without")
    assert [layer.name for layer in load_video_model("a.safetensors").layers] == ["object", "background"]


def test_a_model_is_fitted_in_layers(folders, clip):
    call(*FIT[:2], *FIT[4:6], "--frames", "1:8", "--out", "m.fgz")
    call("fit", "m.fgz", "--masks", "masks", "--steps", 40, err="rendered by a model")  # of frames 1 to 7
    assert [layer.name for layer in load_video_model("m.fit.fgz").layers] == ["object", "background"]
    assert read_metadata("m.fit.fgz")["frames"] == [1, 8]


def test_an_object_is_followed_from_masks_of_some_frames_or_a_click(folders, clip):
    _, _, truth = clip
    write_frames(folders / "two", np.repeat(255 * np.uint8(truth[[1, 6]])[..., None], 3, -1))
    (folders / "two" / "00001.png").rename(folders / "two" / "mask0006.png")  # no frame's name, but with a number
    (folders / "two" / "00000.png").rename(folders / "two" / "00001.png")
    ways = {"two": "followed from 2 masks", "masks/00002.png": "from 1 masks", "64,43@2": "What moves covers"}
    for masks, told in ways.items():
        call(*FIT[:3], masks, *FIT[4:], "--overwrite", err=told)
        alpha = np.stack([image[..., 3] for image in load_video_model("a.fgz").layers[0].model.frames(background=None)])
        assert overlap(alpha > 128, truth).mean() > 0.75, masks
    call(*FIT[:3], "64,43@9", *FIT[4:], "--overwrite", code=2, err="masks: expected a click in frames of 160x90 pixels")
    span, told = ("--overwrite", "--frames", "4:8"), "masks: expected one of a frame from 4 to 7"
    call(*FIT[:3], "masks/00002.png", *FIT[4:], *span, code=2, err=told)
    for masks in ("64,43", "two"):
        call(*FIT[:3], masks, *FIT[4:], "--overwrite", "--segment-seconds", 0.16, code=1, err="in segments")


def test_what_moves_is_found_in_each_shot_or_asked_for(folders, clip):
    frames, empty, _ = clip
    write_frames(folders / "shots", np.concatenate([frames[:5], frames[:5, ::-1, ::-1]]))
    write_frames(folders / "still", np.tile(empty[:1], (4, 1, 1, 1)))
    told = "What is behind objects is found in each shot on its own. Shots begin at frames 0, 5."
    call("fit", "shots", "--masks", "moving", "--steps", 3, err=told)
    told = "masks: expected an object in these frames, got none that moves. Give masks of the object: one"
    call("fit", "still", "--masks", "moving", "--steps", 3, code=2, err=told)


def test_layers_are_rendered_alone(fitted, tmp_path, monkeypatch):
    video, results = fitted
    monkeypatch.chdir(tmp_path)
    save_video_model("a.safetensors", video)
    call("render", "a.safetensors", "--layer", "disc", "--background", "none", "--out", "cutout")
    cutout = np.stack(list(results["disc"].model.frames(background=None)))
    written = read_video("cutout").frames
    np.testing.assert_array_equal(written[..., 3], cutout[..., 3])
    assert np.abs(written.astype(int) - cutout).mean() < 0.05  # PNGs have colors that are not premultiplied
    call("render", "a.safetensors", "--layer", "background", out="a.background.mp4: 8 frames at 20 frames per second")
    call("render", "a.safetensors", "--layer", "background", "--format", "png")
    empty = np.stack(list(results["background"].model.frames()))
    np.testing.assert_array_equal(read_video("a-background-frames").frames, empty)
    call("render", "a.safetensors", "--layer", "background", "--layer", "disc", "--out", "both")
    np.testing.assert_array_equal(read_video("both").frames, np.stack(list(video.frames())))
    told = "--layer: expected 'background' or 'disc', got 'disk'."
    call("render", "a.safetensors", "--layer", "disk", code=2, err=told)


@pytest.mark.parametrize("stop", [30, 90])
def test_a_stopped_fit_continues_in_its_layer(folders, monkeypatch, stop):
    call(*FIT)
    whole = (folders / "a.fgz").read_bytes()
    taken, steps = [], runner.fit_steps

    def killed(*arguments, **options):
        for one in steps(*arguments, **options):
            yield one
            taken.append(one)
            if len(taken) == stop:
                raise KeyboardInterrupt

    monkeypatch.setattr(runner, "fit_steps", killed)
    call(*FIT, "--overwrite", "--checkpoint-seconds", 0, code=130)
    assert list(folders.glob("*.checkpoint"))
    monkeypatch.setattr(runner, "fit_steps", steps)
    call(*FIT)
    assert (folders / "a.fgz").read_bytes() == whole


def test_segments_have_layers(folders):
    told = "segment 0: What moves covers"
    call(*FIT[:3], "moving", *FIT[4:], "--segment-seconds", 0.2, "--frames", "0:8", "--size-mb", 0.08, err=told)
    video = load_video_model("a.fgz")
    assert read_metadata("a.fgz")["budget"] == {"steps": 60, "size_mb": 0.08}  # of the whole, not of a segment
    assert Path("a.fgz").stat().st_size <= 80_000
    assert [[layer.name for layer in one.model.layers] for one in video.segments] == 2 * [["object", "background"]]
    gone = edit(video).select(layer="object").vanish().video()
    assert gone.num_gaussians < video.num_gaussians
    call("render", "a.fgz", "--layer", "background", "--out", "empty")
    np.testing.assert_array_equal(read_video("empty").frames, np.stack(list(gone.frames())))


def test_segments_without_an_object_have_a_background_only(folders, clip):
    masks = clip[2].copy()
    masks[:5] = False
    write_frames(folders / "late", np.repeat(255 * np.uint8(masks)[..., None], 3, -1))
    call(*FIT[:3], "late", *FIT[4:], "--segment-seconds", 0.16, "--frames", "0:8")
    video = load_video_model("a.fgz")
    names = [[layer.name for layer in one.model.layers] for one in video.segments]
    assert names[0] == ["background"]
    assert names[-1] == ["object", "background"]
    assert edit(video).select(layer="object").vanish().video().num_gaussians < video.num_gaussians
    with pytest.raises(ValueError, match="selection: expected at least one Gaussian"):
        edit(video).select(layer="objekt").vanish().video()
    call(*FIT[:3], "late", *FIT[4:], "--frames", "0:4", "--overwrite", code=2, err="masks: expected an object in these")


def test_masks_of_the_whole_clip_are_cut(folders, clip):
    _, _, masks = clip
    part = read_object_masks("masks", 2, 3, SIZE)
    assert [(k, (own == masks[2 + k]).all()) for k, own in part["object"].items()] == [(0, True), (1, True), (2, True)]
    labels = np.uint8(masks) + 0
    labels[:, :10, :10] = 7
    write_frames(folders / "two", np.repeat(labels[..., None], 3, -1))
    both = read_object_masks("two", 0, 8, SIZE)
    assert list(both) == ["object 1", "object 7"]
    assert (np.stack(list(both["object 1"].values())) == (labels == 1)).all()
    call("fit", "clip", "--masks", "two", "--frames", "0:4", "--steps", 5, "--out", "b.fgz", "--quiet")
    call("fit", "clip", "--masks", "nothing", code=2, err="--masks: expected a folder, an image or a video, X,Y")
    write_frames(folders / "wide", np.repeat(255 * np.uint8(masks[:, :45])[..., None], 3, -1))
    call("fit", "clip", "--masks", "wide", code=2, err="masks: expected the aspect of the clip, 90x160")
    call("fit", "clip", "--masks", "wide", "--size", "40x160", "--steps", 3, "--out", "c.fgz", "--quiet")
    call(
        "fit",
        "clip",
        "--masks",
        "masks",
        "--history",
        "h.jsonl",
        code=2,
        err="--history: expected a fit without layers",
    )


def test_a_clip_with_alpha_has_no_masks(folders, clip):
    frames, _, masks = clip
    write_frames(folders / "cut", np.concatenate([frames * masks[..., None], 255 * np.uint8(masks)[..., None]], -1))
    assert read_video("cut").has_alpha
    call("fit", "cut", "--masks", "masks", code=2, err="masks: expected a clip without alpha")
