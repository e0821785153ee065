"""The local server of `view`: one page, and the edit script beside the model that the page may save."""

import http.server
import secrets
import threading
from contextlib import suppress
from pathlib import Path

from foldgauss.io._atomic import OutputError, atomic_path
from foldgauss.io.edit_script import MAX_BYTES, EditScriptError, parse_edit_script

HOST = "127.0.0.1"
TOKEN_HEADER = "X-Foldgauss-Token"
#: Path of the script on the server. Names from requests are never used as names of files.
SCRIPT_URL = "/script"


def make_token() -> str:
    """A new random token, 256 bits."""
    return secrets.token_urlsafe(32)


def script_path(model_path: Path) -> Path:
    """The edit script of a model, beside it: clip.edit.toml of clip.safetensors."""
    return model_path.with_name(model_path.stem + ".edit.toml")


class PageServer(http.server.ThreadingHTTPServer):
    """Serves `page` to browsers of this machine; with the token they may write `script`, and nothing else.

    A page of another origin could send requests here from the same browser. It cannot read the token, which is in the
    page alone, nor send the token's header without a preflight request, which is not answered; and requests that name
    another host (DNS rebinding) or another origin are refused.
    """

    daemon_threads = True

    def __init__(self, page: bytes, port: int, *, script: Path | None = None, token: str | None = None):
        self.page, self.script, self.token = page, script, token
        self.known = self.read_script()  # what the page began with or saved: anything else is not replaced
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
        self._answer_page(send=True)

    def do_HEAD(self) -> None:
        self._answer_page(send=False)

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
        body = self.rfile.read(int(length))
        with self.server.saving:
            self._save(body, int(length))

    def _save(self, body: bytes, length: int) -> None:
        script = self.server.script
        if self.server.read_script() != self.server.known:
            text = f"{script.name} was changed by another program. Start foldgauss view again, or move the file away."
            return self._answer(409, text)
        try:
            if len(body) < length:
                raise EditScriptError("script: expected a whole script, got a part.")
            text = body.decode()
            parse_edit_script(text, folder=script.parent)
            with atomic_path(script) as temporary:
                temporary.write_bytes(body)
            self.server.known = body
        except (EditScriptError, UnicodeDecodeError) as error:
            return self._answer(400, str(error))
        except OutputError as error:
            return self._answer(500, str(error))
        self._answer(200, script.name)

    def _is_foreign(self) -> bool:
        origin = self.headers.get("Origin")
        if self.headers.get("Host") not in self.server.own_names:
            return True
        return origin is not None and origin not in self.server.own_origins

    def _answer_page(self, *, send: bool) -> None:
        if self.headers.get("Host") not in self.server.own_names:
            self.send_error(403)
        elif self.path.partition("?")[0] != "/":
            self.send_error(404)
        else:
            self._answer(200, self.server.page, "text/html", send=send)

    def _answer(self, code: int, body: str | bytes, kind: str = "text/plain", *, send: bool = True) -> None:
        data = body.encode() if isinstance(body, str) else body
        self.send_response(code)
        self.send_header("Content-Type", f"{kind}; charset=utf-8")
        self.send_header("Content-Length", str(len(data)))
        self.send_header("Cache-Control", "no-store")
        self.send_header("X-Content-Type-Options", "nosniff")
        self.send_header("Cross-Origin-Resource-Policy", "same-origin")
        self.send_header("X-Frame-Options", "DENY")
        self.end_headers()
        if send:
            with suppress(ConnectionError):  # the tab was closed
                self.wfile.write(data)

    def log_message(self, *message: object) -> None:
        """Do not log to the console."""
