"""The command as a user meets it: real files, exit codes, one-line errors, nothing half-written."""

import itertools
import json
import os
import re
import signal
import subprocess
import sys
import time
import wave

import av
import cv2
import numpy as np
import pytest
from commands import run

from foldgauss import cli
from foldgauss.cli.fitting import demo as demonstration
from foldgauss.cli.fitting import fit as fitting
from foldgauss.cli.viewing import info as drawing
from foldgauss.io import load_video_model, read_video, save_video_model, write_video
from foldgauss.io.models.model_file import read_header
from foldgauss.io.models.video_model import CLIP_NOTES, read_metadata
from foldgauss.jobs import runner
from foldgauss.video import interpolate_frames

SIZE = (48, 64)
QUICK = ["--gaussians", "400", "--steps", "30"]


def blobs(num_frames=6, height=48, width=64):
    y, x = np.mgrid[0:height, 0:width]
    t = np.linspace(0.2, 0.7, num_frames)[:, None, None]
    blob = np.exp(-((x - t * width) ** 2 + (y - height / 2) ** 2) / 40)
    return np.stack([255 * blob, 128 + 0 * blob, 255 - 200 * blob], -1).astype(np.uint8)


@pytest.fixture(scope="module")
def work(tmp_path_factory):
    """A clip and a model fitted to it."""
    folder = tmp_path_factory.mktemp("work")
    write_video(folder / "clip.mp4", blobs(), 12.0)
    assert run("fit", folder / "clip.mp4", "--out", folder / "model.safetensors", *QUICK) == 0
    return folder


def test_fit_render_evaluate_info(work, tmp_path, capsys):
    model = load_video_model(work / "model.safetensors")
    assert (model.num_frames, model.size, model.fps) == (6, SIZE, 12.0)
    assert not list(work.glob("*.checkpoint"))

    assert run("render", work / "model.safetensors", "--out", tmp_path / "slow.mp4", "--fps", 48) == 0
    slow = read_video(tmp_path / "slow.mp4")
    assert (slow.num_frames, slow.size, slow.fps) == (21, SIZE, 48.0)

    assert run("render", work / "model.safetensors", "--out", tmp_path / "frames", "--size", "96x128") == 0
    assert len(list((tmp_path / "frames").glob("*.png"))) == 6
    assert cv2.imread(str(tmp_path / "frames" / "00000.png")).shape == (96, 128, 3)

    capsys.readouterr()
    figures = tmp_path / "figures.json"
    assert run("evaluate", work / "model.safetensors", work / "clip.mp4", "--json", figures) == 0
    scores = json.loads(figures.read_text())
    assert len(scores["psnr"]) == len(scores["ssim"]) == 6
    assert scores["mean_psnr"] == pytest.approx(np.mean(scores["psnr"]), abs=1e-3)
    assert scores["mean_psnr"] > 20
    num_bytes = (work / "model.safetensors").stat().st_size
    assert scores["bits_per_pixel"] == pytest.approx(8 * num_bytes / (6 * 48 * 64))
    assert "bits per pixel" in capsys.readouterr().out

    assert run("info", work / "model.safetensors") == 0
    told = capsys.readouterr().out
    assert "400" in told
    assert "power 1" in told


def test_render_of_one_frame(work, tmp_path, capsys, monkeypatch):
    model = work / "model.safetensors"
    images = list(load_video_model(model).frames())
    for k in (0, 3, -1):
        assert run("render", model, "--frame", k, "--out", tmp_path / f"{k}.png") == 0
        np.testing.assert_array_equal(read_video(tmp_path / f"{k}.png").frames[0], images[k])
    monkeypatch.chdir(tmp_path)
    assert run("render", model, "--frame", 2) == 0
    assert (tmp_path / "model.png").exists()


