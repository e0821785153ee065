"""Help, examples, what the Tab key offers, and the names of outputs that were given none."""

import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import typer
from commands import call, run
from soft_models import soft_model

from foldgauss.cli.app.application import app, load_commands
from foldgauss.cli.app.registry import COMMANDS, EXAMPLES
from foldgauss.io import save_video_model, write_vegas_ply, write_video

#: Of a terminal; Typer's help and ours go by it.
WIDTHS = (80, 160)


def commands() -> dict[str, object]:
    """Every command by its name as it is typed, and the application."""
    every = load_commands()
    return {"": typer.main.get_command(app)} | every


NAMES = sorted(commands())


@pytest.mark.parametrize("name", NAMES)
def test_every_command_has_examples_that_parse(name):
    assert EXAMPLES.get(name), f"foldgauss {name} --help shows no example"
    for line in EXAMPLES[name].values():
        words = shlex.split(line.partition(" > ")[0])
        assert words[0] == "foldgauss"
        assert " ".join(words[1:]).startswith(name)
        assert len(line) < 90, "longer than most terminals are wide"
        command, rest = commands()[""], words[1:]
        if not rest[0].startswith("-"):
            command, rest = command.commands[rest[0]], rest[1:]
        if rest != ["--install-completion"]:
            command.make_context("foldgauss", rest)  # raises for an option that there is not


@pytest.mark.parametrize("width", WIDTHS)
@pytest.mark.parametrize("name", NAMES)
def test_help_shows_options_defaults_and_examples(name, width, monkeypatch):
    monkeypatch.setenv("COLUMNS", str(width))
    told = call(*name.split(), "--help").out
    for line in EXAMPLES[name].values():
        assert f"     {line}\n" in told  # whole, to be copied
    panels = told.partition(" Examples\n")[0]
    assert all(len(line) <= width for line in panels.splitlines())
    text = " ".join(re.sub("[│╭╮╰╯─]", " ", panels).split())
    for parameter in commands()[name].params:
        if parameter.param_type_name == "option":
            assert (parameter.opts[0] in text) != parameter.hidden
    assert "\\[" not in text  # brackets are told as they are


def test_the_list_of_commands_says_what_each_says_of_itself():
    assert sorted(load_commands()) == sorted(COMMANDS)
    for name, command in load_commands().items():
        assert command.help.partition("\n\n")[0] == COMMANDS[name].summary


@pytest.mark.parametrize("width", [80, 200])
def test_help_of_a_fit_fits_on_two_screens_and_tells_defaults_in_brackets(width, monkeypatch):
    monkeypatch.setenv("COLUMNS", str(width))
    defaults = ["[default: standard]", "[default: 10,000,000]", "in this folder]"]
    assert len(call("fit", "--help", out=defaults if width == 200 else ()).out.splitlines()) <= 100


def test_alone_it_shows_the_first_command(capsys):
    run()
    told = capsys.readouterr()
    assert "foldgauss demo" in told.out + told.err


def completions(words: str, folder: Path, monkeypatch, capsys) -> list[str]:
    """What bash is told for the last of these words."""
    typed = f"foldgauss {words}"
    monkeypatch.chdir(folder)
    monkeypatch.setenv("_FOLDGAUSS_COMPLETE", "complete_bash")
    monkeypatch.setenv("COMP_WORDS", typed)
    monkeypatch.setenv("COMP_CWORD", str(len(typed.split(" ")) - 1))
    run()
    return [line for line in capsys.readouterr().out.split("\n") if line]


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ("re", ["render"]),
        ("fit --preset ", ["standard", "draft", "paper"]),
        ("fit --preset dr", ["draft"]),
        ("fit --compositing ", ["over", "sum"]),
        ("fit --q", ["--quality", "--quiet"]),
        ("export m.safetensors --format ply", ["ply", "ply3dgs"]),
        ("render m.safetensors --format ", ["png", "webp"]),
        ("uncertainty m c --noise s", ["score"]),
        ("render ", []),  # files are completed by the shell
    ],
)
def test_completion(words, expected, tmp_path, monkeypatch, capsys):
    (tmp_path / "one.fgz").touch()
    assert completions(words, tmp_path, monkeypatch, capsys) == expected


def test_completion_is_offered_to_the_shell():
    """By another process, with Typer's own switch for tests: else it looks for the shell that it runs in."""
    words = [sys.executable, "-m", "foldgauss", "--show-completion", "bash"]
    env = os.environ | {"_TYPER_COMPLETE_TEST_DISABLE_SHELL_DETECTION": "1"}
    told = subprocess.run(words, env=env, capture_output=True, text=True, timeout=120)
    assert "_FOLDGAUSS_COMPLETE=complete_bash" in told.stdout
    assert told.stdout.rstrip().endswith("foldgauss")


@pytest.fixture(scope="module")
def work(tmp_path_factory):
    """A clip and a model, as `foldgauss fit holiday.mp4` leaves them."""
    folder = tmp_path_factory.mktemp("work")
    model = soft_model()
    write_video(folder / "holiday.mp4", model.frames(), 12.0)
    save_video_model(folder / "holiday.safetensors", model, metadata={"clip": "holiday.mp4"})
    save_video_model(folder / "beach.safetensors", model, metadata={"clip": "holiday.mp4"})
    write_vegas_ply(folder / "video.ply", model)
    (folder / "night.toml").write_text('[[edits]]\ndo = "recolor"\ngain = 0.5\n')
    return folder


@pytest.fixture
def here(work, tmp_path, monkeypatch):
    monkeypatch.chdir(shutil.copytree(work, tmp_path / "work"))
    return tmp_path / "work"


@pytest.mark.parametrize(
    ("words", "made"),
    [
        ("render beach.safetensors", "beach.mp4"),
        ("render holiday.safetensors", "holiday.rendered.mp4"),  # not the clip
        ("render beach.safetensors --times 0.5", "beach.png"),
        ("render beach.safetensors --format webp", "beach-frames"),
        ("edit holiday.safetensors night.toml", "holiday.night.safetensors"),
        ("compress holiday.safetensors", "holiday.fgz"),
        ("export holiday.safetensors --format ply", "holiday.ply"),
        ("export holiday.safetensors --format ply3dgs", "holiday-3dgs"),
        ("export holiday.safetensors --format ply3dgs --times 0.5", "holiday.3dgs.ply"),
        ("export holiday.safetensors --format obj", "holiday-obj"),
        ("render beach.safetensors --stabilize smooth", "beach.stable.mp4"),
        ("export beach.safetensors --format obj --times 0.5", "beach-obj"),
        ("import video.ply", "video.safetensors"),
    ],
)
def test_outputs_are_named_after_inputs(words, made, here):
    inputs, before = {*here.iterdir()}, {path: path.read_bytes() for path in here.rglob("*.*")}
    call(*words.split(), out=made)  # its name is told
    assert {*here.iterdir()} - inputs == {here / made}
    # And it is not replaced.
    call(*words.split(), code=1 if made.endswith(("-3dgs", "-obj")) else 2, err=[made, "overwrite"])
    assert run(*words.split(), "--overwrite") == 0
    assert {path: path.read_bytes() for path in before} == before


def test_only_the_commands_asked_for_are_loaded():
    """A command that was only listed so far must not replace one that another thread has imported."""
    assert list(load_commands("info")) == ["info"]
    assert load_commands("nonsense") == {}
