"""Commands that edit, export and import, as a user meets them; a small model made by hand instead of a fit."""

import json

import numpy as np
import pytest
from commands import call, run, seconds_heard, write_tone
from PIL import Image
from soft_models import NUM, SIZE, soft_model

from foldgauss.io import load_video_model, read_video, save_video_model, write_frames
from foldgauss.video import EditedVideo, VideoModel, edit

FRAMES = 7
BAKED = '[selections.it]\nbox = [12, 10, 32, 30]\nframe = 3\n[[edits]]\ndo = "move"\nselect = "it"\noffset = [0.2, 0]\n'
LAID_OVER = '[[edits]]\ndo = "recolor"\ngain = 0.2\nframe = 2\n'


@pytest.fixture(scope="module")
def work(tmp_path_factory):
    """A model, its pictures as a clip, scripts."""
    folder = tmp_path_factory.mktemp("work")
    model = soft_model()
    save_video_model(folder / "model.safetensors", model, metadata={"clip": "clip", "frames": None})
    write_frames(folder / "clip", model.frames())
    (folder / "baked.toml").write_text(BAKED)
    (folder / "laid.toml").write_text(LAID_OVER)
    return folder


def test_an_edited_model_is_a_model(work, tmp_path):
    """Baked it is a plain one, else one with edits: told about, drawn, compared and edited again."""
    call(
        "edit",
        work / "model.safetensors",
        work / "baked.toml",
        "--out",
        tmp_path / "plain.safetensors",
        out="a plain model, 40 Gaussians",
    )
    plain = load_video_model(tmp_path / "plain.safetensors")
    assert isinstance(plain, VideoModel)
    wanted = edit(soft_model()).select(box=(12, 10, 32, 30), frame=3).move((0.2, 0)).video()
    np.testing.assert_array_equal(plain.splats.loc, wanted.splats.loc)

    call(
        "edit",
        tmp_path / "plain.safetensors",
        work / "laid.toml",
        "--out",
        tmp_path / "two.safetensors",
        out="a model with edits",
    )
    both = load_video_model(tmp_path / "two.safetensors")
    assert isinstance(both, EditedVideo)

    told = " ".join(call("info", tmp_path / "two.safetensors").out.replace("│", " ").split())
    assert "edits 1 on 40 of 40 Gaussians; those baked into the parameters are not counted" in told
    assert "laid.toml" in told

    assert run("evaluate", tmp_path / "two.safetensors", work / "clip", "--json", tmp_path / "figures.json") == 0
    psnr = json.loads((tmp_path / "figures.json").read_text())["psnr"]
    assert len(psnr) == FRAMES
    assert psnr[2] < min(psnr[:2] + psnr[3:]) - 1

    assert run("render", tmp_path / "two.safetensors", "--out", tmp_path / "frames") == 0
    own = list(both.frames())
    for k, picture in enumerate(read_video(tmp_path / "frames").frames):
        np.testing.assert_array_equal(picture, own[k])
    assert run("edit", tmp_path / "two.safetensors", work / "laid.toml", "--out", tmp_path / "three.safetensors") == 0
    assert len(load_video_model(tmp_path / "three.safetensors").layers[0].overlays) == 2


def test_pictures_of_an_edit(work, tmp_path):
    for name, size in (("edited.gif", None), ("edited.mp4", "20x32"), ("edited", "20x32")):
        options = [] if size is None else ["--size", size]
        call(
            "edit",
            work / "model.safetensors",
            work / "baked.toml",
            "--out",
            tmp_path / name,
            *options,
            out="7 frames at 25 frames per second",
        )
        clip = read_video(tmp_path / name)
        assert (clip.num_frames, clip.size) == (FRAMES, (20, 32) if size else SIZE)
    edited = edit(soft_model()).select(box=(12, 10, 32, 30), frame=3).move((0.2, 0)).video()
    np.testing.assert_array_equal(read_video(tmp_path / "edited").frames, np.stack(list(edited.frames(size=(20, 32)))))
    sound = ("--sound", write_tone(tmp_path / "tone.wav", 1.0), "--out", tmp_path / "heard.mp4")
    assert run("edit", work / "model.safetensors", work / "baked.toml", *sound) == 0
    assert seconds_heard(tmp_path / "heard.mp4") == pytest.approx(FRAMES / 25, abs=0.03)


@pytest.mark.parametrize("kind", ["png", "webp"])
def test_what_is_written_is_what_was_drawn(work, tmp_path, kind):
    """Read back by another program: how many images, and the pictures."""
    options = ("--size", "32x52", "--fps", 12.5, "--format", kind)
    assert run("render", work / "model.safetensors", "--out", tmp_path / "out", *options) == 0
    own = np.stack(list(soft_model().frames(np.linspace(0, 1, 7)[::2], (32, 52))))  # 25 a second, every other one
    paths = sorted((tmp_path / "out").iterdir())
    assert [path.name for path in paths] == [f"{k:05d}.{kind}" for k in range(4)]
    np.testing.assert_array_equal([np.asarray(Image.open(path).convert("RGB")) for path in paths], own)


def test_export_and_import(work, tmp_path):
    model = work / "model.safetensors"
    told = call("export", model, "--format", "ply", "--out", tmp_path / "video.ply").out.replace("\n", "")
    assert told == f"{tmp_path / 'video.ply'}: VeGaS video (ply), 7 frames, {NUM} Gaussians"
    call("import", tmp_path / "video.ply", "--out", tmp_path / "again.safetensors", out=f"7 frames, {NUM} Gaussians")
    again = load_video_model(tmp_path / "again.safetensors")
    assert (again.size, again.fps) == (SIZE, 25.0)
    np.testing.assert_allclose(again.splats.loc, soft_model().splats.loc, atol=1e-6)
    assert run("import", tmp_path / "video.ply", "--out", tmp_path / "fast.safetensors", "--fps", 50) == 0
    assert load_video_model(tmp_path / "fast.safetensors").fps == 50

    export = ("export", model, "--format")
    several, one = f"7 frames, up to {NUM} Gaussians each", f"1 frame, up to {NUM} Gaussians"
    call(*export, "ply3dgs", "--out", tmp_path / "scenes", out=f"3DGS scenes (ply3dgs), {several}")
    assert len(list((tmp_path / "scenes").glob("*.ply"))) == FRAMES
    told = call(
        *export, "ply3dgs", "--out", tmp_path / "one.ply", "--times", "0.5", out=f"3DGS scenes (ply3dgs), {one}"
    )
    assert "each" not in told.out
    assert (tmp_path / "one.ply").read_bytes().startswith(b"ply\n")
    call(*export, "obj", "--out", tmp_path / "mesh", "--times", "0:1:3", out=f"triangles (obj), 3{several[1:]}")
    assert len(list((tmp_path / "mesh").glob("*.obj"))) == 3