def test_render_chooses_the_encoding(work, tmp_path, capsys):
    model = work / "model.safetensors"
    sizes = []
    for crf in (0, 40):
        out = tmp_path / f"{crf}.mp4"
        encoding = ("--codec", "h265", "--pixel-format", "yuv444p", "--crf", crf, "--size", "96x128")
        assert run("render", model, "--out", out, *encoding) == 0
        sizes.append(out.stat().st_size)
        with av.open(str(out)) as container:
            codec = container.streams.video[0].codec_context
            assert (codec.name, codec.pix_fmt) == ("hevc", "yuv444p")
    assert sizes[0] > sizes[1]
    with wave.open(str(tmp_path / "sound.wav"), "wb") as sound:
        sound.setparams((1, 2, 8000, 0, "NONE", ""))
        sound.writeframes(bytes(8000))
    heard = []
    for slow in (("--speed", "0.5"), ("--fps", "24")):
        out = tmp_path / "slow.mp4"
        assert run("render", model, "--out", out, *slow, "--sound", tmp_path / "sound.wav", "--overwrite") == 0
        with av.open(str(out)) as container:
            heard.append(sum(frame.samples / frame.sample_rate for frame in container.decode(audio=0)))
    assert heard == pytest.approx([1.0, 0.5], abs=0.1)


def test_other_rates_speeds_and_times(work, tmp_path, capsys):
    """The clip has 6 frames, 12 a second; which frame is which is told by the model's own pictures."""
    model = load_video_model(work / "model.safetensors")
    own = list(model.frames())

    def shown(name, *options):
        assert run("render", work / "model.safetensors", "--out", tmp_path / name, *options) == 0
        pictures = read_video(tmp_path / name).frames
        return [next((k for k in range(6) if np.array_equal(own[k], picture)), None) for picture in pictures]

    assert shown("same") == [0, 1, 2, 3, 4, 5]
    assert shown("slow", "--speed", 0.5) == [0, None, 1, None, 2, None, 3, None, 4, None, 5]
    assert shown("back", "--speed", -1) == [5, 4, 3, 2, 1, 0]
    assert shown("rate", "--fps", 24) == [0, None, 1, None, 2, None, 3, None, 4, None, 5]
    assert shown("held", "--remap", f"0=0,{1 / 12}={1 / 12},{3 / 12}={1 / 12},{4 / 12}={2 / 12}") == [0, 1, 1, 1, 2]
    assert shown("ends", "--times", "1:0:2") == [5, 0]
    capsys.readouterr()
    assert run("render", work / "model.safetensors", "--out", tmp_path / "v.mp4", "--speed", 0.25) == 0
    assert "21 frames at 12 frames per second" in capsys.readouterr().out
    assert read_video(tmp_path / "v.mp4").fps == pytest.approx(12)


def test_a_variable_frame_rate_is_kept(tmp_path, capsys):
    """Frames are shown at the times of the clip's; at another speed or rate, its seconds are divided evenly."""
    times, end, model = np.array([0, 3, 6, 14, 17, 31]) / 30, 41 / 30, tmp_path / "m.safetensors"
    write_video(tmp_path / "clip.mp4", blobs(), 5.0, times=[*times, end])
    assert run("fit", tmp_path / "clip.mp4", "--out", model, *QUICK) == 0
    assert "shown for 0.1 to 0.467 s, 4.839 per second on average" in capsys.readouterr().err
    assert run("info", model) == 0
    told = capsys.readouterr().out.replace("\n", " ")
    assert "4.39 per second on average" in told
    assert "frame_seconds" not in told
    assert run("compress", model, "--out", tmp_path / "m.fgz") == 0
    assert run("fit", tmp_path / "clip.mp4", "--out", tmp_path / "f.fgz", *QUICK) == 0
    read = {}
    for name, own, *options in (
        ("as-fitted", model),
        ("compact", tmp_path / "m.fgz"),
        ("fitted-compact", tmp_path / "f.fgz"),
        ("even", model, "--fps", 30),
        ("half", model, "--speed", 0.5, "--fps", 15),
        ("back", model, "--speed", -1, "--fps", 30),
        ("slower", model, "--speed", 0.5),
        ("held", model, "--remap", f"0={14 / 30},1={14 / 30}"),
    ):
        assert run("render", own, "--out", tmp_path / f"{name}.mp4", *options) == 0
        read[name] = read_video(tmp_path / f"{name}.mp4")
    for name in ("as-fitted", "compact", "fitted-compact"):
        np.testing.assert_allclose(read[name].times, times, atol=1e-4)
        assert read[name].duration == pytest.approx(end, abs=1e-4)
    for name, frames in (("even", 41), ("half", 41), ("back", 32), ("slower", 28), ("held", 11)):
        assert (read[name].times, read[name].num_frames) == (None, frames)
    assert read["slower"].fps == read["held"].fps == pytest.approx(10)  # the rate of the shortest interval, 0.1 s
    fitted = read["as-fitted"].frames.astype(int)
    for shown, frame in ((0, 0), (3, 1), (6, 2), (14, 3), (17, 4), (31, 5), (40, 5)):  # the last one is held
        assert np.abs(read["even"].frames[shown].astype(int) - fitted[frame]).mean() < 2
        assert np.abs(read["half"].frames[shown].astype(int) - fitted[frame]).mean() < 2
        assert np.abs(read["back"].frames[31 - min(shown, 31)].astype(int) - fitted[frame]).mean() < 2
    assert np.abs(read["held"].frames.astype(int) - fitted[3]).mean() < 2


