"""`view`: a page on this machine alone, or in a file."""

import base64
import http.client
import json
import os
import re
import secrets
import shutil
import signal
import subprocess
import sys
import time
import webbrowser
from contextlib import contextmanager

import numpy as np
import pytest
from commands import call, run, running
from tiny_clips import NUM_FRAMES, write_both

from foldgauss.cli.viewing import page_server
from foldgauss.io import html_page, load_video_model
from foldgauss.io.page.player_page import script_version, with_script
from foldgauss.video.motion.moving_object import nothing_moves
from foldgauss.video.selection import selectors


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
            servers.append((server.server_address[0], with_script(server.page, server.read_script()).decode()))
            raise KeyboardInterrupt

        monkeypatch.setattr(page_server.PageServer, "serve_forever", serve)
        monkeypatch.setattr(webbrowser, "open", opened.append)
        code = run("view", *arguments)
        return code, servers, capsys.readouterr(), opened

    return view


def test_view_finds_what_moves(served, work, monkeypatch):
    def search(frames):
        raise nothing_moves("an object", "none")

    monkeypatch.setattr(selectors, "find_moving_object", search)
    told, pages = served(work / "model.safetensors", "--moving-object")[2:0:-1]
    assert "The page has no button for the moving object: moving: expected" in " ".join(told.err.split())
    assert 'id="objects">{}<' in pages[0][1]
    masks = np.ones((NUM_FRAMES, *load_video_model(work / "model.safetensors").size), bool)
    monkeypatch.setattr(selectors, "find_moving_object", lambda frames: masks)
    code, ((_, page),), told, _ = served(work / "model.safetensors", "--moving-object")
    assert (code, told.err) == (0, "")
    assert re.search(r'id="objects">{"the moving object": {"0": "0-\d+', page)


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


@contextmanager
def serving(**how):
    """A server in a thread, and a function that sends it a request and gives status, body and headers of its answer."""
    with running(page_server.PageServer(b"the page", 0, **how)) as server:

        def ask(method="GET", path="/", body=None, **headers):
            connection = http.client.HTTPConnection("127.0.0.1", server.server_address[1], timeout=10)
            named = {name.replace("_", "-"): value for name, value in headers.items() if value is not None}
            connection.request(method, path, body, {"Host": f"127.0.0.1:{server.server_address[1]}"} | named)
            answer = connection.getresponse()
            found = answer.status, answer.read(), answer.headers
            connection.close()
            return found

        yield server, ask


def test_the_server_answers_this_machine_about_its_page_only():
    with serving() as (server, ask):
        status, page, headers = ask()
        assert (status, page, headers["Cache-Control"]) == (200, b"the page", "no-store")
        for status, request in (
            (200, {"Host": f"localhost:{server.server_address[1]}", "path": "/?again"}),
            (403, {"Host": "evil.example"}),
            (404, {"path": "/etc/passwd"}),
            (501, {"method": "POST"}),
            (501, {"method": "OPTIONS", "path": "/script"}),  # no other origin may send the token's header
            (404, {"method": "PUT", "path": "/script", "body": "x", "X_Foldgauss_Token": ""}),  # it saves nothing
        ):
            assert ask(**request)[0] == status, request


SCRIPT = '[selections.it]\nindices = "0-3"\n\n[[edits]]\nselect = "it"\ndo = "vanish"\n'


def test_the_server_saves_the_script_of_its_page(tmp_path):
    script, token = tmp_path / "clip.edit.toml", secrets.token_urlsafe(32)
    with serving(script=script, token=token) as (_, ask):
        version = '"none"'
        for text in (SCRIPT, SCRIPT.replace("0-3", "5")):
            status, told, headers = ask("PUT", "/script", text, X_Foldgauss_Token=token, If_Match=version)
            assert (status, told, script.read_text()) == (200, b"clip.edit.toml", text)
            assert headers["ETag"] == f'"{script_version(text.encode())}"'
            before, version = version, headers["ETag"]
        for stale in (before, '"none"', "*", None):  # another tab's
            status, told, _ = ask("PUT", "/script", SCRIPT, X_Foldgauss_Token=token, If_Match=stale)
            assert (status, script.read_text()) == (428 if stale is None else 412, text)
        script.write_text("# by hand")
        status, told, _ = ask("PUT", "/script", SCRIPT, X_Foldgauss_Token=token, If_Match=version)
        assert (status, script.read_text()) == (412, "# by hand")
        assert b"changed by another tab or program" in told
    assert [path.name for path in tmp_path.iterdir()] == ["clip.edit.toml"]


