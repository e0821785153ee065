"""Models in place of clips: their frames, and fits to them."""

import numpy as np
import pytest
from soft_models import learned, soft_model, soft_segments

from foldgauss.io import load_video_model, read_video, save_video_model
from foldgauss.io.models.model_file import ModelFileError
from foldgauss.io.models.rendered_clip import is_model, read_clip_or_model
from foldgauss.io.models.video_model import read_metadata
from foldgauss.jobs import FitJob, Stopped, fit_job
from foldgauss.video import FitConfig, edit

CONFIG = FitConfig(quality=60.0, steps=12, num_gaussians=60)
SECONDS = [0.0, 0.04, 0.08, 0.3, 0.34, 0.38, 0.42, 0.5]


@pytest.fixture
def path(tmp_path):
    """A model of frames 3 to 9 of a clip, which shows them at uneven times."""
    about = {"clip": "holiday.mp4", "frames": [3, 10], "frame_seconds": SECONDS, "first_second": 0.2}
    return save_video_model(tmp_path / "m.safetensors", learned(soft_model()), metadata=about)


def test_a_model_is_a_clip_of_the_frames_that_it_renders(path, tmp_path):
    shown = np.stack(list(load_video_model(path).frames()))
    clip = read_clip_or_model(path)
    assert (clip.frames == shown).all()
    assert (clip.source, clip.num_declared, clip.duration) == (str(path), 7, pytest.approx(0.5))
    np.testing.assert_allclose(clip.times, SECONDS[:-1])
    assert "rendered by a model" in clip.notes[0]
    part = read_clip_or_model(path, frames=(2, 5), size=(20, 20))
    assert part.frames.shape == (3, 20, 20, 3)
    np.testing.assert_allclose(part.times, [0, 0.22, 0.26])
    assert (part.first_second, part.duration) == pytest.approx((0.08, 0.3))
    with pytest.raises(ValueError, match="frames: expected A:B within 0:7"):
        read_clip_or_model(path, frames=(7, None))
    for name, video in {"edited": edit(soft_model()).move((0.1, 0), frame=3).video(), "long": soft_segments()}.items():
        clip = read_clip_or_model(save_video_model(tmp_path / name, video))
        assert (clip.frames == np.stack(list(video.frames()))).all()
        assert (clip.fps, clip.times) == (video.fps, None)


def test_other_files_are_read_as_before(tmp_path):
    (tmp_path / "text").write_text("nothing")
    (tmp_path / "cut.fgz").write_bytes(b"\x8bFGZ")
    assert not is_model(tmp_path)
    assert not is_model(tmp_path / "none")
    for read in (read_video, read_clip_or_model):
        with pytest.raises(ValueError, match="path: expected a video file"):
            read(tmp_path / "text")
    with pytest.raises(ModelFileError, match="Copy it again"):
        read_clip_or_model(tmp_path / "cut.fgz")


def test_a_stopped_fit_of_a_model_continues_and_its_file_tells_of_the_clip(path, tmp_path):
    def run(name, report=lambda info: True):
        return fit_job(FitJob(name, str(path), str(tmp_path / name), CONFIG, frames=(1, 6)), report)

    record = run("a.fgz")
    assert (record["num_frames"], record["size"]) == (5, [40, 64])
    assert "rendered by a model" in record["notes"][0]
    with pytest.raises(Stopped):
        run("b.fgz", lambda info: False)
    assert list(tmp_path.glob("*.checkpoint"))
    run("b.fgz")
    assert (tmp_path / "a.fgz").read_bytes() == (tmp_path / "b.fgz").read_bytes()
    about = read_metadata(tmp_path / "a.fgz")
    assert (about["clip"], about["frames"]) == ("m.safetensors", [4, 9])
    assert about["first_second"] == pytest.approx(0.24)
    np.testing.assert_allclose(about["frame_seconds"], np.array(SECONDS[1:7]) - 0.04)