def test_how_a_clip_was_read_is_kept(tmp_path, capsys):
    """Images with the values of 12 bits are dark; with their level of white, every command reads them so."""
    clip, model = tmp_path / "clips" / "clip", tmp_path / "m.safetensors"
    few = ("--gaussians", 400, "--steps", 5)
    clip.mkdir(parents=True)
    for k, frame in enumerate(blobs()):
        cv2.imwrite(str(clip / f"{k}.png"), frame[..., ::-1].astype(np.uint16) * 16)
    assert run("fit", clip, "--out", model, *few) == 0
    assert "the largest value is 4,080 of 65,535, as in data of 12 bits, which look dark" in capsys.readouterr().err
    assert run("evaluate", model, clip) == 0
    assert "the largest value is 4,080" in capsys.readouterr().err
    write_video(tmp_path / "8.mp4", blobs(), 10.0)
    for options in ((), ("--segment-seconds", 0.1)):
        assert run("fit", clip, "--out", model, "--overwrite", "--levels", 4080, *options, *few) == 0
        assert read_metadata(model)["reading"] == {"levels": 4080}
        assert load_video_model(model).render(0.5).max() > 0.8
        capsys.readouterr()
        assert run("evaluate", model, clip) == 0
        assert "warning" not in capsys.readouterr().err
        assert run("evaluate", model, tmp_path / "8.mp4") == 2
        told = capsys.readouterr().err
        assert "VIDEO: expected the clip that the model was fitted to, clip read with levels=4080, got" in told
        assert run("view", model, "--out", tmp_path / "p.html", "--original", tmp_path / "8.mp4") == 2
        assert "--original: expected the clip that the model was fitted to, clip read with" in capsys.readouterr().err
    assert {"reading"} <= set(CLIP_NOTES)  # which edit and compress keep
    assert run("fit-many", tmp_path / "clips", "--out", tmp_path / "models", "--levels", 4080, *few) == 0
    assert read_metadata(tmp_path / "models" / "clip.fgz")["reading"] == {"levels": 4080}


def test_sound_of_a_range_begins_with_it(tmp_path):
    """Frame 3 is shown at 0.5 s, which no rate tells; a click is heard there."""
    times, model = np.array([0, 0.1, 0.2, 0.5, 0.6, 1.0]), tmp_path / "m.safetensors"
    write_video(tmp_path / "clip.mp4", blobs(), 5.0, times=times)
    samples = np.zeros(16_000, np.int16)
    samples[4000:4400] = 20_000 * np.sin(np.arange(400))
    with wave.open(str(tmp_path / "click.wav"), "wb") as sound:
        sound.setparams((1, 2, 8000, 0, "NONE", ""))
        sound.writeframes(samples.tobytes())
    assert run("fit", tmp_path / "clip.mp4", "--frames", "3:6", "--out", model, *QUICK) == 0
    assert (
        run("render", model, "--sound", tmp_path / "click.wav", "--out", tmp_path / "out.mov", "--codec", "h264") == 0
    )
    np.testing.assert_allclose(read_video(tmp_path / "out.mov").times, times[3:] - 0.5, atol=1e-4)
    with av.open(str(tmp_path / "out.mov")) as container:
        heard = np.concatenate([frame.to_ndarray()[0] for frame in container.decode(audio=0)])
    loud = np.flatnonzero(np.abs(heard) > 0.2) / 48_000
    assert loud[0] < 0.02
    assert 0.03 < loud[-1] < 0.08


