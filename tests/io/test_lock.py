"""One writer at a time, whoever dies."""

import os
import shutil
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
from soft_models import soft_model

from foldgauss.io import write_3dgs_frames, write_frames, write_pseudomesh
from foldgauss.io._atomic import STALE_AGE, OutputError, atomic_folder, lock_output

HOLDING = """
import pathlib, sys, time
from foldgauss.io._atomic import lock_output
with lock_output(pathlib.Path(sys.argv[1])):
    print("held", flush=True)
    time.sleep(60)
"""


@pytest.fixture
def holder(tmp_path):
    """Another process that writes m.safetensors."""
    process = subprocess.Popen(
        [sys.executable, "-c", HOLDING, tmp_path / "m.safetensors"], stdout=subprocess.PIPE, text=True
    )
    with process:
        assert process.stdout.readline() == "held\n"
        yield process
        process.kill()


def test_a_second_writer_is_refused_until_the_first_is_gone(tmp_path, holder):
    path = tmp_path / "m.safetensors"
    with pytest.raises(OutputError, match="which another fit is"), lock_output(path):
        pass
    with lock_output(tmp_path / "other.safetensors"):
        pass
    holder.send_signal(signal.SIGKILL)
    holder.wait()
    with lock_output(path):
        pass
    assert os.listdir(tmp_path) == []  # no locks are left lying about


def test_what_a_killed_writer_left_is_removed_and_nothing_else(tmp_path):
    path, kept = tmp_path / "m.safetensors", tmp_path / "m.safetensors.checkpoint"
    mine = tmp_path / ".m.safetensors.tmp-01ab23cd.checkpoint"
    stale, fresh = tmp_path / ".m.tmp-01ab23cd.safetensors", tmp_path / ".m.tmp-11ab23cd.safetensors"
    others = [
        tmp_path / name
        for name in (".m.safetensors.notes.checkpoint", ".n.tmp-01ab23cd.safetensors", ".m.20240131.safetensors")
    ]
    others += [path, kept, fresh]
    for file in (mine, stale, *others):
        file.write_text("x")
    long_ago = time.time() - STALE_AGE - 60
    os.utime(stale, (long_ago, long_ago))
    with lock_output(path, own=(kept,)):
        assert not mine.exists()
        assert not stale.exists()
    assert all(file.exists() for file in others)


def test_a_folder_that_is_not_there(tmp_path):
    with lock_output(tmp_path / "no" / "more" / "m.safetensors"):
        pass
    assert os.listdir(tmp_path / "no") == ["more"]


def test_what_cannot_be_removed_is_no_reason_not_to_work(tmp_path):
    """Another user's file in a folder of all, or a folder of such a name."""
    (tmp_path / ".m.own-01ab23cd.safetensors").mkdir()
    with lock_output(tmp_path / "m.safetensors"):
        pass
    assert os.listdir(tmp_path) == [".m.own-01ab23cd.safetensors"]


def _frames(folder, meanwhile, **options):
    def pictures():
        yield np.zeros((16, 16, 3), np.uint8)
        meanwhile()

    write_frames(folder, pictures(), **options)


def _mesh(folder, meanwhile, **options):
    write_pseudomesh(folder, soft_model(), [0.5], on_frame=meanwhile, **options)


def _scenes(folder, meanwhile, **options):
    write_3dgs_frames(folder, soft_model(), [0.5], on_frame=meanwhile, **options)


WRITERS = {"00000.png": _frames, "frame_0000.obj": _mesh, "frame_0000.ply": _scenes}


@pytest.mark.parametrize("name", WRITERS)
def test_what_is_put_into_a_folder_while_it_is_drawn_stays(tmp_path, name):
    """Of others, with --overwrite too; frames of another run, without."""
    folder, write = tmp_path / "frames", WRITERS[name]

    def put(what):
        folder.mkdir(exist_ok=True)
        (folder / what).write_text("precious")

    for what, options in (("notes.txt", {"overwrite": True}), (name, {})):
        for old in ([], [name]) if options else ([],):
            for each in old:
                put(each)
            with pytest.raises(OutputError, match="Choose another folder"):
                write(folder, lambda what=what: put(what), **options)
            assert sorted(os.listdir(folder)) == sorted([*old, what])
            assert all((folder / each).read_text() == "precious" for each in (*old, what))
            assert os.listdir(tmp_path) == ["frames"]
            shutil.rmtree(folder)
    put(name)
    write(folder, lambda: put(name), overwrite=True)
    assert (folder / name).read_bytes() != b"precious"


@pytest.mark.parametrize("at", [1, 2])
def test_a_folder_is_there_whenever_its_replacement_is_stopped(tmp_path, monkeypatch, at):
    """Ctrl-C as the old folder has been moved aside, and as the new one has taken its place."""
    folder, replace, moves = tmp_path / "frames", os.replace, []
    folder.mkdir()
    (folder / "old").touch()

    def moving(source, target):
        replace(source, target)
        moves.append(source)
        if len(moves) == at:
            raise KeyboardInterrupt

    monkeypatch.setattr(os, "replace", moving)
    with pytest.raises(KeyboardInterrupt), atomic_folder(folder, True, pattern="old") as temporary:
        (temporary / "new").touch()
    assert os.listdir(tmp_path) == ["frames"]
    assert os.listdir(folder) == [["old"], ["new"]][at - 1]
