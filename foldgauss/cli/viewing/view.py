"""The command `view`."""

import webbrowser
from contextlib import suppress
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Annotated

import typer

from foldgauss.cli.app.application import app, err, out, wrong_use
from foldgauss.cli.shared.arguments import ModelFile, Original, OriginalQuality
from foldgauss.cli.shared.clips import read_fitted_clip
from foldgauss.io.models.video_model import load_video_model
from foldgauss.io.page.player_page import QUALITY, html_page, warn_of_size

_HOST = "127.0.0.1"


@app.command(name="view")
def view_command(
    model_path: ModelFile,
    original: Original = None,
    original_quality: OriginalQuality = QUALITY,
    port: Annotated[int, typer.Option(help="Serve at this port.", min=0, max=65535, show_default="a free one")] = 0,
    browser: Annotated[bool, typer.Option("--browser/--no-browser", help="Open the browser.")] = True,
) -> None:
    """Play a model in the browser, until Ctrl-C.

    The page is served to this machine only. To save it: foldgauss export MODEL --format html.
    """
    frames = None
    if original is not None:
        frames = read_fitted_clip(load_video_model(model_path), model_path, original, None)
    with err.status("Writing the page"):
        page = html_page(model_path, original=frames, quality=original_quality)
    warn_of_size(page, original is not None)
    try:
        server = _Server(page.encode(), port)
    except OSError as error:
        cure = "Choose another, or omit the option for a free one."
        raise wrong_use("--port", expected="a free port", got=f"{port} ({error.strerror})", cure=cure) from error
    with server:
        out.print(f"{model_path.name}, {len(page) / 1e6:.1f} MB, until Ctrl-C at {server.url}", soft_wrap=True)
        if browser:
            webbrowser.open(server.url)
        try:
            server.serve_forever()
        except KeyboardInterrupt:
            out.print("Stopped.")


class _Server(ThreadingHTTPServer):
    """Serves one page to browsers of this machine."""

    daemon_threads = True

    def __init__(self, page: bytes, port: int):
        self.page = page
        super().__init__((_HOST, port), _Handler)
        self.url = f"http://{_HOST}:{self.server_address[1]}/"
        names, number = {_HOST, "localhost"}, self.server_address[1]
        self.own_names = {f"{name}:{number}" for name in names} | (names if number == 80 else set())


class _Handler(BaseHTTPRequestHandler):
    """Answers requests for / only, and refuses foreign host names (DNS rebinding)."""

    server: _Server

    def do_GET(self) -> None:
        self._answer(send=True)

    def do_HEAD(self) -> None:
        self._answer(send=False)

    def _answer(self, *, send: bool) -> None:
        if self.headers.get("Host") not in self.server.own_names:
            self.send_error(403)
        elif self.path.partition("?")[0] != "/":
            self.send_error(404)
        else:
            self.send_response(200)
            self.send_header("Content-Type", "text/html; charset=utf-8")
            self.send_header("Content-Length", str(len(self.server.page)))
            self.send_header("Cache-Control", "no-store")
            self.send_header("X-Content-Type-Options", "nosniff")
            self.end_headers()
            if send:
                with suppress(ConnectionError):  # the tab was closed
                    self.wfile.write(self.server.page)

    def log_message(self, *message: object) -> None:
        """Do not log to the console."""
