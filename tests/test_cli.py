"""The command as a user meets it: real files, exit codes, one-line errors, nothing half-written."""

import itertools
import json
import re
import shutil
import signal
from unittest.mock import Mock

import av
import cv2
import numpy as np
import pytest
from commands import call, interrupted_fit, run, write_tone

from foldgauss import cli
from foldgauss.cli.fitting import demo as demonstration
from foldgauss.cli.fitting import fit as fitting
from foldgauss.cli.viewing import info as drawing
from foldgauss.io import load_video_model, read_video, save_video_model, write_video
from foldgauss.io.models.video_model import read_metadata
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


def test_fit_render_evaluate_info(work, tmp_path):
    model = load_video_model(work / "model.safetensors")
    assert (model.num_frames, model.size, model.fps) == (6, SIZE, 12.0)
    assert not list(work.glob("*.checkpoint"))

    assert run("render", work / "model.safetensors", "--out", tmp_path / "slow.mp4", "--fps", 48) == 0
    slow = read_video(tmp_path / "slow.mp4")
    assert (slow.num_frames, slow.size, slow.fps) == (21, SIZE, 48.0)

    assert run("render", work / "model.safetensors", "--out", tmp_path / "frames", "--size", "96x128") == 0
    assert len(list((tmp_path / "frames").glob("*.png"))) == 6
    assert cv2.imread(str(tmp_path / "frames" / "00000.png")).shape == (96, 128, 3)

    figures = tmp_path / "figures.json"
    call("evaluate", work / "model.safetensors", work / "clip.mp4", "--json", figures, out="bits per pixel")
    scores = json.loads(figures.read_text())
    assert len(scores["psnr"]) == len(scores["ssim"]) == 6
    assert scores["mean_psnr"] == pytest.approx(np.mean(scores["psnr"]), abs=1e-3)
    assert scores["mean_psnr"] > 20
    num_bytes = (work / "model.safetensors").stat().st_size
    assert scores["bits_per_pixel"] == pytest.approx(8 * num_bytes / (6 * 48 * 64))
    call("info", work / "model.safetensors", out=["400", "power 1"])


def test_render_of_one_frame(work, tmp_path, monkeypatch):
    model = work / "model.safetensors"
    images = list(load_video_model(model).frames())
    for k in (0, 3, -1):
        assert run("render", model, "--frame", k, "--out", tmp_path / f"{k}.png") == 0
        np.testing.assert_array_equal(read_video(tmp_path / f"{k}.png").frames[0], images[k])
    monkeypatch.chdir(tmp_path)
    assert run("render", model, "--frame", 2) == 0
    assert (tmp_path / "model.png").exists()


def test_render_chooses_the_encoding(work, tmp_path):
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
    sound = ("--sound", write_tone(tmp_path / "sound.wav", 0.5))
    for name, seconds, *slow in (("speed.mp4", 1.0, "--speed", "0.5"), ("rate.mp4", 0.5, "--fps", "24")):
        assert run("render", model, "--out", tmp_path / name, *slow, *sound) == 0
        with av.open(str(tmp_path / name)) as container:
            heard = sum(frame.samples / frame.sample_rate for frame in container.decode(audio=0))
        assert heard == pytest.approx(seconds, abs=0.1)


def test_other_rates_speeds_and_times(work, tmp_path):
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
    call(
        "render",
        work / "model.safetensors",
        "--out",
        tmp_path / "v.mp4",
        "--speed",
        0.25,
        out="21 frames at 12 frames per second",
    )
    assert read_video(tmp_path / "v.mp4").fps == pytest.approx(12)


def test_a_variable_frame_rate_is_kept(tmp_path):
    """Frames are shown at the times of the clip's; at another speed or rate, its seconds are divided evenly."""
    times, end, model = np.array([0, 3, 6, 14, 17, 31]) / 30, 41 / 30, tmp_path / "m.safetensors"
    write_video(tmp_path / "clip.mp4", blobs(), 5.0, times=[*times, end])
    call(
        "fit",
        tmp_path / "clip.mp4",
        "--out",
        model,
        *QUICK,
        err="shown for 0.1 to 0.467 s, 4.839 per second on average",
    )
    assert "frame_seconds" not in call("info", model, out="4.39 per second on average").out
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


