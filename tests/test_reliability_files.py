"""A disk that is full, a folder that cannot be written, a process that is killed: nothing is lost, nothing half there.

Disks are full in two ways: a file system of some kilobytes, where this may be mounted, and a limit to the size of
files, which needs no rights. The long runs: `python -m benchmarks.reliability`.
"""

import contextlib
import os
import shutil
import signal
import subprocess
import sys

import numpy as np
import pytest
from commands import run

from benchmarks import _kills, _long, _outputs
from foldgauss._runtime import kernels as _kernels
from foldgauss.cli.fitting import fit as fitting
from foldgauss.io import load_video_model, save_video_model, write_video
from foldgauss.io._atomic import lock_output
from foldgauss.io.models.model_file import load_model, read_header
from foldgauss.jobs import runner

resource = pytest.importorskip("resource", reason="limits to the size of files are POSIX's; CI runs it on Linux")

SMALL = ["--gaussians", "400", "--steps", "30", "--no-follow-camera", "--quiet"]
SCRIPT = '[[edits]]\ndo = "move"\noffset = [0.1, 0.0]\n'
OLDER = b"older"


@pytest.fixture(scope="module")
def work(tmp_path_factory):
    """A clip, a model fitted to it and a script of edits."""
    folder = tmp_path_factory.mktemp("work")
    y, x = np.mgrid[0:48, 0:64]
    blob = np.exp(-((x - 64 * np.linspace(0.2, 0.7, 6)[:, None, None]) ** 2 + (y - 24) ** 2) / 40)[..., None]
    noise = np.random.default_rng(0).integers(0, 50, (6, 48, 64, 3))  # without it, files are too small to be cut off
    write_video(folder / "clip.mp4", (blob * [200, 100, 50] + noise).astype(np.uint8), 12.0)
    (folder / "move.toml").write_text(SCRIPT)
    assert run("fit", folder / "clip.mp4", "--out", folder / "model.safetensors", *SMALL) == 0
    return folder


class Limited:
    """A folder, and a limit to the size of all files that this process writes."""

    def __init__(self, folder):
        self.folder = folder

    def fill(self):
        resource.setrlimit(resource.RLIMIT_FSIZE, (8, resource.getrlimit(resource.RLIMIT_FSIZE)[1]))

    def empty(self):
        _, most = resource.getrlimit(resource.RLIMIT_FSIZE)
        resource.setrlimit(resource.RLIMIT_FSIZE, (most, most))


class Small:
    """A file system of its own, which is filled to its last byte."""

    def __init__(self, folder):
        self.folder, self.ballast = folder, folder / "ballast"

    def fill(self):
        with open(self.ballast, "ab", buffering=0) as file, contextlib.suppress(OSError):
            while file.write(bytes(4096)):
                pass

    def empty(self):
        self.ballast.unlink(missing_ok=True)


@contextlib.contextmanager
def mounted(folder, options):
    """A file system in memory; skips the test where that may not be."""
    folder.mkdir()
    words = ["mount", "-t", "tmpfs", "-o", options, "none", str(folder)]
    done = subprocess.run(words, capture_output=True, text=True) if shutil.which("mount") else None
    if done is None or done.returncode:
        pytest.skip(f"no file system can be mounted here: {done.stderr.strip() if done else 'no mount'}")
    try:
        yield folder
    finally:
        subprocess.run(["umount", "--lazy", str(folder)], check=True)


@pytest.fixture
def disk(tmp_path):
    """A folder whose disk can be filled and emptied."""
    with contextlib.ExitStack() as stack:
        try:
            found = Small(stack.enter_context(mounted(tmp_path / "disk", "size=512k")))
        except pytest.skip.Exception:
            found = Limited(tmp_path / "disk")
        yield found
        found.empty()


#: Commands that write a file or a folder of this name; MODEL, CLIP and SCRIPT stand for those of `work`.
OUTPUTS = {
    "v.mp4": ["render", "MODEL", "--out"],
    "v.webm": ["render", "MODEL", "--out"],
    "v.gif": ["render", "MODEL", "--out"],
    "v.webp": ["render", "MODEL", "--out"],
    "p.png": ["render", "MODEL", "--times", "0.5", "--out"],
    "frames": ["render", "MODEL", "--out"],
    "e.json": ["evaluate", "MODEL", "CLIP", "--json"],
    "c.fgz": ["compress", "MODEL", "--out"],
    "e.safetensors": ["edit", "MODEL", "SCRIPT", "--out"],
    "m.ply": ["export", "MODEL", "--format", "ply", "--out"],
    "scenes": ["export", "MODEL", "--format", "ply3dgs", "--out"],
    "meshes": ["export", "MODEL", "--format", "obj", "--out"],
    "page.html": ["view", "MODEL", "--out"],
    "m.safetensors": ["fit", "CLIP", *SMALL, "--out"],
    "f.fgz": ["fit", "CLIP", *SMALL, "--out"],
}


