"""The benchmarks that the documentation cites: each starts, long ones continue, and the paper's figures are quoted."""

import dataclasses
import json
import re
import shlex
import statistics
from pathlib import Path

import cv2
import guides
import numpy as np
import pytest

import benchmarks
from benchmarks import davis, defaults, folding_gain, frame_times, reproduce
from benchmarks._clips import folder_sources
from benchmarks._runs import Runs, scaled
from foldgauss.envelope import TimeLikelihood
from foldgauss.io import Clip, write_video
from foldgauss.video import FitConfig, fit_steps
from foldgauss.video.fitting.loop import start
from foldgauss.video.models.row_layout import unpack

SIZE, NUM_FRAMES = (24, 32), 6
TEXT = "\n".join((guides.ROOT / page).read_text() for page in guides.PAGES if page != "CHANGELOG.md")
COMMANDS = sorted(path.stem for path in Path(benchmarks.__file__).parent.glob("[a-z]*.py"))


def blob(num_frames=NUM_FRAMES, size=SIZE):
    """A blob that moves to the right, at the same pace throughout."""
    y, x = np.mgrid[0 : size[0], 0 : size[1]]
    center = np.linspace(0.2, 0.7, num_frames)[:, None, None] * size[1]
    light = np.exp(-((x - center) ** 2 + (y - size[0] / 2) ** 2) / 20)
    return np.stack([255 * light, 128 + 0 * light, 255 - 200 * light], -1).astype(np.uint8)


CLIP = Clip(blob(), 12.0, "blob", NUM_FRAMES)


@pytest.fixture(scope="module")
def clip(tmp_path_factory):
    return write_video(tmp_path_factory.mktemp("clip") / "clip", blob(), 12.0)


@pytest.mark.parametrize("name", COMMANDS)
def test_every_benchmark_is_cited_by_commands_that_it_takes(name):
    """In the documentation, inline or in a block."""
    pytest.importorskip("matplotlib", reason="figures need the extra 'plot'")
    command = rf"python -m benchmarks\.{name}\b"
    found = re.findall(f"(?<=`){command}[^`]*|^{command}.*", TEXT, re.MULTILINE)
    assert found
    for cited in found:
        guides.check_benchmark(shlex.split(cited, comments=True)[1:], cited)


# ------------------------------------------------------------------------------------------------ finished runs


def test_a_finished_run_is_not_made_again(tmp_path):
    made = []

    def make(name):
        made.append(name)
        if name == "b":
            raise KeyboardInterrupt
        return {"psnr": 30.0 + len(made)}

    for _ in range(2):
        runs = Runs(tmp_path / "r.json", {"size": (24, 32), "seed": 0})
        assert runs.get("a", lambda: make("a"))["psnr"] == 31.0
        with pytest.raises(KeyboardInterrupt):
            runs.get("b", lambda: make("b"))
    assert made == ["a", "b", "b"]
    with pytest.raises(SystemExit, match=r"--json: .* holds runs with seed 0 instead of 1"):
        Runs(tmp_path / "r.json", {"size": (24, 32), "seed": 1})
    (tmp_path / "other.json").write_text("[]")
    with pytest.raises(SystemExit, match="--json: expected a file of finished runs"):
        Runs(tmp_path / "other.json", {})


def test_defaults_give_nothing_but_what_a_user_gives(clip, tmp_path, monkeypatch):
    """A finished fit is kept as long as its settings are the same."""
    fits = defaults.all_fits(clip.parent)
    assert fits["bunny-160"].config == FitConfig(minutes=2)
    assert fits["bunny-640-620k"].config == FitConfig(minutes=10, max_gaussians=620_000)
    assert fits["bunny-640-620k"].source.size == (640, 1280)
    made = []
    row = {"psnr": 42.5, "worst_psnr": 39.0, "steps": 100, "seconds": 60.0}
    monkeypatch.setattr(defaults, "fitted", lambda clip, config, **how: made.append(config) or (None, row))
    monkeypatch.setattr("benchmarks._clips.ClipSource.read", lambda source: source)
    command = ["--clips", str(clip.parent), "--only", "bunny-160", "clips/clip", "--json", str(tmp_path / "d.json")]
    for _ in range(2):
        defaults.main(command)
    monkeypatch.setitem(defaults.FOLDER_CHANGES, "clips/", {"minutes": 3})
    defaults.main(command)
    assert [config.minutes for config in made] == [2, 10, 3]
    figures = json.loads((tmp_path / "d.json").read_text())["figures"]
    assert (figures["met_bunny-160"], figures["met_clips/clip"], figures["met_clips/mean"]) == (1, 0, 1)


