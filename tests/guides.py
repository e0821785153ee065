"""The programs in README and the guides, extracted and run as a reader would.

The language of every fenced block determines how it is tested:

| language | handling |
|---|---|
| `python` | run, all blocks of a page in order as one program |
| `sh` | run, between the page's Python blocks, in the order of the page |
| `toml` | read as an edit script by the test of its page |
| `text`, `math` | output, or a formula: nothing to run |

A block without one of these languages is refused, as are commands that stand in an indented block, so that none
is missed. All of a page runs in one folder, which contains the clip and what else the page presupposes (`GIVEN`).

Commands run in this process, where kernels are compiled once, with the arguments of the page and these exceptions:

- `CHEAPER` adds options that reduce the number of steps of long commands, unless the command has them itself.
- `foldgauss.video.fit` takes as many steps as stated, or `STEPS` for more than `SHORT` minutes or no budget.
- `foldgauss demo` takes all its steps on one page, README, and `STEPS` of 600 Gaussians at `SIZE` on others.
- Workers are tested elsewhere: with `--workers` and `--scheduler` this process does the work; the options of `dask` are
  looked up.
- `foldgauss view` makes its page and its server, opens no browser, and ends as by Ctrl-C.
- `git`, `cd`, `pip`, `pytest`, `ruff` and so on are not run: what they name (extras, files, markers) is looked up.
  `python -m benchmarks...` has its arguments parsed by the benchmark's own parser and goes no further.
"""

import argparse
import ast
import dataclasses
import functools
import importlib
import re
import shlex
import tomllib
import warnings
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import cv2
import jax
import numpy as np
import pytest
from commands import run, write_tone
from markdown_it import MarkdownIt
from PIL import Image

from foldgauss import video
from foldgauss.cli.app.application import load_commands
from foldgauss.cli.fitting import demo
from foldgauss.cli.viewing import view as viewing
from foldgauss.io import Sound, datasets, save_video_model, write_frames, write_vegas_ply, write_video
from foldgauss.video import FitConfig, VideoModel, fit