def words_of(name, work, folder):
    """The command that writes `name` into `folder`."""
    places = {"MODEL": work / "model.safetensors", "CLIP": work / "clip.mp4", "SCRIPT": work / "move.toml"}
    return [places.get(word, word) for word in OUTPUTS[name]] + [folder / name]


def older(folder, name):
    """An output of before, as the command would overwrite it; returns how to see that it is as it was."""
    path = folder / name
    if path.suffix:
        path.write_bytes(OLDER)
        return lambda: path.read_bytes() == OLDER
    path.mkdir()
    old = path / {"frames": "00000.png", "scenes": "frame_0000.ply", "meshes": "frame_0000.obj"}[name]
    old.write_bytes(OLDER)
    return lambda: old.read_bytes() == OLDER and os.listdir(path) == [old.name]


@pytest.mark.filterwarnings("ignore:model. the file has no shared paths")
def test_a_full_disk_costs_no_older_output_and_leaves_nothing(work, disk, capsys):
    """All commands that write one file or one folder, each with an older one there, which needs --overwrite."""
    for name in OUTPUTS:
        as_it_was = older(disk.folder, name)
        assert run(*words_of(name, work, disk.folder)) in (1, 2), name
        assert "overwrite" in capsys.readouterr().err, name
        disk.fill()
        before = sorted(os.listdir(disk.folder))
        code = run(*words_of(name, work, disk.folder), "--overwrite")
        disk.empty()
        told = capsys.readouterr().err.strip().splitlines()[-1]
        assert code == 1, (name, told)
        assert told.startswith("error: path: expected "), (name, told)
        assert str(disk.folder / name) in told, (name, told)
        assert ".tmp-" not in told, (name, told)
        assert "free space" in told or "disk may be full" in told, (name, told)
        assert as_it_was(), name
        assert sorted({*os.listdir(disk.folder), "ballast"}) == sorted({*before, "ballast"}), name


def filling(monkeypatch, disk, full_at, empty_at=None):
    """Fill the disk before step `full_at` is told, and empty it before `empty_at` is."""
    steps = runner.fit_steps

    def stepping(*arguments, **options):
        for state, info in steps(*arguments, **options):
            if info.step == full_at:
                disk.fill()
            if info.step == empty_at:
                disk.empty()
            yield state, info

    monkeypatch.setattr(runner, "fit_steps", stepping)


def test_a_checkpoint_without_room_is_told_and_the_fit_goes_on(work, disk, monkeypatch, capsys):
    target, kept = disk.folder / "m.safetensors", disk.folder / "m.safetensors.checkpoint"
    monkeypatch.setattr(runner, "CHECKPOINT_SECONDS", 0.0)
    filling(monkeypatch, disk, 6, 9)
    seen, keep = [], runner.Checkpoint.try_save

    def keeping(*arguments):
        keep(*arguments)
        load_model(kept)
        seen.append(read_header(kept)["header"]["counters"]["step"])

    monkeypatch.setattr(runner.Checkpoint, "try_save", keeping)
    assert run("fit", work / "clip.mp4", "--out", target, *SMALL) == 0
    assert seen == [1, 2, 3, 4, 5, 5, 5, 5, *range(9, 31)]  # whole at any time
    told = capsys.readouterr().err
    assert told.count("warning: no checkpoint at step ") == 3
    assert f"expected free space for {str(kept)!r}" in told
    assert load_model(target).num_frames == 6
    assert set(os.listdir(disk.folder)) <= {"m.safetensors", "ballast"}