def test_folders_without_clips_are_refused(clip, tmp_path):
    (source,) = folder_sources(clip.parent)
    assert source._replace(size=(12, 16), frames=3).read().frames.shape == (3, 12, 16, 3)
    for folder, said in ((tmp_path / "nowhere", "is not a folder"), (tmp_path, "has no subfolder"), (clip, "no sub")):
        with pytest.raises(SystemExit, match=said):
            folder_sources(folder)


def test_rates_of_several_qualities(clip, tmp_path, monkeypatch):
    rates = pytest.importorskip("benchmarks.rate_distortion", reason="its figure needs the extra 'plot'")
    write_video(tmp_path / "clips" / "blob", blob(8, (40, 64)), 12.0)
    codec = rates.CODECS[rates.REFERENCE]._replace(factors=(12, 42))
    monkeypatch.setattr(rates, "CODECS", {rates.REFERENCE: codec})
    figure, record = tmp_path / "rates.png", tmp_path / "rates.json"
    options = ["--minutes", "0.02", "--qualities", "30", "80", "--figure", str(figure), "--json", str(record)]
    rates.main(["--clips", str(tmp_path / "clips"), *options])
    kept = json.loads(record.read_text())
    coarse, fine = (kept["runs"][f"blob, foldgauss, quality {quality}"] for quality in (30, 80))
    assert all(coarse[name] < fine[name] for name in ("bytes", "psnr", "gaussians"))
    assert kept["bd_rates"].keys() == {"blob"}
    assert figure.exists()


# ----------------------------------------------------------------------------------------- the paper's tables


@pytest.mark.parametrize("table", davis.TABLES.values(), ids=lambda table: table.label)
def test_the_papers_averages_are_those_of_its_figures(table):
    """So a figure copied wrongly shows. (That of VeGaS-480p is 0.017 dB off in the paper itself.)"""
    for method, values in table.paper.items():
        assert len(values) == len(table.sequences) + 1, method
        for kind, error in ((0, 0.006), (1, 0.0011)):
            *own, average = (value[kind] for value in values)
            error = 0.018 if method == "VeGaS-480p" else error
            if average is not None:
                assert statistics.fmean(own) == pytest.approx(average, abs=error), method


def test_both_tables_on_davis(tmp_path, capsys):
    """Sequences in both sizes and in one; what is missing is named, and beside ours stands the paper's."""
    for folder, name in (("480p", "bear"), ("Full-Resolution", "bear"), ("Full-Resolution", "cows"), ("1080p", "dog")):
        place = tmp_path / "JPEGImages" / folder / name
        place.mkdir(parents=True)
        for k, frame in enumerate(blob(2, (40, 60))):
            cv2.imwrite(str(place / f"{k:05d}.jpg"), np.ascontiguousarray(frame[..., ::-1]))
    quick = ["--steps", "10", "--gaussians", "60", "--crop", "24x36", "--json", str(tmp_path / "d.json")]
    davis.main(["--root", str(tmp_path), *quick])
    kept = json.loads((tmp_path / "d.json").read_text())
    sizes = {name: run["size"] for name, run in kept["runs"].items()}
    whole, window = [40, 60], [24, 36]
    assert sizes == {
        "Full-Resolution/bear": whole,
        "Full-Resolution/cows": whole,
        "480p/bear": whole,
        "Full-Resolution/cows, window 24x36": window,
        "1080p/dog, window 24x36": window,
    }
    own = [kept["runs"][f"Full-Resolution/{name}"]["psnr"] for name in ("bear", "cows")]
    above = statistics.fmean(own) - (31.79 + 27.64) / 2
    assert kept["figures"]["above_paper_table:sota-comparison_Full"] == pytest.approx(above)
    assert "480p/cows, 480p/elephant" in " ".join(capsys.readouterr().out.split())