def test_sound_of_a_range_begins_with_it(tmp_path):
    """Frame 3 is shown at 0.5 s, which no rate tells; a click is heard there."""
    times, model = np.array([0, 0.1, 0.2, 0.5, 0.6, 1.0]), tmp_path / "m.safetensors"
    write_video(tmp_path / "clip.mp4", blobs(), 5.0, times=times)
    write_tone(tmp_path / "click.wav", 0.55, start=0.5)
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


def test_one_picture(work, tmp_path):
    """A .png takes one time, and no more."""
    model, target = work / "model.safetensors", tmp_path / "one.png"
    assert f"{target}: one image" in call(
        "render", model, "--out", target, "--times", "0.5", "--size", "24x32"
    ).out.replace("\n", "")
    video, time = load_video_model(model), np.array([0.5])
    np.testing.assert_array_equal(cv2.imread(str(target))[..., ::-1], next(interpolate_frames(video, time, (24, 32))))
    alone = ("--times", "0.5", "--size", "24x32", "--no-flow", "--overwrite")
    assert run("render", model, "--out", target, *alone) == 0
    np.testing.assert_array_equal(cv2.imread(str(target))[..., ::-1], next(video.frames(time, (24, 32))))
    call("render", model, "--out", target, "--times", "0.5", code=2, err="--overwrite")
    call("render", model, "--out", tmp_path / "folder", "--times", "0.5", out="1 frame at")


def test_remapping_beyond_the_end_is_said(work, tmp_path):
    """6 frames, 12 a second, last half a second."""
    render = ("render", work / "model.safetensors", "--out")
    assert "warning" not in call(*render, tmp_path / "whole", "--remap", "0=0,0.5=0.5").err
    told = "warning: --remap: expected seconds up to the end of the clip, 0.5, got 2. Its last frame is held"
    assert len(call(*render, tmp_path / "beyond", "--remap", "0=0,0.5=2,1=0", err=told).err.splitlines()) == 1
    assert read_video(tmp_path / "beyond").num_frames == 13