def test_a_model_without_room_is_written_by_resuming_to_the_bit(work, disk, monkeypatch, capsys):
    target, kept = disk.folder / "m.safetensors", disk.folder / "m.safetensors.checkpoint"
    monkeypatch.setattr(runner, "CHECKPOINT_SECONDS", 0.0)
    filling(monkeypatch, disk, 27)
    assert run("fit", work / "clip.mp4", "--out", target, *SMALL) == 1
    told = capsys.readouterr().err.strip().splitlines()[-1]
    assert told.startswith(f"error: path: expected free space for {str(target)!r}")
    assert f"The fit is kept in {kept}: the same command writes the model." in told
    assert read_header(kept)["header"]["counters"]["step"] == 26
    assert set(os.listdir(disk.folder)) <= {kept.name, "ballast"}
    monkeypatch.undo()
    disk.empty()
    assert run("fit", work / "clip.mp4", "--out", target, *SMALL) == 0
    assert os.listdir(disk.folder) == [target.name]
    assert target.read_bytes() == (work / "model.safetensors").read_bytes()


def test_compiled_code_without_room_is_not_kept_and_that_is_all(tmp_path):
    """What Numba keeps beside the sources, or in the user's folder, may find a full disk, too."""
    source = tmp_path / "doubling.py"
    source.write_text("def doubled(x):\n    return 2 * x\n")
    made = {}
    exec(compile(source.read_text(), str(source), "exec"), made)
    disk = Limited(tmp_path)
    disk.fill()
    try:
        assert _kernels.kernel(made["doubled"])(4.0) == 8.0
    finally:
        disk.empty()
    kept = lambda: [path.suffix for path in (tmp_path / "__pycache__").iterdir()]  # noqa: E731
    assert ".nbc" not in kept()
    assert _kernels.kernel(made["doubled"])(4.0) == 8.0
    assert ".nbc" in kept()


def test_draws_without_room(work, tmp_path, capsys):
    """HDF5 crashes where a disk is full in the midst of its writing, so the room is looked at before."""
    pytest.importorskip("emcee", reason="draws need foldgauss[uncertainty]")
    with mounted(tmp_path / "small", "size=512k") as folder:
        out = folder / "draws"
        assert run("uncertainty", work / "model.safetensors", work / "clip.mp4", "--out", out, "--steps", "100") == 1
        told = capsys.readouterr().err.strip().splitlines()[-1]
        assert told.startswith(f"error: path: expected free space for {str(out / 'chains.h5')!r}, got none")
        assert [path.name for path in folder.rglob("*")] == ["draws"]


# ------------------------------------------------------------------------- places that cannot be written


@pytest.fixture
def before_any_work(monkeypatch):
    """A fit that comes as far as reading its clip fails the test."""
    for name in ("read_clip_or_model", "fit_steps"):
        monkeypatch.setattr(runner, name, lambda *a, name=name, **k: pytest.fail(f"{name} was called"))


@pytest.fixture
def read_only(tmp_path):
    """A folder that cannot be written: root writes whatever the permissions are, but not to what is mounted so."""
    if os.geteuid() == 0:
        with mounted(tmp_path / "shut", "size=64k,ro") as folder:
            yield folder
    else:
        (tmp_path / "shut").mkdir(mode=0o555)
        yield tmp_path / "shut"


def refused(work, target, capsys, *options):
    """What a fit to `target` says on the one line with which it refuses."""
    assert run("fit", work / "clip.mp4", "--out", target, *SMALL, *options) in (1, 2)
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1
    assert lines[0].startswith("error: ")
    return lines[0]


def test_places_that_cannot_be_written_are_found_before_the_fit(work, tmp_path, capsys, before_any_work):
    (tmp_path / "folder.safetensors").mkdir()
    (tmp_path / "file").write_bytes(OLDER)
    (tmp_path / "m.safetensors.checkpoint").mkdir()
    told = {
        tmp_path / "file" / "m.safetensors": "expected a folder, got the file",
        tmp_path / "folder.safetensors": "not a regular file",
        tmp_path / f"{'m' * 250}.safetensors": "File name too long",
        tmp_path / f"{'m' * 240}.safetensors": ".checkpoint' (File name too long)",
        tmp_path / "m.safetensors": "m.safetensors.checkpoint', which is not a regular file",
    }
    for target, what in told.items():
        before = sorted(os.listdir(tmp_path))
        for options in ([], ["--overwrite"]):
            found = refused(work, target, capsys, *options)
            assert what in found
            assert found.startswith("error: path: expected ")
        assert sorted(os.listdir(tmp_path)) == before
    assert (tmp_path / "file").read_bytes() == OLDER