def test_one_picture(work, tmp_path, capsys):
    """A .png takes one time, and no more."""
    model, target = work / "model.safetensors", tmp_path / "one.png"
    assert run("render", model, "--out", target, "--times", "0.5", "--size", "24x32") == 0
    assert f"{target}: one image" in capsys.readouterr().out.replace("\n", "")
    video, time = load_video_model(model), np.array([0.5])
    np.testing.assert_array_equal(cv2.imread(str(target))[..., ::-1], next(interpolate_frames(video, time, (24, 32))))
    alone = ("--times", "0.5", "--size", "24x32", "--no-flow", "--overwrite")
    assert run("render", model, "--out", target, *alone) == 0
    np.testing.assert_array_equal(cv2.imread(str(target))[..., ::-1], next(video.frames(time, (24, 32))))
    capsys.readouterr()
    assert run("render", model, "--out", target, "--times", "0.5") == 2
    assert "--overwrite" in capsys.readouterr().err
    assert run("render", model, "--out", tmp_path / "folder", "--times", "0.5") == 0
    assert "1 frame at" in capsys.readouterr().out


def test_remapping_beyond_the_end_is_said(work, tmp_path, capsys):
    """6 frames, 12 a second, last half a second."""
    model = work / "model.safetensors"
    assert run("render", model, "--out", tmp_path / "whole", "--remap", "0=0,0.5=0.5") == 0
    assert "warning" not in capsys.readouterr().err
    assert run("render", model, "--out", tmp_path / "beyond", "--remap", "0=0,0.5=2,1=0") == 0
    told = capsys.readouterr().err
    assert "warning: --remap: expected seconds up to the end of the clip, 0.5, got 2. Its last frame is held" in told
    assert len(told.strip().splitlines()) == 1
    assert read_video(tmp_path / "beyond").num_frames == 13


