"""Writers of other programs' formats: existing outputs, swapped arguments, and progress."""

import pytest
from soft_models import soft_model

from foldgauss.io import (
    FormatError,
    OutputError,
    load_video_model,
    read_masks,
    read_vegas_ply,
    read_video,
    save_compact,
    save_video_model,
    write_3dgs_frames,
    write_3dgs_ply,
    write_pseudomesh,
    write_vegas_segments,
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


@pytest.mark.parametrize("write", [write_3dgs_frames, write_pseudomesh])
def test_existing_outputs(tmp_path, model, write):
    path = write(tmp_path / "out", model)
    before = files(path)
    with pytest.raises(OutputError, match="overwrite it"):
        write(path, model)
    assert files(path) == before
    assert write(path, model, overwrite=True) == path


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
        r"model: expected a VideoModel, .* got Edit\. End the chain with \.video\(\)",
    ),
    "load": (lambda m, s, p: load_video_model(m), "path: expected a path, got VideoModel"),
    "segments of one model": (
        lambda m, s, p: write_vegas_segments(p, m),
        "video: expected a SegmentedVideo, got VideoModel",
    ),
    "no times": (lambda m, s, p: write_3dgs_frames(p, m, "x"), "times: expected one or more numbers"),
    "times of frames": (lambda m, s, p: write_pseudomesh(p, m, [0, 3]), "times: expected one or more numbers"),
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


def test_one_time_needs_no_list(tmp_path):
    write_3dgs_frames(tmp_path / "frames", soft_model(), 0.5)
    assert len(list((tmp_path / "frames").iterdir())) == 1


@pytest.mark.parametrize("write", [write_3dgs_frames, write_pseudomesh])
def test_each_frame_is_told(tmp_path, model, write):
    told = []
    path = write(tmp_path / "frames", model, [0.1, 0.5, 0.6], on_frame=lambda: told.append(1))
    assert len(told) == 3
    assert files(path) == files(write(tmp_path / "again", model, [0.1, 0.5, 0.6]))
