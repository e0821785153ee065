"""`foldgauss doctor`: it tells what is missing, sees what is broken, and never breaks itself."""

import importlib.metadata
import json
import re

import numpy as np
import pytest
from commands import run

from foldgauss.cli.measuring import diagnosis, doctor
from foldgauss.cli.measuring.diagnosis import Trial

WELL = [Trial("draw", True, 0.1, 2.0, "drawn"), Trial("fit", True, 0.2, 0.1, "40 dB")]


@pytest.fixture
def well(monkeypatch):
    """Trials that went well, in no time."""
    monkeypatch.setattr(doctor, "run_trials", lambda: iter(WELL))


@pytest.fixture(scope="module")
def tried():
    return list(diagnosis.run_trials())


def test_the_trials_go_well_here(tried):
    assert [one.name for one in tried if not one.ok] == []
    assert len(tried) == 4
    assert all(one.seconds < 10 for one in tried)
    decibels = [float(found[1]) for one in tried if (found := re.search(r"([\d.]+) dB", one.message))]
    assert len(decibels) == 1
    assert min(decibels) > 30


def test_a_wrong_picture_is_seen(monkeypatch):
    """Engine xla a hundredth too bright, or black, or broken."""
    honest = diagnosis.render

    def spoiled(how):
        def render(*arguments, engine):
            picture = honest(*arguments, engine=engine)
            return how(picture) if engine == "xla" else picture

        drawn = {}
        monkeypatch.setattr(diagnosis, "render", render)
        assert diagnosis._run_trial("reference", lambda: diagnosis._render("reference", drawn)).ok
        return diagnosis._run_trial("xla", lambda: diagnosis._render("xla", drawn))

    def broken(picture):
        raise RuntimeError("no [such] engine")

    assert spoiled(lambda picture: picture).ok
    for how, told in (
        (lambda picture: picture + 0.01, "expected a difference from engine reference of at most 0.005"),
        (lambda picture: 0 * picture, "empty"),
        (lambda picture: picture * np.nan, "not finite"),
        (broken, "RuntimeError: no [such] engine"),
    ):
        trial = spoiled(how)
        assert not trial.ok
        assert told in trial.message
        assert "Reinstall" in trial.cure


def test_report(well, capsys):
    assert run("doctor") == 0
    told = capsys.readouterr().out
    for text in ("python", "jaxlib", "usable of", "threads", "GPU"):
        assert text in told
    assert "No problems; the trials took 0.3 s, and compilation 2.1 s more" in told


def test_json_and_nothing_else(well, capsys):
    assert run("doctor", "--json") == 0
    told = json.loads(capsys.readouterr().out)
    assert told["well"] is True
    assert told["problems"] == []
    assert told["versions"]["numpy"] == np.__version__
    assert told["machine"]["cores_usable"] >= 1
    assert [one["name"] for one in told["trials"]] == ["draw", "fit"]
    assert not [name for name, found in told.items() if isinstance(found, dict) and "unknown" in found]


def test_missing_extras_are_told_with_their_cure(well, monkeypatch, capsys):
    known = importlib.metadata.version

    def version(name):
        if name in ("matplotlib", "emcee", "numpyro", "scikit-learn", "sk-video", "distributed"):
            raise importlib.metadata.PackageNotFoundError(name)
        return known(name)

    monkeypatch.setattr(importlib.metadata, "version", version)
    assert run("doctor") == 0  # extras are optional
    told = " ".join(capsys.readouterr().out.split())  # however wide the terminal was
    for extra in ("plot", "uncertainty", "numpyro", "sklearn", "samples", "distributed"):
        assert f"pip install 'foldgauss[{extra}]'" in told
    assert "no emcee" in told
    assert run("doctor", "--json") == 0
    found = json.loads(capsys.readouterr().out)
    assert found["extras"]["plot"] == {"matplotlib": None}


def test_what_is_broken_is_told_and_exits_1(monkeypatch, capsys):
    failed = Trial("fit a clip", False, 0.1, 0.0, "3.0 dB", "Do this.")
    monkeypatch.setattr(doctor, "run_trials", lambda: iter([*WELL, failed]))
    assert run("doctor") == 1
    told = capsys.readouterr().out
    assert "Problems were found" in told
    assert "fit a clip: 3.0 dB. Do this." in told
    assert run("doctor", "--json") == 1
    assert json.loads(capsys.readouterr().out)["problems"] == ["fit a clip: 3.0 dB. Do this."]


def test_a_missing_requirement_is_a_problem(well, monkeypatch, capsys):
    known = importlib.metadata.version

    def version(name):
        if name == "optax":
            raise importlib.metadata.PackageNotFoundError(name)
        return known(name)

    monkeypatch.setattr(importlib.metadata, "version", version)
    assert run("doctor", "--json") == 1
    assert "missing: optax. pip install" in json.loads(capsys.readouterr().out)["problems"][0]


def test_nothing_that_cannot_be_found_out_breaks_it(well, monkeypatch, capsys):
    """Each question of its own raises: the report tells so, and goes on."""

    def unknown():
        raise RuntimeError("nobody knows")

    for name in ("find_versions", "find_extras", "describe_machine", "find_engines"):
        monkeypatch.setattr(diagnosis, name, unknown)
    run("doctor")
    assert capsys.readouterr().out.count("nobody knows") >= 4
    run("doctor", "--json")
    assert json.loads(capsys.readouterr().out)["engines"] == {"unknown": "RuntimeError: nobody knows"}


def test_threads_say_why(monkeypatch):
    monkeypatch.delenv("FOLDGAUSS_NUM_THREADS", raising=False)
    assert "one for each core" in diagnosis.describe_machine()["threads_because"]
    monkeypatch.setenv("FOLDGAUSS_NUM_THREADS", "3")
    found = diagnosis.describe_machine()
    assert (found["threads"], found["threads_because"]) == (3, "set by FOLDGAUSS_NUM_THREADS")