def test_frames_size_and_default_name(work, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert run("fit", work / "clip.mp4", "--frames", "1:5", "--size", "24x32", *QUICK) == 0
    model = load_video_model(tmp_path / "clip.fgz")
    assert (model.num_frames, model.size) == (4, (24, 32))
    assert read_metadata(tmp_path / "clip.fgz")["budget"] == {"steps": 30, "quality": 70.0}
    # The frames it was fitted to are remembered.
    capsys.readouterr()
    assert run("evaluate", "clip.fgz", work / "clip.mp4") == 0
    assert "warning" not in capsys.readouterr().err
    assert run("evaluate", "clip.fgz", work / "clip.mp4", "--frames", "0:3") == 2


def test_evaluation_of_another_clip_is_said(work, tmp_path, capsys):
    write_video(tmp_path / "other.mp4", blobs()[::-1], 12.0)
    assert run("evaluate", work / "model.safetensors", tmp_path / "other.mp4") == 0
    message = capsys.readouterr().err
    assert re.search(r"warning: the frames of .*other.mp4 are not those .* fitted to \(clip.mp4\)", message)
    (tmp_path / "renamed.mp4").write_bytes((work / "clip.mp4").read_bytes())
    assert run("evaluate", work / "model.safetensors", tmp_path / "renamed.mp4") == 0
    assert "warning" not in capsys.readouterr().err
    model = load_video_model(work / "model.safetensors")
    save_video_model(tmp_path / "bare.safetensors", model)  # nothing is known of its frames
    assert run("evaluate", tmp_path / "bare.safetensors", tmp_path / "other.mp4") == 0
    assert "warning" not in capsys.readouterr().err


def test_clip_with_alpha(tmp_path, capsys):
    """A folder of transparent PNGs, through every command."""
    folder, target = tmp_path / "images", tmp_path / "m.safetensors"
    folder.mkdir()
    for k, frame in enumerate(blobs()):
        alpha = np.zeros((48, 64, 1), np.uint8)
        alpha[8:40, 8:56] = 255
        cv2.imwrite(str(folder / f"{k}.png"), np.concatenate([frame[..., ::-1], alpha], -1))
    arguments = ["--gaussians", "400", "--steps", "120", "--preview", tmp_path / "p.png"]
    assert run("fit", folder, "--out", target, *arguments) == 0
    assert "48x64 with alpha" in capsys.readouterr().out
    assert run("evaluate", target, folder, "--json", tmp_path / "f.json") == 0
    figures = json.loads((tmp_path / "f.json").read_text())
    assert "PSNR over white" in capsys.readouterr().out
    assert figures["mean_psnr_on_white"] > 17
    assert run("render", target, "--out", tmp_path / "white", "--background", "#FFFFFF") == 0
    assert run("render", target, "--out", tmp_path / "black") == 0
    assert run("render", target, "--out", tmp_path / "clear.mov", "--background", "none") == 0
    assert read_video(tmp_path / "clear.mov").has_alpha
    assert run("render", target, "--out", tmp_path / "clear.mp4", "--background", "none") == 2
    white, black = (cv2.imread(str(tmp_path / name / "00000.png")) for name in ("white", "black"))
    assert white[:4].mean() > 225
    assert black[:4].mean() < 30


def test_damaged_video_uses_the_frames_that_decode(tmp_path, capsys):
    noise = np.random.default_rng(0).integers(0, 256, (12, 48, 64, 3)).astype(np.uint8)
    write_video(tmp_path / "whole.webm", noise, 10)
    data = (tmp_path / "whole.webm").read_bytes()
    (tmp_path / "cut.webm").write_bytes(data[: len(data) * 3 // 4])
    assert run("fit", tmp_path / "cut.webm", "--out", tmp_path / "m.safetensors", *QUICK) == 0
    assert re.search(r"only \d+ of 12 frames", capsys.readouterr().err)
    assert 2 <= load_video_model(tmp_path / "m.safetensors").num_frames < 12


def test_help_and_version(capsys):
    assert run("fit", "--help") == 0
    assert "[default:" in capsys.readouterr().out  # brackets are not eaten as markup
    assert run("--version") == 0
    assert re.search(r"foldgauss 0\.1.*Python 3.*, jax .*numba .* threads$", capsys.readouterr().out.strip(), re.DOTALL)


def test_debug_shows_the_traceback(tmp_path):
    with pytest.raises(FileNotFoundError):
        cli.main(["info", str(tmp_path / "none"), "--debug"])


def test_demo_without_the_samples(tmp_path, monkeypatch, capsys):
    def missing(name):
        raise FileNotFoundError('Try: pip install "foldgauss[samples]"')

    monkeypatch.setattr(demonstration, "sample_clip", missing)
    assert run("demo", "--out", tmp_path / "demo") == 2
    assert "foldgauss[samples]" in capsys.readouterr().err
    assert not (tmp_path / "demo").exists()


def test_demo_end_to_end(tmp_path, monkeypatch, capsys):
    """The real clip, fewer frames and steps."""
    monkeypatch.setattr(demonstration, "CONFIG", fitting.FitConfig(num_gaussians=2000, steps=40, quality=80))
    monkeypatch.setattr(demonstration, "FRAMES", (0, 6))
    assert run("demo", "--out", tmp_path) == 0
    names = {"model.fgz", "reconstruction.mp4", "comparison.png", "metrics.json"}
    assert {path.name for path in tmp_path.iterdir()} == names
    figures = json.loads((tmp_path / "metrics.json").read_text())
    assert figures["mean_psnr"] > 22
    assert len(figures["psnr"]) == 6
    assert read_video(tmp_path / "reconstruction.mp4").frames.shape == (6, 160, 320, 3)
    assert "mean PSNR" in capsys.readouterr().out
    assert run("demo", "--out", tmp_path) == 2
    assert "exists. Choose another path, or add --overwrite." in capsys.readouterr().err


@pytest.mark.slow
def test_demo_reaches_its_quality(tmp_path):
    assert run("demo", "--out", tmp_path) == 0
    figures = json.loads((tmp_path / "metrics.json").read_text())
    assert figures["mean_psnr"] >= 30
    assert figures["fit_seconds"] <= 90


@pytest.fixture
def interrupted(monkeypatch):
    """Make the fit send its own process a signal after step 40."""

    def arm(number):
        steps = runner.fit_steps

        def stepping(*arguments):
            for state, info in steps(*arguments):
                if info.step == 40:
                    os.kill(os.getpid(), number)
                yield state, info

        monkeypatch.setattr(runner, "fit_steps", stepping)
        return lambda: monkeypatch.setattr(runner, "fit_steps", steps)

    return arm


def test_stopped_while_scores_are_measured_and_resumed(work, tmp_path, capsys, monkeypatch):
    """The fit is kept, and the same command writes the model of an undisturbed one."""
    fit = ("fit", work / "clip.mp4", "--gaussians", 50, "--steps", 12, "--quiet", "--out")
    assert run(*fit, tmp_path / "whole.safetensors") == 0

    def stopped(*arguments, **options):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(fitting, "evaluate_with_progress", stopped)
        assert run(*fit, tmp_path / "model.safetensors") == 130
    assert "Give the same command again to continue." in capsys.readouterr().err
    assert run(*fit, tmp_path / "model.safetensors") == 0
    assert (tmp_path / "model.safetensors").read_bytes() == (tmp_path / "whole.safetensors").read_bytes()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["model.safetensors", "whole.safetensors"]


@pytest.mark.skipif(not hasattr(signal, "pthread_kill"), reason="signals are POSIX's; CI runs it on Linux")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_stopped_and_resumed(number, work, tmp_path, capsys, interrupted):
    """A signal keeps the fit; the same command ends it; the model equals that of a fit that was never stopped."""
    target, kept = tmp_path / "m.safetensors", tmp_path / "m.safetensors.checkpoint"
    arguments = ["fit", work / "clip.mp4", "--out", target, "--gaussians", "400", "--steps", "80"]
    disarm = interrupted(number)
    assert run(*arguments) == 1
    disarm()
    assert "Give the same command again to continue." in capsys.readouterr().err
    assert kept.exists()
    assert not target.exists()
    assert run(*arguments[:-1], "90") == 2  # not continued as another
    assert run(*arguments, "--frames", "0:5") == 2  # nor with other frames
    assert run(*arguments) == 0
    assert not kept.exists()
    whole = tmp_path / "whole.safetensors"
    assert run(*arguments[:3], whole, *arguments[4:]) == 0
    assert target.read_bytes() == whole.read_bytes()


KEEPING_EVERY_STEP = (
    "from foldgauss.cli import main; from foldgauss.jobs import runner; runner.CHECKPOINT_SECONDS = 0.0; main()"
)


@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="SIGKILL is POSIX's; CI runs it on Linux")
def test_killed_at_any_moment_and_resumed(work, tmp_path):
    """`kill -9` leaves a checkpoint that is whole, from which the fit ends as if it had never been killed."""
    target, kept = tmp_path / "m.safetensors", tmp_path / "m.safetensors.checkpoint"
    options = ["--gaussians", "400", "--steps", "300", "--quiet"]
    command = [sys.executable, "-c", KEEPING_EVERY_STEP, "fit", work / "clip.mp4", "--out", target, *options]
    process = subprocess.Popen(command)
    while process.poll() is None and not (kept.exists() and _step_of(kept) > 37):
        time.sleep(0.01)
    process.kill()
    assert process.wait() == -signal.SIGKILL
    assert not target.exists()
    assert 37 < _step_of(kept) < 300
    assert run(*command[3:]) == 0
    whole = tmp_path / "whole.safetensors"
    assert run("fit", work / "clip.mp4", "--out", whole, *options) == 0
    assert target.read_bytes() == whole.read_bytes()


def _step_of(checkpoint):
    return read_header(checkpoint)["header"]["counters"]["step"]


def test_presets(work, tmp_path, monkeypatch):
    """What is given on the command line is taken from there, all else from the preset."""
    seen, steps = [], runner.fit_steps

    def stepping(frames, config, state):
        seen.append(config)
        return steps(frames, config, state)

    monkeypatch.setattr(runner, "fit_steps", stepping)
    model = tmp_path / "m.safetensors"
    common = ["fit", work / "clip.mp4", "--out", model, "--gaussians", "300", "--overwrite"]
    assert run(*common, "--preset", "paper", "--steps", "60", "--degree", "2", "--max-gaussians", "310") == 0
    assert seen[-1] == fitting.FitConfig.preset("paper", num_gaussians=300, max_gaussians=310, steps=60, degree=2)
    assert load_video_model(model).splats.num_gaussians <= 310
    assert run(*common, "--preset", "draft", "--steps", "9", "--batch-size", "2", "--power", "1", "--seed", "4") == 0
    assert seen[-1] == fitting.FitConfig.preset(
        "draft", num_gaussians=300, steps=9, **{"views.batch_size": 2}, power=1.0, seed=4
    )
    assert run(*common, "--steps", "9") == 0
    assert seen[-1] == fitting.FitConfig(num_gaussians=300, steps=9)
    assert run(*common, "--steps", "9", "--max-gaussians", "200") == 0
    assert load_video_model(model).splats.num_gaussians == 200


def test_names_with_brackets_are_names(tmp_path, capsys):
    folder = tmp_path / "x[red]"
    folder.mkdir()
    write_video(folder / "show [x264] [b].mp4", blobs(), 12.0)
    assert run("fit", folder / "show [x264] [b].mp4", "--out", folder / "m [b].safetensors", *QUICK) == 0
    assert "show [x264] [b].mp4" in capsys.readouterr().out
    assert run("info", folder / "m [b].safetensors") == 0
    assert run("info", folder / "none[/b].safetensors") == 2
    assert "none[/b]" in capsys.readouterr().err


def test_an_unforeseen_error_is_one_line(work, tmp_path, monkeypatch, capsys):
    def broken(*arguments, **options):
        raise RuntimeError("surprise\nand more")

    monkeypatch.setattr(drawing, "load_video_model", broken)
    assert run("info", work / "model.safetensors") == 1
    message = capsys.readouterr().err
    assert "RuntimeError: surprise and more" in message
    assert "--debug" in message
    assert "Traceback" not in message


def test_the_history_of_another_fit_is_left_alone(work, tmp_path, capsys, interrupted):
    target, other = tmp_path / "m.safetensors", tmp_path / "other.jsonl"
    quick = ["fit", work / "clip.mp4", "--gaussians", "400", "--quiet"]
    assert run(*quick, "--steps", "50", "--seed", "1", "--out", tmp_path / "o.safetensors", "--history", other) == 0
    before = other.read_bytes()
    disarm = interrupted(signal.SIGINT)
    assert run(*quick, "--steps", "80", "--out", target, "--history", tmp_path / "own.jsonl") == 1
    disarm()
    resumed = [*quick, "--steps", "80", "--out", target, "--history"]
    assert run(*resumed, other) == 2
    assert "history: expected that of the fit which is resumed at step 40" in capsys.readouterr().err
    assert other.read_bytes() == before
    assert run(*resumed, tmp_path / "own.jsonl") == 0
    assert [json.loads(line)["step"] for line in (tmp_path / "own.jsonl").read_text().splitlines()] == [*range(1, 81)]


def test_overwrite_forgets_a_stopped_fit(work, tmp_path, interrupted, monkeypatch):
    target, kept = tmp_path / "m.safetensors", tmp_path / "m.safetensors.checkpoint"
    disarm = interrupted(signal.SIGINT)
    assert run("fit", work / "clip.mp4", "--out", target, "--gaussians", "400", "--steps", "80") == 1
    disarm()
    assert kept.exists()
    steps = runner.fit_steps

    def killed(after):
        def stepping(*given):
            yield from itertools.islice(steps(*given), after)
            raise OSError("killed")

        return stepping

    for after in (0, 1):  # only a first step takes the place of what was kept
        monkeypatch.setattr(runner, "fit_steps", killed(after))
        assert run("fit", work / "clip.mp4", "--out", target, *QUICK, "--overwrite") == 1
        assert kept.exists() == (after == 0)