def test_folded_and_independent_models_have_as_many_parameters(clip, tmp_path):
    command = ["--clip", str(clip), "--size", "24x32", "--gaussians", "60", "--minutes", "0.01"]
    folding_gain.main([*command, "--json", str(tmp_path / "f.json")])
    runs = json.loads((tmp_path / "f.json").read_text())["runs"]
    folded, alone = (runs[f"clip {name}"] for name in (folding_gain.FOLDED, folding_gain.ALONE))
    assert folded["floats"] - 9 < alone["floats"] + 9 * 5  # the rest is less than a Gaussian in each frame
    assert alone["floats"] <= folded["floats"]


@pytest.mark.parametrize("seed", range(3))
def test_uneven_frame_times_are_recovered_where_they_are_found(seed):
    shown = frame_times.uneven(102, 0.2, seed)
    steps = np.diff(shown)
    assert (shown[0], shown[-1]) == (0, 101)
    assert (steps >= 0).all()
    assert 102 - len(np.unique(shown)) == 20
    assert (steps == 0).sum() == 16
    true = frame_times.recovered(shown / shown[-1], shown)
    assert true["rmse"] < 1e-12 < 0.3 < true["rmse_even"]
    assert true["correlation"] == pytest.approx(1)
    assert true["correlation_of_steps"] == pytest.approx(1)
    assert (true["step_where_doubled"], true["step_elsewhere"]) == (pytest.approx(0), pytest.approx(1))
    assert true["step_where_dropped"] >= 2


@pytest.mark.slow
def test_learned_times_find_what_was_done(tmp_path):
    """A blob at a constant pace: the true times are what makes its fold simple."""
    write_video(tmp_path / "long", blob(24, (32, 64)), 12.0)
    command = ["--clip", str(tmp_path / "long"), "--gaussians", "300", "--steps", "2000"]
    frame_times.main([*command, "--json", str(tmp_path / "t.json")])
    figures = json.loads((tmp_path / "t.json").read_text())["figures"]
    assert figures["correlation_of_steps"] > 0.7
    assert figures["step_where_doubled"] < figures["step_elsewhere"] < figures["step_where_dropped"]
    assert figures["rmse"] < 0.85 * figures["rmse_even"]
    assert figures["psnr_learned"] > figures["psnr_fixed"] + 0.5


