"""`view` and `export --format html`: a page on this machine alone, or in a file."""

import http.client
import os
import re
import signal
import subprocess
import sys
import threading
import time
import webbrowser

import numpy as np
import pytest
from commands import run
from tiny_clips import NUM_FRAMES, write_both

from foldgauss.cli.viewing import view as viewing
from foldgauss.io import load_video_model, save_video_model
from foldgauss.video import edit


@pytest.fixture(scope="module")
def work(tmp_path_factory):
    folder = tmp_path_factory.mktemp("view")
    write_both(folder)
    return folder


@pytest.fixture
def served(work, monkeypatch, capsys):
    """Runs `view` up to where it would serve; gives its exit code, server, output and the addresses opened."""

    def view(*arguments):
        servers, opened = [], []

        def serve(server):
            servers.append((server.server_address[0], server.page.decode()))
            raise KeyboardInterrupt

        monkeypatch.setattr(viewing._Server, "serve_forever", serve)
        monkeypatch.setattr(webbrowser, "open", opened.append)
        code = run("view", *arguments)
        return code, servers, capsys.readouterr(), opened

    return view


def test_view_serves_a_page_and_opens_it(served, work):
    code, servers, told, opened = served(work / "model.safetensors")
    assert code == 0
    ((host, page),) = servers
    assert host == "127.0.0.1"
    assert page.startswith("<!doctype html>")
    assert 'id="frame-0"' not in page
    (url,) = opened
    assert url in told.out
    assert told.out.rstrip().endswith("Stopped.")
    code, servers, _, opened = served(work / "model.safetensors", "--no-browser", "--original", work / "clip")
    assert (code, opened) == (0, [])
    assert f'id="frame-{NUM_FRAMES - 1}"' in servers[0][1]


def test_the_server_answers_this_machine_about_its_page_only():
    with viewing._Server(b"the page", 0) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        try:
            port = server.server_address[1]

            def ask(method="GET", path="/", host=f"127.0.0.1:{port}"):
                connection = http.client.HTTPConnection("127.0.0.1", port, timeout=10)
                connection.request(method, path, headers={"Host": host})
                answer = connection.getresponse()
                found = answer.status, answer.read(), answer.getheader("Cache-Control")
                connection.close()
                return found

            assert ask() == (200, b"the page", "no-store")
            assert ask(host=f"localhost:{port}", path="/?again")[0] == 200
            assert ask("HEAD")[:2] == (200, b"")
            assert ask(host="evil.example")[0] == 403
            assert ask(path="/etc/passwd")[0] == 404
            assert ask("POST")[0] == 501
        finally:
            server.shutdown()
            thread.join()


def test_a_port_that_is_taken_is_told(served, work):
    with viewing._Server(b"", 0) as other:
        port = other.server_address[1]
        code, servers, told, _ = served(work / "model.safetensors", "--port", port, "--no-browser")
    assert (code, servers) == (2, [])
    assert "--port: expected a free port" in told.err


@pytest.mark.skipif(os.name == "nt", reason="signals are POSIX's; CI runs it on Linux")
@pytest.mark.parametrize(
    ("number", "code"), [(signal.SIGINT, 0), pytest.param(signal.SIGTERM, 143, marks=pytest.mark.slow)]
)
def test_a_signal_ends_it_well(work, number, code):
    command = [sys.executable, "-m", "foldgauss", "view", str(work / "model.safetensors"), "--no-browser"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        first = process.stdout.readline()
        assert re.search(r" at http://127\.0\.0\.1:\d+/$", first.rstrip()), first
        time.sleep(0.3)
        process.send_signal(number)
        last, told = process.communicate(timeout=60)
    assert (process.returncode, last, told) == (code, "Stopped.\n", "")


def test_export_writes_the_page(work, tmp_path, capsys):
    out = tmp_path / "clip.html"
    assert run("export", work / "model.safetensors", "--format", "html", "--out", out) == 0
    assert "a page of 0." in capsys.readouterr().out
    plain = out.read_text(encoding="utf-8")
    assert run("export", work / "model.safetensors", "--format", "html", "--out", out) == 2
    assert "--overwrite" in capsys.readouterr().err
    original = ["--original", work / "clip", "--original-quality", 10, "--overwrite"]
    assert run("export", work / "model.safetensors", "--format", "html", "--out", out, *original) == 0
    assert out.read_text(encoding="utf-8").count('id="frame-') == plain.count('id="frame-') + NUM_FRAMES


def test_wrong_use_is_told(work, tmp_path, capsys):
    model, out = work / "model.safetensors", tmp_path / "clip.html"
    edited = edit(load_video_model(model)).select(np.arange(40) < 9).move((0.1, 0), times=(0.5, 1)).video()
    late = save_video_model(tmp_path / "late.safetensors", edited)

    def refused(*arguments):
        code = run(*arguments)
        told = capsys.readouterr().err
        assert told.startswith("error: ")
        assert len(told.strip().splitlines()) == 1
        assert not out.exists()
        return code, told

    for arguments, expected, wanted in (
        (["export", model, "--format", "html", "--out", tmp_path / "clip.htm"], 2, "--out: expected a name ending"),
        (["export", model, "--format", "html", "--out", out, "--times", "0.5"], 2, "--times: "),
        (["export", model, "--format", "ply", "--out", tmp_path / "a.ply", "--original", out], 2, "--original: "),
        (["export", late, "--format", "html", "--out", out], 1, "foldgauss render"),
        (["view", late, "--no-browser"], 1, "edits that no folded model represents"),
        (["view", tmp_path / "none.fgz"], 2, "none.fgz"),
        (["view", model, "--original", tmp_path / "none.mp4", "--no-browser"], 2, "none.mp4"),
    ):
        code, told = refused(*arguments)
        assert code == expected, (arguments, told)
        assert wanted in told, told