ROOT = Path(__file__).parents[1]
#: All pages of the documentation.
PAGES = sorted(str(path.relative_to(ROOT)) for path in (*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")))
RUN, READ = ("python", "sh"), ("toml", "text", "math")
#: First words of commands, to find them in indented blocks.
_COMMAND = re.compile(r"\s*(?:\$ )?(?:foldgauss|pip|python|pytest|mkdocs|ruff|git|bash|lint-imports)\b")

#: Its name, and that of the folder that it is cloned to.
PROJECT = "foldgauss"

#: Steps of a fit without a number of steps.
STEPS = 100
#: Longest stated budget of a fit, in minutes, that is kept.
SHORT = 0.2
#: Options added to commands, unless they have them.
CHEAPER = {
    "fit": ["--steps", STEPS],
    "tradeoff": ["--steps", STEPS],
    "uncertainty": ["--steps", 100],
    "compress": ["--minutes", 0.02],
}
#: The page whose `foldgauss demo` takes all its steps; on others it is small.
WHOLE_DEMO = "README.md"
#: One axis for `tradeoff` without axes, instead of all nine, which have their own tests.
ONE_AXIS = ["--axes", "power"]
SIZE, NUM_FRAMES = (48, 80), 12


class Block(NamedTuple):
    """A fenced block: its language, its text, and the line it begins at."""

    language: str
    text: str
    line: int


def blocks(page: str) -> Iterator[Block]:
    """All fenced blocks of a page, those within lists and quotes too, in order."""
    for token in MarkdownIt().enable("table").parse((ROOT / page).read_text()):
        if token.type == "fence":
            yield Block(token.info.strip(), token.content, token.map[0] + 1)
        if token.type == "code_block":
            yield Block("indented", token.content, token.map[0] + 1)


def check_languages(page: str) -> None:
    """Every block has a known language, and no indented block contains a command."""
    for block in blocks(page):
        where = f"{page}:{block.line}"
        if block.language == "indented":
            assert not any(map(_COMMAND.match, block.text.splitlines())), f"{where}: a command; fence it as sh"
        else:
            assert block.language in RUN + READ, f"{where}: expected one of {RUN + READ}, got {block.language!r}"


def check_names(page: str) -> None:
    """What a page imports from the project exists, and the project's commands have the options that the page gives."""
    for block in blocks(page):
        if block.language == "python":
            imports = (
                node for node in ast.walk(ast.parse(block.text)) if isinstance(node, ast.Import | ast.ImportFrom)
            )
            own = [node for node in imports if ast.unparse(node).split()[1].startswith(PROJECT)]
            exec(compile(ast.Module(own, []), str(ROOT / page), "exec"), {})
        elif block.language == "sh":
            for name, *words in (words[1:] for words in commands(block.text) if words[0] == PROJECT):
                parameters = load_commands(name)[name].params
                known = {option for one in parameters for option in (*one.opts, *one.secondary_opts)}
                given = {word.partition("=")[0] for word in words if word.startswith("--")}
                assert given <= known, f"{page}:{block.line}: foldgauss {name} has no {given - known}"


def commands(text: str) -> Iterator[list[str]]:
    """The words of each command of a shell block."""
    for line in text.replace("\\\n", " ").splitlines():
        for command in line.removeprefix("$ ").split("&&"):
            words = shlex.split(command, comments=True)
            if words:
                yield words


def run_page(page: str, folder: Path, monkeypatch) -> dict:
    """Run all of a page in `folder`; the names that its Python leaves."""
    give(page, folder)
    monkeypatch.chdir(folder)
    monkeypatch.setattr(video, "fit", _fit)
    if page != WHOLE_DEMO:
        monkeypatch.setattr(demo, "CONFIG", dataclasses.replace(demo.CONFIG, steps=STEPS, num_gaussians=600))
        monkeypatch.setattr(demo, "SIZE", SIZE)
    names = {"__name__": "guide"}
    # As a reader has JAX: the suite's own rules are stricter.
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        _run_blocks(page, names)
    return names


def _run_blocks(page: str, names: dict) -> None:
    for block in blocks(page):
        if block.language == "python":
            # Lines before it, so that a traceback tells the page's own.
            source = "\n" * block.line + block.text
            exec(compile(source, str(ROOT / page), "exec"), names)
        elif block.language == "sh":
            for words in commands(block.text):
                _run_command(words, f"{page}:{block.line}")


def _fit(frames, config: FitConfig | None = None, **options):
    """`foldgauss.video.fit`, in `STEPS` steps where it would take minutes."""
    config = FitConfig() if config is None else config
    if config.steps is None and (config.minutes is None or config.minutes > SHORT):
        config = dataclasses.replace(config, steps=STEPS, minutes=None, num_gaussians=config.num_gaussians or 600)
    return fit(frames, config, **options)


def _run_command(words: list[str], where: str) -> None:
    tool = "benchmarks" if words[:2] == ["python", "-m"] and words[2].startswith("benchmarks") else words[0]
    assert tool in _TOOLS, f"{where}: no way to run {tool!r} is known, see tests/guides.py"
    _TOOLS[tool](words[1:], where)


def _foldgauss(words: list[str], where: str) -> None:
    words = _alone(words)
    more = CHEAPER.get(words[0], [])
    if words[0] == "compress" and (len(words) < 3 or words[2].startswith("-")):
        more = []  # without a clip there are no steps
    given = {word.partition("=")[0] for word in words}
    if not given & {"--steps", "--minutes", "--only"}:
        words = [*words, *more]
    if "--minutes" in given and words[0] in ("fit", "tradeoff"):
        at = words.index("--minutes")
        words = [*words[:at], *words[at + 2 :], *more]
    if words[0] == "fit" and "--gaussians" not in given and "--preset" not in given:
        words = [*words, "--gaussians", 600]
    if words[0] == "tradeoff" and "--axes" not in given:
        words = [*words, *ONE_AXIS]
    with warnings.catch_warnings(), pytest.MonkeyPatch.context() as patch:
        patch.setattr(viewing.webbrowser, "open", lambda url: True)
        patch.setattr(viewing.PageServer, "serve_forever", _ended)
        # What a reader would see as a line; the suite makes errors of warnings, and few steps give some.
        warnings.simplefilter("default")
        code = run(*words)
    assert code == 0, f"{where}: foldgauss {' '.join(map(str, words))}"


def _alone(words: list[str]) -> list[str]:
    """A command without its workers; a fit that they would do in segments is done in segments."""
    for option in ("--workers", "--scheduler"):
        if option in words:
            at = words.index(option)
            segments = ["--segment-seconds", "10"] if words[0] == "fit" else []
            words = [*words[:at], *words[at + 2 :], *segments]
    return words


def _dask(words: list[str], where: str) -> None:
    """Its subcommand and options are those of `dask`."""
    known = importlib.import_module(f"distributed.cli.dask_{words[0]}").main.params
    options = {option for parameter in known for option in parameter.opts}
    assert {word for word in words if word.startswith("--")} <= options, where


def _ended(server) -> None:
    raise KeyboardInterrupt


def _look_up(words: list[str], where: str) -> None:
    """What a command names is there: extras of this project, files, and markers of the suite."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    names = [word for word in words if word.partition("[")[0] in (".", PROJECT)]
    extras = {extra for name in names for extra in re.findall(r"\w+", name.partition("[")[2])}
    assert extras <= project["project"]["optional-dependencies"].keys(), f"{where}: {extras}"
    markers = {marker.partition(":")[0] for marker in project["tool"]["pytest"]["ini_options"]["markers"]}
    for option, value in pairwise(["", *words]):
        assert option != "-m" or value in markers, f"{where}: no marker {value!r}"
        assert option != "-c" or (ROOT / value).exists(), f"{where}: {value}"
        is_file = value.startswith((".ci/", "tests/"))
        assert not is_file or (ROOT / value.partition("::")[0]).exists(), f"{where}: {value}"


def _pip(words: list[str], where: str) -> None:
    asked = [word for option, word in pairwise(words) if "-c" not in (option, word) and word != "-e"]
    assert words[0] == "install"
    assert asked, where
    assert all(re.fullmatch(rf"(\.|{PROJECT})(\[[\w,]+\])?", word) for word in asked), f"{where}: {asked}"
    _look_up(words, where)


def check_benchmark(words: list[str], where: str) -> None:
    """Its parser takes the arguments; it measures nothing here."""
    module = importlib.import_module(words[1])

    class Parsed(Exception):
        """Stops a benchmark once its arguments are parsed."""

    def parse_args(self, args=None, namespace=None):
        parse(self, args, namespace)
        raise Parsed

    parse = argparse.ArgumentParser.parse_args
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(argparse.ArgumentParser, "parse_args", parse_args)
        try:
            module.main(words[2:])
        except Parsed:
            return
        except SystemExit as stopped:
            pytest.fail(f"{where}: python -m {' '.join(words[1:])} is refused ({stopped.code})")
    pytest.fail(f"{where}: {words[1]} parses no arguments")


_TOOLS = {
    "foldgauss": _foldgauss,
    "pip": _pip,
    "benchmarks": check_benchmark,
    "dask": _dask,
    **dict.fromkeys(("git", "cd", "pytest", "bash", "ruff", "lint-imports", "mkdocs", "jupyter"), _look_up),
}


# What pages take for granted.


@functools.cache
def _clip() -> np.ndarray:
    return datasets.bikes(frames=(30, 30 + NUM_FRAMES), size=SIZE).frames  # something moves


@functools.cache
def _fitted() -> VideoModel:
    return fit(_clip(), FitConfig(num_gaussians=600, steps=STEPS), fps=25.0).model


def _video(name: str):
    def make(folder: Path) -> None:
        silence = write_tone(folder / "tone.wav", 1.0)
        write_video(folder / name, _clip(), 25.0, sound=Sound(silence))
        silence.unlink()

    return make


def _model(name: str):
    def make(folder: Path) -> None:
        save_video_model(folder / name, _fitted())

    return make


def _images(name: str):
    def make(folder: Path) -> None:
        (folder / name).parent.mkdir(parents=True)
        write_frames(folder / name, _clip())

    return make


def _masks(folder: Path) -> None:
    """Of something that rolls to the right, one for each frame."""
    (folder / "masks").mkdir()
    y, x = np.mgrid[0 : SIZE[0], 0 : SIZE[1]] + 0.5
    for k in range(NUM_FRAMES):
        mask = (x - 20 - 3 * k) ** 2 + (y - 24) ** 2 < 90
        Image.fromarray(255 * mask.astype(np.uint8)).save(folder / "masks" / f"{k:05}.png")


def _davis(folder: Path) -> None:
    """A tree of DAVIS' layout with the sequence bear."""
    for part in ("JPEGImages", "Annotations"):
        (folder / "DAVIS" / part / "480p" / "bear").mkdir(parents=True)
    for k in range(4):
        picture = np.full((480, 480, 3), 20 * k, np.uint8)
        cv2.imwrite(str(folder / "DAVIS" / "JPEGImages" / "480p" / "bear" / f"{k:05}.jpg"), picture)
        mask = Image.fromarray(np.zeros((480, 480), np.uint8)).convert("P")
        mask.save(folder / "DAVIS" / "Annotations" / "480p" / "bear" / f"{k:05}.png")


def _edit_script(folder: Path) -> None:
    (folder / "edits.toml").write_text('[[edits]]\ndo = "rotate"\ndegrees = 5\nabout = [0, 0]\n')


def _holidays(folder: Path) -> None:
    """A folder with clips."""
    (folder / "holidays").mkdir()
    write_video(folder / "holidays" / "beach.mp4", _clip(), 25.0)


def _ply(folder: Path) -> None:
    """A video as the published code writes it."""
    model = fit(_clip(), FitConfig(num_gaussians=100, steps=5, follow_camera=False), fps=24.0).model
    write_vegas_ply(folder / "point_cloud.ply", model)


#: By name as pages write it.
THINGS = {
    **{name: _video(name) for name in ("holiday.mp4", "clip.mp4", "film.mp4")},
    **{f"{name}.safetensors": _model(f"{name}.safetensors") for name in ("holiday", "model")},
    "folder/of/images": _images("folder/of/images"),
    "masks": _masks,
    "point_cloud.ply": _ply,
    "DAVIS": _davis,
    "holidays": _holidays,
    "edits.toml": _edit_script,
}
#: What each page takes for granted.
GIVEN = {
    "README.md": ("holiday.mp4", "masks", "film.mp4", "holidays"),
    "docs/commands.md": ("holiday.mp4",),
    "docs/compress.md": ("holiday.mp4",),
    "docs/editing.md": ("holiday.mp4", "holiday.safetensors", "edits.toml", "masks"),
    "docs/fit.md": ("holiday.mp4", "DAVIS", "folder/of/images"),
    "docs/format.md": ("holiday.mp4", "holiday.safetensors"),
    "docs/formats.md": ("holiday.safetensors", "point_cloud.ply"),
    "docs/index.md": ("holiday.mp4",),
    "docs/player.md": ("holiday.mp4", "holiday.safetensors"),
    "docs/quickstart.md": ("holiday.mp4",),
    "docs/results.md": ("holiday.mp4",),
    "docs/scale.md": ("film.mp4", "holidays"),
    "docs/slow-motion.md": ("holiday.mp4",),
    "docs/uncertainty.md": ("clip.mp4",),
}


def give(page: str, folder: Path) -> None:
    for name in GIVEN.get(page, ()):
        THINGS[name](folder)