@pytest.mark.skipif(not os.path.isdir("/proc/self"), reason="the folder of processes is Linux's")
def test_a_folder_of_the_system_is_found_before_the_fit(work, capsys, before_any_work):
    assert "expected a writable path" in refused(work, "/proc/self/m.safetensors", capsys)


def test_read_only_for_every_command(work, read_only, capsys, before_any_work):
    for name in OUTPUTS:
        assert run(*words_of(name, work, read_only)) in (1, 2), name
        told = capsys.readouterr().err.strip().splitlines()[-1]
        assert told.startswith("error: "), (name, told)
        assert str(read_only) in told, (name, told)
    assert os.listdir(read_only) == []


# ---------------------------------------------------------------------------------- two fits, one output


def test_one_output_by_any_name_has_one_fit(work, tmp_path, monkeypatch, capsys, before_any_work):
    folder = tmp_path / "models"
    folder.mkdir()
    (tmp_path / "link").symlink_to(folder)
    monkeypatch.chdir(folder)
    names = [folder / "m.safetensors", "m.safetensors", "../models/m.safetensors", tmp_path / "link" / "m.safetensors"]
    for held in names:
        with lock_output(fitting.Path(held)):
            for other in names:
                assert "which another fit is" in refused(work, other, capsys)
    assert os.listdir(folder) == []


@pytest.mark.parametrize(("command", "name"), [("uncertainty", "chains.h5"), ("tradeoff", "tradeoff.json")])
def test_a_folder_of_results_has_one_run(work, tmp_path, capsys, command, name):
    if command == "uncertainty":
        pytest.importorskip("emcee", reason="draws need foldgauss[uncertainty]")
    words = [work / "model.safetensors"] if command == "uncertainty" else []
    with lock_output(tmp_path / name):
        assert run(command, *words, work / "clip.mp4", "--out", tmp_path) == 1
        assert f"{command} is writing. Wait for it" in capsys.readouterr().err
    assert os.listdir(tmp_path) == []


def test_a_link_is_an_output_of_its_own(work, tmp_path):
    """A fit puts its file in the link's place; what the link led to stays, so two fits never write one file."""
    (tmp_path / "other").mkdir()
    real, link = tmp_path / "other" / "m.safetensors", tmp_path / "m.safetensors"
    real.write_bytes(OLDER)
    link.symlink_to(real)
    with lock_output(real):
        assert run("fit", work / "clip.mp4", "--out", link, *SMALL, "--overwrite") == 0
    assert real.read_bytes() == OLDER
    assert not link.is_symlink()
    assert link.read_bytes() == (work / "model.safetensors").read_bytes()


def test_what_a_killed_fit_left_is_gone_after_the_next(work, tmp_path):
    """Its lock, and its unfinished files, however young; files of others stay."""
    target = tmp_path / "m.safetensors"
    left = [".m.safetensors.lock", ".m.safetensors.tmp-01ab23cd.checkpoint", ".m.own-01ab23cd.safetensors"]
    others = [".m.tmp-01ab23cd.safetensors", ".m.own-01ab23cd.checkpoint", ".mm.own-01ab23cd.safetensors"]
    for name in left + others:
        (tmp_path / name).write_bytes(OLDER)
    assert run("fit", work / "clip.mp4", "--out", target, *SMALL) == 0
    assert sorted(os.listdir(tmp_path)) == sorted([target.name, *others])


@pytest.mark.skipif(os.name == "nt", reason="signals are POSIX's; CI runs it on Linux")
@pytest.mark.parametrize("name", [name for name in OUTPUTS if name not in ("v.webm", "v.gif", "v.webp", "m.ply")])
def test_sigterm_leaves_what_was_there_and_nothing_unfinished(work, tmp_path, monkeypatch, name):
    """Sent as the whole of an output is to take its name. A fit leaves its checkpoint, from which it goes on."""
    target, replace, sent = tmp_path / name, os.replace, []
    kept = {"m.safetensors": ["m.safetensors.checkpoint"], "f.fgz": ["f.fgz.checkpoint"]}.get(name, [])

    def replacing(source, to):
        if os.path.dirname(to) == str(tmp_path) and os.path.basename(to) not in kept:
            sent.append(to)
            signal.raise_signal(signal.SIGTERM)
        replace(source, to)

    if "." in name:
        target.write_bytes(OLDER)
    monkeypatch.setattr(os, "replace", replacing)
    assert run(*words_of(name, work, tmp_path), "--overwrite") == 143
    assert len(sent) == 1
    assert sorted(os.listdir(tmp_path)) == sorted([name, *kept] if "." in name else [])
    assert "." not in name or target.read_bytes() == OLDER
    assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL


