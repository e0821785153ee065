"""The local server of `view`: one page, and the edit script beside the model that the page may save."""

import http.server
import secrets
import threading
from contextlib import suppress
from pathlib import Path

from foldgauss.io._atomic import OutputError, atomic_path
from foldgauss.io.edit_script import MAX_BYTES, EditScriptError, parse_edit_script
from foldgauss.io.page.player_page import script_version, with_script

HOST = "127.0.0.1"
TOKEN_HEADER = "X-Foldgauss-Token"
#: Path of the script on the server. Names from requests are never used as names of files.
SCRIPT_URL = "/script"


def script_path(model_path: Path) -> Path:
    """The edit script of a model, beside it: clip.edit.toml of clip.safetensors."""
    return model_path.with_name(model_path.stem + ".edit.toml")


class PageServer(http.server.ThreadingHTTPServer):
    """Serves `page` to browsers of this machine; with the token they may write `script`, and nothing else.

    The page comes with the script as it is at that time. To replace it a tab names, in If-Match, the version that it
    began with or last saved: what another tab or program wrote since then is kept.

    A page of another origin could send requests here from the same browser. It cannot read the token, which is in the
    page alone, nor send the token's header without a preflight request, which is not answered; and requests that name
    another host (DNS rebinding) or another origin are refused.
    """

    daemon_threads = True

    def __init__(self, page: bytes, port: int, *, script: Path | None = None, token: str | None = None):
        self.page, self.script, self.token = page, script, token
        self.saving = threading.Lock()
        super().__init__((HOST, port), _Handler)
        number = self.server_address[1]
        self.url = f"http://{HOST}:{number}/"
        names = {HOST, "localhost"}
        self.own_names = {f"{name}:{number}" for name in names} | (names if number == 80 else set())
        self.own_origins = {f"http://{name}" for name in self.own_names}

    def read_script(self) -> bytes | None:
        """The script on the disk, if there is one."""
        return self.script.read_bytes() if self.script is not None and self.script.is_file() else None


class _Handler(http.server.BaseHTTPRequestHandler):
    server: PageServer
    timeout = 30  # seconds that a request may take to arrive

    def do_GET(self) -> None:
        if self.headers.get("Host") not in self.server.own_names:
            self.send_error(403)
        elif self.path.partition("?")[0] != "/":
            self.send_error(404)
        else:
            try:
                page = with_script(self.server.page, self.server.read_script())
            except OSError as error:
                return self._answer(500, f"{self.server.script.name}: expected a script, got {error}.")
            self._answer(200, page, "text/html")

    def do_PUT(self) -> None:
        """Save the edit script."""
        self.close_connection = True  # what is left of a body that was refused is not the next request
        if self._is_foreign():
            return self._answer(403, "Expected a request from the page of foldgauss view, got one of another.")
        if self.path != SCRIPT_URL or self.server.script is None:
            return self._answer(404, "Expected the path of the script.")
        given = self.headers.get(TOKEN_HEADER, "")
        if not (self.server.token and secrets.compare_digest(given.encode(), self.server.token.encode())):
            return self._answer(403, "Expected the token of the page. Reload the page.")
        length = self.headers.get("Content-Length", "")
        if not (length.isascii() and length.isdigit()):
            return self._answer(411, "Expected a length.")
        if len(length) > len(str(MAX_BYTES)) or int(length) > MAX_BYTES:
            return self._answer(413, f"Expected a script of at most {MAX_BYTES:,} bytes, got more.")
        version = self.headers.get("If-Match", "").strip('"')
        if not version:
            return self._answer(428, "Expected the version of the script to replace, If-Match. Reload the page.")
        body = self.rfile.read(int(length))
        try:
            if len(body) < int(length):
                raise EditScriptError("script: expected a whole script, got a part.")
            parse_edit_script(body.decode(), folder=self.server.script.parent)
        except (EditScriptError, UnicodeDecodeError) as error:
            return self._answer(400, str(error))
        with self.server.saving:
            self._save(body, version)

    def _save(self, body: bytes, version: str) -> None:
        script = self.server.script
        try:
            if script_version(self.server.read_script()) != version:
                text = f"{script.name} was changed by another tab or program. Download the script, or reload the page."
                return self._answer(412, text)
            with atomic_path(script) as temporary:
                temporary.write_bytes(body)
        except (OutputError, OSError) as error:
            return self._answer(500, str(error))
        self._answer(200, script.name, version=script_version(body))

    def _is_foreign(self) -> bool:
        origin = self.headers.get("Origin")
        if self.headers.get("Host") not in self.server.own_names:
            return True
        return origin is not None and origin not in self.server.own_origins

    def _answer(self, code: int, body: str | bytes, kind: str = "text/plain", *, version: str = "") -> None:
        data = body.encode() if isinstance(body, str) else body
        self.send_response(code)
        self.send_header("Content-Type", f"{kind}; charset=utf-8")
        self.send_header("Content-Length", str(len(data)))
        self.send_header("Cache-Control", "no-store")
        if version:
            self.send_header("ETag", f'"{version}"')
        self.send_header("X-Content-Type-Options", "nosniff")
        self.send_header("Cross-Origin-Resource-Policy", "same-origin")
        self.send_header("X-Frame-Options", "DENY")
        self.end_headers()
        with suppress(ConnectionError):  # the tab was closed
            self.wfile.write(data)

    def log_message(self, *message: object) -> None:
        """Do not log to the console."""
