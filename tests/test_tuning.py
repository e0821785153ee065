"""The benchmarks by which defaults are judged and searched: what is kept, continued and said, on tiny clips."""

import dataclasses
import json
import re
import sqlite3

import numpy as np
import pytest

from benchmarks import defaults, step
from benchmarks._clips import folder_sources, sample_sources
from foldgauss.io import write_video
from foldgauss.video import FitConfig

SIZE, NUM_FRAMES = (40, 64), 8


def blob(pace=1.0):
    """A blob that moves to the right."""
    y, x = np.mgrid[0 : SIZE[0], 0 : SIZE[1]]
    center = np.linspace(0.2, 0.2 + 0.5 * pace, NUM_FRAMES)[:, None, None] * SIZE[1]
    light = np.exp(-((x - center) ** 2 + (y - SIZE[0] / 2) ** 2) / 40)
    return np.stack([255 * light, 128 + 0 * light, 255 - 200 * light], -1).astype(np.uint8)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Two clips as subfolders of images."""
    folder = tmp_path_factory.mktemp("clips")
    for name, pace in (("slow", 0.5), ("fast", 1.0)):
        write_video(folder / name, blob(pace), 12.0)
    return folder


def printed(capsys):
    """All that was printed, a space between words, without the lines of tables."""
    return " ".join(re.sub("[│┃|]", " ", capsys.readouterr().out).split())


class TestClips:
    def test_subfolders_are_clips(self, folder):
        sources = folder_sources(folder)
        assert [source.name for source in sources] == ["fast", "slow"]
        assert sources[0].read().frames.shape == (NUM_FRAMES, *SIZE, 3)
        reduced = sources[0]._replace(size=(20, 32), frames=3)
        assert reduced.read().frames.shape == (3, 20, 32, 3)
        described = sources[0].describe()
        assert described["num_files"] == NUM_FRAMES
        assert str(folder) not in json.dumps(described)

    def test_what_is_missing_is_said(self, folder, tmp_path):
        with pytest.raises(SystemExit, match="nowhere is not a folder"):
            folder_sources(tmp_path / "nowhere")
        with pytest.raises(SystemExit, match="has no subfolder"):
            folder_sources(tmp_path)
        (tmp_path / "empty").mkdir()
        write_video(tmp_path / "whole", blob(), 12.0)
        with pytest.raises(SystemExit, match=r"at least 2 images in each of .*: empty has 0\."):
            folder_sources(tmp_path)

    def test_bunny_is_that_of_the_paper(self):
        bunny, carphone = sample_sources(["bunny", "carphone"])
        assert bunny.size == (640, 1280)
        assert carphone.size is None


class TestDefaults:
    @pytest.fixture
    def fits(self, monkeypatch):
        """Fits that take no time, of clips that are not read; their settings."""
        made = []

        def fitted(clip, config, *, with_ssim, cpu_time):
            assert not with_ssim
            made.append(config)
            gaussians = config.max_gaussians or 40_000
            run = {"psnr": 42.5, "worst_psnr": 39.0, "gaussians": gaussians, "floats": 70_000}
            if gaussians < 40_000:
                run["psnr"] = 40.5
            return None, run | {"steps": 100, "seconds": 60.0}

        monkeypatch.setattr(defaults, "fitted", fitted)
        monkeypatch.setattr("benchmarks._clips.ClipSource.read", lambda source: source)
        return made

    def test_every_fit_has_a_figure_asked(self, folder):
        rows = {"psnr": 30.0, "worst_psnr": 29.0, "floats": 1, "worst_below_mean": 1.0}
        names = [*defaults.all_fits(folder, None), *(f"{prefix}mean" for prefix in defaults.FOLDER_CHANGES)]
        assert names[-3:] == ["clips-600k/slow", "clips/mean", "clips-600k/mean"]
        assert all(list(defaults.judgements(name, rows)) for name in names)

    def test_nothing_but_what_a_user_gives(self):
        fits = defaults.all_fits(None, None)
        assert fits["bunny-160"].config == FitConfig(minutes=2)
        assert fits["bunny-160"].source.size == (160, 320)
        assert fits["bunny-640-620k"].config == FitConfig(minutes=10, max_gaussians=620_000)
        assert fits["bunny-640-620k"].source.size == (640, 1280)

    def test_rows_are_kept_and_judged(self, fits, tmp_path, capsys):
        path = tmp_path / "d.json"
        command = ["--only", "bunny-160", "bikes", "carphone", "--json", str(path)]
        defaults.main(command)
        shown = printed(capsys)
        assert len(fits) == 3
        assert "PSNR >= 42 yes" in shown
        assert "PSNR >= 40 yes" in shown
        figures = json.loads(path.read_text())["figures"]
        assert (figures["met_bunny-160"], figures["met_bikes"], figures["met_carphone"]) == (1, 1, 1)
        defaults.main(command)
        assert len(fits) == 3
        defaults.main([*command, "--afresh"])
        assert len(fits) == 6

    def test_rows_of_other_settings_are_fitted_again(self, fits, tmp_path, monkeypatch, capsys):
        command = ["--only", "bunny-160", "carphone", "--json", str(tmp_path / "d.json")]
        defaults.main(command)
        changed = defaults.CASES["carphone"]._replace(changes={"minutes": 3})
        monkeypatch.setitem(defaults.CASES, "carphone", changed)
        defaults.main(command)
        assert [config.minutes for config in fits] == [2, 2, 3]
        assert "carphone: done before with other settings" in printed(capsys)

    def test_finished_rows_outlive_an_interruption(self, fits, tmp_path, monkeypatch):
        command = ["--only", "bunny-160", "carphone", "--json", str(tmp_path / "d.json")]
        fitted = defaults.fitted

        def interrupted(clip, config, **options):
            if clip.name == "carphone":
                raise KeyboardInterrupt
            return fitted(clip, config, **options)

        monkeypatch.setattr(defaults, "fitted", interrupted)
        with pytest.raises(KeyboardInterrupt):
            defaults.main(command)
        monkeypatch.setattr(defaults, "fitted", fitted)
        defaults.main(command)
        assert len(fits) == 2

    def test_half_of_the_gaussians(self, fits, tmp_path, capsys):
        path = tmp_path / "d.json"
        defaults.main(["--only", "bunny-160", "--half", "--json", str(path)])
        assert fits == [FitConfig(minutes=2), FitConfig(minutes=2, max_gaussians=20_000)]
        figures = json.loads(path.read_text())["figures"]
        assert figures["loss_bunny-160"] == pytest.approx(2.0)
        assert figures["met_bunny-160"] == 0
        assert "loss <= 1.5" in printed(capsys)

    def test_unknown_names_are_refused(self, capsys):
        with pytest.raises(SystemExit):
            defaults.main(["--only", "bunny"])
        assert "--only: expected some of bunny-160, bunny-160-1, bunny-640," in capsys.readouterr().err

    def test_clips_of_a_folder(self, folder, monkeypatch, capsys):
        monkeypatch.setitem(defaults.FOLDER_CHANGES, "clips/", {"steps": 10, "num_gaussians": 60})
        defaults.main(["--clips", str(folder), "--only", "clips/fast"])
        shown = printed(capsys)
        assert "mean - worst <= 3" in shown
        assert "clips/mean" in shown
        assert "clips/slow" not in shown


class TestTune:
    @pytest.fixture
    def tune(self):
        pytest.importorskip("optuna", reason="optuna comes with the extra bench")
        from benchmarks import tune

        return tune

    @pytest.fixture
    def fits(self, tune, monkeypatch):
        """Fits that take no time and are best at twice the default of `loc`; their settings."""
        made = []

        def fit_candidate(candidate):
            made.append(candidate.config)
            own = candidate.config
            psnr = 30 - np.log2(own.rates.loc / FitConfig().rates.loc / 2) ** 2 + own.fold_degree
            return {"psnr": psnr, "worst_psnr": psnr - 2, "gaussians": 100, "steps": 50, "cpu_seconds": 1.0}

        monkeypatch.setattr(tune, "fit_candidate", fit_candidate)
        return made

    def command(self, folder, study, *more):
        given = ["--clips", str(folder), "--cpu-seconds", "1", "--only", "loc", "degree"]
        return [*given, *(["--study", str(study)] if study else []), *more]

    def test_defaults_are_in_the_space(self, tune):
        parameters = tune.default_parameters()
        assert parameters.keys() == tune.SPACE.keys()
        for name, value in parameters.items():
            assert tune.SPACE[name].low <= value <= tune.SPACE[name].high
        assert tune.configuration(parameters, 30.0, None) == dataclasses.replace(tune.DEFAULT, minutes=0.5)
        assert tune.configuration({"loc": 2.0}, 60, 9).rates.loc == 2 * FitConfig().rates.loc

    def test_the_first_trial_is_the_default(self, tune, fits, folder, tmp_path, capsys):
        path = tmp_path / "t.json"
        tune.main(self.command(folder, None, "--trials", "12", "--json", str(path)))
        assert len(fits) == 2 * 12
        assert fits[0] == fits[1] == dataclasses.replace(tune.DEFAULT, minutes=1 / 60)
        kept = json.loads(path.read_text())
        assert kept["figures"]["psnr_default"] == pytest.approx(32.0)
        best = max(trial["psnr"] for trial in kept["trials"])
        assert kept["figures"]["gain"] == kept["figures"]["gain_fast"] == best - 32
        assert [trial["number"] for trial in kept["trials"]] == list(range(12))
        assert set(kept["best"]) == {"loc", "degree"}
        assert "Best of 12 trials" in printed(capsys)

    def test_an_interrupted_search_ends_as_a_whole_one(self, tune, fits, folder, tmp_path, monkeypatch):
        def parameters(name):
            return [each["parameters"] for each in json.loads((tmp_path / name).read_text())["trials"]]

        tune.main(self.command(folder, None, "--trials", "13", "--json", str(tmp_path / "a.json")))
        fit, count = tune.fit_candidate, iter(range(100))

        def interrupted(candidate):
            if next(count) in (1, 24):  # of trial 0, and of one that TPE proposes
                raise KeyboardInterrupt
            return fit(candidate)

        monkeypatch.setattr(tune, "fit_candidate", interrupted)
        command = self.command(folder, tmp_path / "study.db", "--trials", "13", "--json", str(tmp_path / "b.json"))
        for _ in range(2):
            with pytest.raises(KeyboardInterrupt):
                tune.main(command)
        tune.main(command)
        assert parameters("b.json") == parameters("a.json")
        study = tune.optuna.load_study(study_name=tune.NAME, storage=f"sqlite:///{tmp_path / 'study.db'}")
        assert [trial.state.name for trial in study.trials].count("FAIL") == 2
        before = len(fits)
        tune.main(command)
        assert len(fits) == before
        tune.main([*command, "--trials", "14"])
        assert len(fits) == before + 2

    def test_studies_of_other_settings_are_refused(self, tune, fits, folder, tmp_path, capsys):
        study = tmp_path / "study.db"
        tune.main(self.command(folder, study, "--trials", "1"))
        with pytest.raises(SystemExit):
            tune.main(self.command(folder, study, "--trials", "1", "--seed", "1"))
        assert "is of another setting: seed." in capsys.readouterr().err
        study.write_text("no database, but long enough to be read as the header of one" * 10)
        with pytest.raises(SystemExit):
            tune.main(self.command(folder, study))
        assert "expected a SQLite file of Optuna" in capsys.readouterr().err
        with pytest.raises(sqlite3.DatabaseError):
            sqlite3.connect(study).execute("select 1 from sqlite_master")

    def test_a_search_in_use_is_refused(self, tune, fits, folder, tmp_path, capsys):
        study = tmp_path / "study.db"
        with tune.hold_lock(tmp_path / "study.db.lock"), pytest.raises(SystemExit):
            tune.main(self.command(folder, study))
        assert "is used by another search" in capsys.readouterr().err

    def test_a_diverging_candidate_is_pruned(self, tune, folder, monkeypatch, capsys):
        run = {"psnr": 30.0, "worst_psnr": 29.0, "gaussians": 100, "steps": 50, "cpu_seconds": 1.0}
        monkeypatch.setattr(
            tune,
            "fit_candidate",
            lambda candidate: (
                run
                if candidate.config == dataclasses.replace(tune.DEFAULT, minutes=1 / 60)
                else {"diverged": "at step 7"}
            ),
        )
        tune.main(self.command(folder, None, "--trials", "3"))
        shown = printed(capsys)
        assert "(of 3): diverged, loc x" in shown
        assert "Best of 1 trials" in shown

    def test_divergence_is_a_result(self, tune, folder, monkeypatch):
        def diverge(*given, **options):
            raise tune.FitDiverged("at step 7", None)
            yield

        monkeypatch.setattr(tune, "prepare_process", lambda num_frames: None)
        monkeypatch.setattr(tune, "fit_steps", diverge)
        (source, _) = folder_sources(folder)
        assert tune.fit_candidate(tune.Candidate(source, FitConfig())) == {"diverged": "at step 7"}

    def test_clips_are_needed(self, tune, folder, tmp_path, monkeypatch):
        with pytest.raises(SystemExit, match="No clips: give --clips FOLDER"):
            tune.main(["--cpu-seconds", "1"])
        write_video(tmp_path / "bikes", blob(), 12.0)
        with pytest.raises(SystemExit, match="other names than those of --samples, got bikes"):
            tune.main(["--cpu-seconds", "1", "--clips", str(tmp_path), "--samples", "bikes"])

    def test_tiny(self, tune, folder, tmp_path):
        path = tmp_path / "t.json"
        given = ["--trials", "2", "--gaussians", "80", "--frames", "4", "--size", "24x32", "--json", str(path)]
        tune.main([*self.command(folder, None, *given), "--cpu-seconds", "0.2"])
        kept = json.loads(path.read_text())
        runs = [run for trial in kept["trials"] for run in trial["clips"].values()]
        assert len(runs) == 4
        assert all(run["psnr"] > 10 and run["gaussians"] == 80 and run["cpu_seconds"] < 2 for run in runs)


class TestStep:
    def test_every_part_is_timed(self):
        """A function that the fit no longer calls would leave its part at zero."""
        config = FitConfig(num_gaussians=200, degree=2, steps=40)
        records, state, num_alive = step.measure(blob(), config, num_steps=3)
        assert len(records) == 3
        assert len(state.rows) == 200
        assert 0 < num_alive <= 200
        for record in records:
            assert set(record) == {*step.PARTS, "total"}
            assert all(seconds > 0 for part, seconds in record.items() if part != "other")
        assert step.figures_of(records, naive=1.0, num_alive=num_alive)["total_ms"] > 0


def test_rates_of_several_qualities(folder, tmp_path, capsys, monkeypatch):
    rates = pytest.importorskip("benchmarks.rate_distortion", reason="its figure needs the extra 'plot'")
    codec = rates.CODECS[rates.REFERENCE]._replace(factors=(12, 42))
    monkeypatch.setattr(rates, "CODECS", {rates.REFERENCE: codec})
    paths = {name: tmp_path / f"rates.{name}" for name in ("json", "png")}
    options = ["--only", "slow", "--minutes", "0.02", "--qualities", "30", "80", "--figure", str(paths["png"])]
    rates.main(["--clips", str(folder), *options, "--json", str(paths["json"])])
    assert "foldgauss" in printed(capsys)
    kept = json.loads(paths["json"].read_text())
    coarse, fine = (kept["runs"][f"slow, foldgauss, quality {quality}"] for quality in (30, 80))
    assert coarse["minutes"] == fine["minutes"] == 0.02
    assert all(coarse[name] < fine[name] for name in ("bytes", "psnr", "gaussians"))
    assert kept["bd_rates"].keys() == {"slow"}
    assert paths["png"].exists()