@pytest.mark.skipif(os.name == "nt", reason="signals are POSIX's; CI runs it on Linux")
@pytest.mark.parametrize("late", [False, True])
def test_a_command_that_does_not_end_is_ended_by_the_next_sigterm(late):
    script = (
        "import signal\n"
        "from foldgauss._runtime import interrupts as _interrupts\n"
        f"_interrupts.REPEAT_SECONDS = {-1.0 if late else 1e9}\n"
        "with _interrupts.raise_on_sigterm():\n"
        "    try:\n"
        "        signal.raise_signal(signal.SIGTERM)\n"
        "    except KeyboardInterrupt:\n"
        "        print('ending', flush=True)\n"
        "        signal.raise_signal(signal.SIGTERM)\n"
        "        print('ended', flush=True)\n"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert done.stderr == ""
    expected = (-signal.SIGTERM, "ending\n") if late else (143, "ending\nended\n")
    assert (done.returncode, done.stdout) == expected


@pytest.mark.skipif(os.name == "nt", reason="signals are POSIX's; CI runs it on Linux")
def test_sigterm_to_a_run_of_draws_keeps_them(work, tmp_path, monkeypatch, capsys):
    pytest.importorskip("emcee", reason="draws need foldgauss[uncertainty]")
    from emcee.backends import HDFBackend

    keep = HDFBackend.save_step

    def kept(self, *step):
        keep(self, *step)
        signal.raise_signal(signal.SIGTERM)

    monkeypatch.setattr(HDFBackend, "save_step", kept)
    words = ["uncertainty", work / "model.safetensors", work / "clip.mp4", "--out", tmp_path, "--steps", "600"]
    assert run(*words) == 143
    assert "Give the same command again to continue" in " ".join(capsys.readouterr().err.split())
    assert sorted(os.listdir(tmp_path)) == ["chains.h5"]


def test_texts_of_a_file_command_no_terminal(work, tmp_path, capsys):
    path = tmp_path / "m.safetensors"
    save_video_model(path, load_video_model(work / "model.safetensors"), metadata={"clip": "a\x1b]0;b\x07c\u202ed"})
    assert run("info", path) == 0
    shown = capsys.readouterr().out
    assert "a\ufffd]0;b\ufffdc\ufffdd" in shown
    assert "\x1b" not in shown


# --------------------------------------------------------------------------------------------- the long runs


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.skipif(not os.path.isdir("/proc/self/fd"), reason="moments of a write are told by Linux's /proc")
@pytest.mark.parametrize("name", _kills.FITS)
def test_25_kills(name, tmp_path):
    """`python -m benchmarks.reliability kills`: it raises where anything is damaged, or a model is another."""
    rows, ended = _kills.run(name, 25, 1, tmp_path)
    assert len(rows) >= 25
    assert ended >= 1
    assert sum(bool(row["in_write"]) for row in rows) >= 2


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.skipif(not os.path.isdir("/proc/self/fd"), reason="moments of a write are told by Linux's /proc")
def test_outputs_killed_while_they_are_written(tmp_path):
    """`python -m benchmarks.reliability outputs` raises where an output is neither the older nor the whole new one."""
    rows = _outputs.run(1, print, tmp_path)
    assert {row["found"] for row in rows} == {"the older one", "the new one", "went on to its end"}


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_a_long_clip(tmp_path):
    """`python -m benchmarks.reliability long`: 2,000 frames of 320x640 within their bounds, told truly."""
    num, size, gaussians = 2000, (320, 640), 80_000
    _long.write_clip(tmp_path / "clip.avi", num, size)
    ran = _long.long_clip(tmp_path / "clip.avi", tmp_path, gaussians, 1000)  # long enough for ten lines
    for command, own in ran.items():
        assert own.peak <= _long.bound(command, num * size[0] * size[1] * 3, gaussians), command
    told = [line["progress"] for line in ran["fit"].lines if line["event"] == "progress"]
    assert told == sorted(told)
    assert told[-1] == 1.0
    assert len(told) >= 10