def test_requests_that_are_not_the_pages_save_nothing(tmp_path, monkeypatch):
    folder = tmp_path / "models"
    folder.mkdir()
    script, token = folder / "clip.edit.toml", secrets.token_urlsafe(32)
    monkeypatch.setattr(page_server, "MAX_BYTES", 1000)
    with serving(script=script, token=token) as (server, ask):
        port, good = server.server_address[1], {"X_Foldgauss_Token": token, "If_Match": '"none"'}
        for status, request in (
            (403, {}),
            (403, {"X_Foldgauss_Token": ""}),
            (403, {"X_Foldgauss_Token": token[:-1]}),
            (403, {"X_Foldgauss_Token": "\xe9" * 43}),
            (403, {"X_Foldgauss_Token": secrets.token_urlsafe(32)}),
            (403, good | {"Host": "evil.example"}),
            (403, good | {"Host": f"evil.example:{port}"}),
            (403, good | {"Host": f"127.0.0.1:{port + 1}"}),
            (403, good | {"Origin": "http://evil.example"}),
            (403, good | {"Origin": "null"}),
            (403, good | {"Origin": f"http://127.0.0.1:{port + 1}"}),
            (404, good | {"path": "/"}),
            (404, good | {"path": "/../secret.toml"}),
            (404, good | {"path": "/script/../../secret.toml"}),
            (404, good | {"path": "/script?name=../secret.toml"}),
            (404, good | {"path": "/%2e%2e/secret.toml"}),
            (413, good | {"body": "#" * 1001}),
            (413, good | {"Content_Length": "9" * 5000}),
            (411, good | {"Content_Length": "-1"}),
            (411, good | {"Content_Length": "1e3"}),
            (400, good | {"body": "not TOML"}),
            (400, good | {"body": b"\xff\xfe"}),
            (400, good | {"body": "[[edits]]\ndo = 'sing'"}),
            (400, good | {"body": SCRIPT.replace("0-3", "9" * 900)}),
            (400, good | {"body": SCRIPT.replace("0-3", "3-0")}),
            (400, good | {"body": SCRIPT.replace("0-3", "0-3,all")}),
        ):
            told = ask("PUT", **{"path": "/script", "body": SCRIPT} | request)
            assert told[0] == status, (request, told)
            assert token.encode() not in told[1]
        assert ask("PUT", "/script", SCRIPT, Origin=f"http://localhost:{port}", **good)[0] == 200  # the page's own
    assert sorted(str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*")) == [
        "models",
        "models/clip.edit.toml",
    ]


def test_view_saves_beside_the_model(served, work, tmp_path):
    model = shutil.copy(work / "model.safetensors", tmp_path / "my clip.safetensors")
    _, ((_, page),), _, _ = served(model, "--no-browser")
    (about,) = re.findall(r'id="server">(.*?)</script>', page)
    assert json.loads(about)["script"] == "my clip.edit.toml"
    assert len(json.loads(about)["token"]) >= 43
    assert "connect-src 'self'" in page
    assert 'id="script"' not in page
    (tmp_path / "my clip.edit.toml").write_text(SCRIPT)
    _, ((_, again),), _, _ = served(model, "--no-browser")
    version = script_version(SCRIPT.encode())
    assert f'id="script" data-version="{version}">{base64.b64encode(SCRIPT.encode()).decode()}<' in again
    assert "connect-src" not in html_page(model)


def test_without_a_model_the_page_opens_files(tmp_path):
    out = tmp_path / "site" / "index.html"
    assert run("view", "--out", out) == 0
    page = out.read_text(encoding="utf-8")
    assert "default-src 'none'" in page
    assert 'id="model"' not in page
    assert "connect-src" not in page
    call("view", "--out", out, code=2, err="--overwrite")
    assert run("view", "--out", out, "--overwrite") == 0


def test_a_port_that_is_taken_is_told(served, work):
    with page_server.PageServer(b"", 0) as other:
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


def test_the_page_is_written(work, tmp_path):
    out = tmp_path / "clip.html"
    call("view", work / "model.safetensors", "--out", out, out="a page of 0.")
    plain = out.read_text(encoding="utf-8")
    call("view", work / "model.safetensors", "--out", out, code=2, err="--overwrite")
    original = ["--original", work / "clip", "--original-quality", 10, "--overwrite"]
    assert run("view", work / "model.safetensors", "--out", out, *original) == 0
    assert out.read_text(encoding="utf-8").count('id="frame-') == plain.count('id="frame-') + NUM_FRAMES