class TestReproduce:
    """`benchmarks.reproduce`: fits of hours, which continue where they were interrupted."""

    def test_each_fit_differs_from_the_preset_in_one_thing(self):
        made = {name: reproduce.config_of(name, (640, 1280), 30_000, 0) for name in reproduce.VARIANTS}
        first = made["as published"]
        assert first == FitConfig.preset("paper", seed=0)
        changed = {
            name: {field for field in vars(first) if getattr(first, field) != getattr(config, field)}
            for name, config in made.items()
        }
        assert changed.pop("as published") == changed.pop("start in a box of 1.1 frames") == set()
        assert changed.pop("extent of 1 unit") == {"rates", "strategy"}
        assert all(len(fields) == 1 for fields in changed.values())

    def test_a_start_in_a_larger_box(self, tmp_path, monkeypatch):
        """Positions and sizes of the first state; the fit begins with it."""
        name, begun = "start in a box of 1.1 frames", []
        config = dataclasses.replace(reproduce.config_of(name, SIZE, 4, 0), num_gaussians=50)

        def steps(frames, config, state):
            begun.append(unpack(state.rows, config.fold_degree, TimeLikelihood()))
            yield from fit_steps(frames, config, state)

        monkeypatch.setattr(reproduce, "fit_steps", steps)
        reproduce.run_to_end(CLIP, name, config, tmp_path)
        plain = unpack(start(CLIP.frames, config).rows, config.fold_degree, TimeLikelihood())
        np.testing.assert_allclose(begun[0].loc, 1.1 * plain.loc, rtol=1e-6)
        np.testing.assert_allclose(np.exp(begun[0].log_scale), 1.1 * np.exp(plain.log_scale), rtol=1e-5)

    def test_the_paper_is_quoted(self):
        """Sums of both tables, added up from the paper: table:bs-pol row by row, and table:init-gauss."""
        rows = reproduce.PAPER_GRID.values()
        assert [round(sum(psnr for psnr, _ in row), 2) for row in rows] == [186.12, 191.62, 189.59]
        assert [round(sum(millions for _, millions in row), 2) for row in rows] == [8.31, 2.95, 1.59]
        starts = reproduce.PAPER_STARTS.values()
        assert [round(sum(column), 2) for column in list(zip(*starts, strict=True))[:2]] == [233.21, 3.81]
        cells = [reproduce.config_of(name, (640, 1280), 30_000, 0) for name in reproduce.CELLS]
        assert len({(one.num_gaussians, one.views.batch_size, one.degree) for one in cells}) == 20
        assert reproduce.published("100,000, batch 5, degree 3") == (37.94, 0.32)
        assert reproduce.published("as published") == (39.02, 0.65)
        assert reproduce.published("degree 1") is None

    def test_a_smaller_fit_is_the_same_in_pixels(self):
        assert scaled(500_000, (160, 320)) == 31_250
        full, half = (reproduce.config_of("as published", size, 30_000, 0) for size in ((640, 1280), (320, 640)))
        assert half.num_gaussians == full.num_gaussians / 4
        # A Gaussian of as many pixels is twice as long, and moves twice as far; each pixel weighs four times as much in
        # the mean, and is twice as wide in half widths.
        for length in "clone_below", "prune_scale", "screen_gradient", "time_gradient":
            assert getattr(half.strategy.growth, length) == 2 * getattr(full.strategy.growth, length)
        assert (half.rates.loc, half.rates.coefficients) == (2 * full.rates.loc, 2 * full.rates.coefficients)
        assert half.rates.log_scale == full.rates.log_scale
        assert half.strategy.scale_cutoff == 2 * full.strategy.scale_cutoff

    def test_an_interrupted_fit_continues(self, tmp_path, monkeypatch):
        """Stopped between checkpoints, it goes on from the last one: model and curve are those of a whole run."""
        monkeypatch.setattr(reproduce, "EVERY", 2)
        monkeypatch.setattr(reproduce, "CHECKPOINT_SECONDS", 0.0)
        config = dataclasses.replace(reproduce.config_of("as published", SIZE, 6, 0), num_gaussians=50)
        whole = reproduce.run_to_end(CLIP, "whole", config, tmp_path)
        steps = reproduce.fit_steps

        def interrupted(*arguments):
            for state, info in steps(*arguments):
                if info.step == 4:
                    raise KeyboardInterrupt
                yield state, info

        monkeypatch.setattr(reproduce, "fit_steps", interrupted)
        with pytest.raises(KeyboardInterrupt):
            reproduce.run_to_end(CLIP, "parts", config, tmp_path)
        monkeypatch.setattr(reproduce, "fit_steps", steps)
        with pytest.raises(ValueError, match="expected seed=0"):  # never overwritten
            reproduce.run_to_end(CLIP, "parts", dataclasses.replace(config, seed=1), tmp_path)
        again = reproduce.run_to_end(CLIP, "parts", config, tmp_path)
        assert (again["psnr"], again["gaussians"], again["steps"]) == (whole["psnr"], whole["gaussians"], 6)
        parts, other = (reproduce.read_curve(tmp_path / f"{name}.csv") for name in ("parts", "whole"))
        assert [point[:3] for point in parts] == [point[:3] for point in other]
        assert [point[0] for point in parts] == [2, 4, 6]
        assert not (tmp_path / "parts.checkpoint").exists()