def test_frames_size_and_default_name(work, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert run("fit", work / "clip.mp4", "--frames", "1:5", "--size", "24x32", *QUICK) == 0
    model = load_video_model(tmp_path / "clip.fgz")
    assert (model.num_frames, model.size) == (4, (24, 32))
    assert read_metadata(tmp_path / "clip.fgz")["budget"] == {"steps": 30, "quality": 70.0}
    # The frames it was fitted to are remembered.
    assert "warning" not in call("evaluate", "clip.fgz", work / "clip.mp4").err
    assert run("evaluate", "clip.fgz", work / "clip.mp4", "--frames", "0:3") == 2


def test_evaluation_of_another_clip_is_said(work, tmp_path):
    model, other = work / "model.safetensors", write_video(tmp_path / "other.mp4", blobs()[::-1], 12.0)
    told = ["warning: the frames of", "other.mp4", "are not those", "fitted to (clip.mp4)"]
    call("evaluate", model, other, err=told)
    renamed = shutil.copy(work / "clip.mp4", tmp_path / "renamed.mp4")
    assert "warning" not in call("evaluate", model, renamed).err
    bare = save_video_model(tmp_path / "bare.safetensors", load_video_model(model))  # nothing is known of its frames
    assert "warning" not in call("evaluate", bare, other).err


def test_clip_with_alpha(tmp_path):
    """A folder of transparent PNGs, through every command."""
    folder, target = tmp_path / "images", tmp_path / "m.safetensors"
    folder.mkdir()
    for k, frame in enumerate(blobs()):
        alpha = np.zeros((48, 64, 1), np.uint8)
        alpha[8:40, 8:56] = 255
        cv2.imwrite(str(folder / f"{k}.png"), np.concatenate([frame[..., ::-1], alpha], -1))
    arguments = ["--gaussians", "400", "--steps", "120"]
    call("fit", folder, "--out", target, *arguments, out="48x64 with alpha")
    call("evaluate", target, folder, "--json", tmp_path / "f.json", out="PSNR over white")
    figures = json.loads((tmp_path / "f.json").read_text())
    assert figures["mean_psnr_on_white"] > 17
    assert run("render", target, "--out", tmp_path / "white", "--background", "#FFFFFF") == 0
    assert run("render", target, "--out", tmp_path / "black") == 0
    assert run("render", target, "--out", tmp_path / "clear.mov", "--background", "none") == 0
    assert read_video(tmp_path / "clear.mov").has_alpha
    assert run("render", target, "--out", tmp_path / "clear.mp4", "--background", "none") == 2
    white, black = (cv2.imread(str(tmp_path / name / "00000.png")) for name in ("white", "black"))
    assert white[:4].mean() > 225
    assert black[:4].mean() < 30


def test_version():
    assert re.search(r"foldgauss 0\.1.*Python 3.*, jax .*numba .* threads$", call("--version").out.strip(), re.DOTALL)


def test_debug_shows_the_traceback(tmp_path):
    with pytest.raises(FileNotFoundError):
        cli.main(["info", str(tmp_path / "none"), "--debug"])


def test_demo_without_the_samples(tmp_path, monkeypatch):
    missing = Mock(side_effect=FileNotFoundError('Try: pip install "foldgauss[samples]"'))
    monkeypatch.setattr(demonstration, "sample_clip", missing)
    call("demo", "--out", tmp_path / "demo", code=2, err="foldgauss[samples]")
    assert not (tmp_path / "demo").exists()


def test_demo_end_to_end(tmp_path, monkeypatch):
    """The real clip, fewer frames and steps."""
    monkeypatch.setattr(demonstration, "CONFIG", fitting.FitConfig(num_gaussians=2000, steps=40, quality=80))
    monkeypatch.setattr(demonstration, "FRAMES", (0, 6))
    call("demo", "--out", tmp_path, out="mean PSNR")
    names = {"model.fgz", "reconstruction.mp4", "comparison.png", "metrics.json"}
    assert {path.name for path in tmp_path.iterdir()} == names
    figures = json.loads((tmp_path / "metrics.json").read_text())
    assert figures["mean_psnr"] > 22
    assert len(figures["psnr"]) == 6
    assert read_video(tmp_path / "reconstruction.mp4").frames.shape == (6, 160, 320, 3)
    call("demo", "--out", tmp_path, code=2, err="exists. Choose another path, or add --overwrite.")


@pytest.mark.slow
def test_demo_reaches_its_quality(tmp_path):
    assert run("demo", "--out", tmp_path) == 0
    figures = json.loads((tmp_path / "metrics.json").read_text())
    assert figures["mean_psnr"] >= 30
    assert figures["fit_seconds"] <= 90


def test_stopped_while_scores_are_measured_and_resumed(work, tmp_path, monkeypatch):
    """The fit is kept, and the same command writes the model of an undisturbed one."""
    fit = ("fit", work / "clip.mp4", "--gaussians", 50, "--steps", 12, "--quiet", "--out")
    assert run(*fit, tmp_path / "whole.safetensors") == 0
    with monkeypatch.context() as patch:
        patch.setattr(fitting, "evaluate_with_progress", Mock(side_effect=KeyboardInterrupt))
        call(*fit, tmp_path / "model.safetensors", code=130, err="Give the same command again to continue.")
    assert run(*fit, tmp_path / "model.safetensors") == 0
    assert (tmp_path / "model.safetensors").read_bytes() == (tmp_path / "whole.safetensors").read_bytes()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["model.safetensors", "whole.safetensors"]


@pytest.mark.skipif(not hasattr(signal, "pthread_kill"), reason="signals are POSIX's; CI runs it on Linux")
@pytest.mark.parametrize(
    ("name", "number", "step"), [("m.safetensors", signal.SIGINT, 40), ("m.fgz", signal.SIGTERM, 77)]
)
def test_stopped_and_resumed(name, number, step, work, tmp_path):
    """A signal, also between the steps of rounding, keeps the fit; resumed it ends with the same bytes."""
    fit = ("fit", work / "clip.mp4", "--gaussians", 400, "--steps", 80, "--out")
    with interrupted_fit(step, number):
        call(*fit, tmp_path / name, code=1, err="Give the same command again to continue.")
    assert [path.name for path in tmp_path.iterdir()] == [f"{name}.checkpoint"]
    # It is not thrown away by accident, nor continued as another.
    for options in (("--steps", 90), ("--frames", "0:5"), ("--quality", 60)):
        assert run(*fit, tmp_path / name, *options) == 2
    assert run(*fit, tmp_path / name) == 0
    assert run(*fit, tmp_path / f"whole-{name}") == 0
    assert (tmp_path / name).read_bytes() == (tmp_path / f"whole-{name}").read_bytes()
    assert len(list(tmp_path.iterdir())) == 2


STANDARD = fitting.FitConfig(num_gaussians=300, steps=9)
OPTIONS = {
    "--steps 9": STANDARD,
    "--steps 9 --max-gaussians 200": STANDARD.replace(max_gaussians=200),
    "--preset paper --steps 60 --degree 2 --max-gaussians 310": fitting.FitConfig.preset(
        "paper", num_gaussians=300, max_gaussians=310, steps=60, degree=2
    ),
    "--preset draft --steps 9 --batch-size 2 --power 1 --seed 4": fitting.FitConfig.preset(
        "draft", num_gaussians=300, steps=9, **{"views.batch_size": 2}, power=1.0, seed=4
    ),
    "--steps 9 --ssim-fraction 0.3 --error-fraction 0.1": STANDARD.replace(
        **{"loss.ssim_fraction": 0.3, "views.error_fraction": 0.1}
    ),
}


@pytest.mark.parametrize("options", OPTIONS)
def test_options_reach_the_fit(work, tmp_path, monkeypatch, options):
    """What is given on the command line is taken from there, all else from the preset."""
    steps = Mock(side_effect=OSError("seen"))
    monkeypatch.setattr(runner, "fit_steps", steps)
    fit = ("fit", work / "clip.mp4", "--out", tmp_path / "m.safetensors", "--gaussians", 300)
    call(*fit, *options.split(), code=1, err="seen")
    assert steps.call_args.args[1] == OPTIONS[options]


def test_names_with_brackets_are_names(tmp_path):
    folder = tmp_path / "x[red]"
    folder.mkdir()
    write_video(folder / "show [x264] [b].mp4", blobs(), 12.0)
    call(
        "fit", folder / "show [x264] [b].mp4", "--out", folder / "m [b].safetensors", *QUICK, out="show [x264] [b].mp4"
    )
    assert run("info", folder / "m [b].safetensors") == 0
    call("info", folder / "none[/b].safetensors", code=2, err="none[/b]")


def test_an_unforeseen_error_is_one_line(work, monkeypatch):
    monkeypatch.setattr(drawing, "load_video_model", Mock(side_effect=RuntimeError("surprise\nand more")))
    told = call("info", work / "model.safetensors", code=1, err=["RuntimeError: surprise and more", "--debug"])
    assert "Traceback" not in told.err


def test_the_history_of_another_fit_is_left_alone(work, tmp_path):
    own, other = tmp_path / "own.jsonl", tmp_path / "other.jsonl"
    fit = ["fit", work / "clip.mp4", "--gaussians", "400", "--quiet", "--steps", "80", "--history"]
    fit_other = [*fit[:-2], "50", "--seed", "1", "--history", other, "--out", tmp_path / "o.safetensors"]
    assert run(*fit_other) == 0
    before = other.read_bytes()
    with interrupted_fit(40):
        assert run(*fit, own, "--out", tmp_path / "m.safetensors") == 1
    resume = ("--out", tmp_path / "m.safetensors")
    call(*fit, other, *resume, code=2, err="history: expected that of the fit which is resumed at step 40")
    assert other.read_bytes() == before
    assert run(*fit, own, *resume) == 0
    assert [json.loads(line)["step"] for line in own.read_text().splitlines()] == [*range(1, 81)]


def test_overwrite_forgets_a_stopped_fit(work, tmp_path, monkeypatch):
    fit = ("fit", work / "clip.mp4", "--out", tmp_path / "m.safetensors", *QUICK)
    with interrupted_fit(20):
        assert run(*fit) == 1
    kept, steps = tmp_path / "m.safetensors.checkpoint", runner.fit_steps
    assert kept.exists()

    def killed(after):
        def stepping(*given, **options):
            yield from itertools.islice(steps(*given, **options), after)
            raise OSError("killed")

        return stepping

    for after in (0, 1):  # only a first step takes the place of what was kept
        monkeypatch.setattr(runner, "fit_steps", killed(after))
        assert run(*fit, "--overwrite") == 1
        assert kept.exists() == (after == 0)
