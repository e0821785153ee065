"""Export and import by the name of a format."""

import numpy as np
import pytest
from soft_models import soft_model

from foldgauss.io import (
    FormatError,
    OutputError,
    export,
    load_video_model,
    read_masks,
    read_vegas_ply,
    read_video,
    save_compact,
    save_video_model,
    write_3dgs_frames,
    write_3dgs_ply,
    write_video,
)
from foldgauss.io.page.player_page import quantize_finely
from foldgauss.render import RenderOptions
from foldgauss.video import Selection, edit


@pytest.fixture(scope="module")
def model():
    return soft_model(num_frames=3, options=RenderOptions())


def files(path):
    return {entry.name: entry.read_bytes() for entry in path.iterdir()} if path.is_dir() else path.read_bytes()


@pytest.mark.parametrize(
    "options",
    [{}, {"times": 0.5}, {"times": [0.2, 0.7], "axes": "y-up", "sh_degree": 0, "depth_step": 0.0}],
)
def test_frames_for_viewers(tmp_path, model, options):
    path = export(model, "ply3dgs", tmp_path / "frames", **options)
    listed = options | ({"times": np.atleast_1d(options["times"])} if options else {})
    assert files(path) == files(write_3dgs_frames(tmp_path / "again", model, **listed))


def test_one_frame_for_viewers(tmp_path, model):
    path = export(model, "ply3dgs", tmp_path / "one.ply", times=[0.4], sh_degree=0)
    assert files(path) == files(write_3dgs_ply(tmp_path / "again.ply", model, 0.4, sh_degree=0))
    for times in (None, [0.1, 0.2]):
        with pytest.raises(ValueError, match="times"):
            export(model, "ply3dgs", tmp_path / "two.ply", times=times)
    assert not (tmp_path / "two.ply").exists()


@pytest.mark.parametrize(
    ("format", "options", "text"),
    [
        ("gltf", {}, "format"),
        ("ply", {"times": [0.5]}, "times"),
        ("ply", {"sh_degree": 0}, "sh_degree"),
        ("obj", {"axes": "y-up"}, "axes"),
        ("obj", {"depth_step": 0.0}, "depth_step"),
        ("ply3dgs", {"axes": "up"}, "axes"),
    ],
)
def test_wrong_options(tmp_path, model, format, options, text):
    with pytest.raises(ValueError, match=text):
        export(model, format, tmp_path / "out", **options)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("format", "name", "options"),
    [("ply", "v.ply", {}), ("ply3dgs", "f.ply", {"times": [0]}), ("ply3dgs", "f", {}), ("obj", "m", {})],
)
def test_existing_outputs(tmp_path, model, format, name, options):
    path = export(model, format, tmp_path / name, **options)
    before = files(path)
    with pytest.raises(OutputError, match="overwrite it"):
        export(model, format, path, **options)
    assert files(path) == before
    assert export(model, format, path, overwrite=True, **options) == path


@pytest.mark.parametrize(
    ("name", "error", "text"),
    [
        ("f.ply", FormatError, "read_3dgs_ply"),
        ("", FormatError, "a file that can be read"),
        ("none.ply", FileNotFoundError, "missing"),
    ],
)
def test_what_is_no_video(tmp_path, model, name, error, text):
    write_3dgs_ply(tmp_path / "f.ply", model, 0.5)
    with pytest.raises(error, match=text):
        read_vegas_ply(tmp_path / name, size=(40, 64))


SWAPPED = {
    "save": (lambda m, s, p: save_video_model(m, p), r"path: expected a path, got VideoModel\. .*\(path, model\)"),
    "save a selection as a model": (lambda m, s, p: save_video_model(p, s), "model: .*got Selection"),
    **{
        f"save as {name}": (
            lambda m, s, p, name=name: save_video_model(p + name, m),
            r"path: expected a name for the model, as out\.safetensors, got .*export\.",
        )
        for name in (".mp4", ".png", ".ply", ".v2")
    },
    "save as a compact model": (lambda m, s, p: save_video_model(f"{p}.fgz", m), "path: .*foldgauss compress"),
    "save a compact model as a plain one": (
        lambda m, s, p: save_compact(f"{p}.safetensors", quantize_finely(m)),
        "path: expected a name ending in .fgz",
    ),
    "save a chain": (
        lambda m, s, p: save_video_model(p, edit(m)),
        r"model: expected a video, got a chain of edits. End it with .video\(\)",
    ),
    "load": (lambda m, s, p: load_video_model(m), "path: expected a path, got VideoModel"),
    "format first": (lambda m, s, p: export("ply", m, p), r"model: .*got str\. .*\(model, format, out\)"),
    "path second": (lambda m, s, p: export(m, p, "ply"), "format: expected one of"),
    "a chain": (lambda m, s, p: export(edit(m), "ply", p), r"model: .*got Edit\. End the chain with \.video"),
    "no path": (lambda m, s, p: export(m, "ply", 3), "path: expected a path, got 3"),
    "obj in a file": (lambda m, s, p: export(m, "obj", f"{p}.obj"), "out: expected a folder, got .*extension out"),
    "no times": (lambda m, s, p: export(m, "ply3dgs", p, times="x"), "times: expected one or more numbers"),
    "times of frames": (lambda m, s, p: export(m, "obj", p, times=[0, 3]), "times: expected one or more numbers"),
    "masks": (
        lambda m, s, p: read_masks(s.mask),
        "path: expected a path, got .*array",
    ),
    "frames first": (lambda m, s, p: write_video(m.frames(), p, 24), r"path: .*\(path, frames, fps\)"),
    "a model": (lambda m, s, p: write_video(p, m, 24), r"frames: .*got VideoModel\. For a model: model\.frames\(\)"),
    "a rate in a text": (lambda m, s, p: write_video(p, m.frames(), "24"), r"fps: expected a rate in \[1e-05, 1000\]"),
    "one picture": (lambda m, s, p: write_video(f"{p}.png", m.frames(), 24), "path: .*For one image: write_image"),
    "a clip": (lambda m, s, p: read_video(3), "path: expected a path, got 3"),
}


@pytest.mark.parametrize("name", SWAPPED)
def test_swapped_arguments(tmp_path, name):
    call, message = SWAPPED[name]
    model = soft_model()
    with pytest.raises(ValueError, match=f"^({message})"):
        call(model, Selection.all(model), str(tmp_path / "out"))
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("format", ["ply3dgs", "obj"])
def test_each_frame_is_told(tmp_path, model, format):
    told = []
    path = export(model, format, tmp_path / "frames", times=[0.1, 0.5, 0.6], on_frame=lambda: told.append(1))
    assert len(told) == 3
    assert files(path) == files(export(model, format, tmp_path / "again", times=[0.1, 0.5, 0.6]))
