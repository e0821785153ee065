"""The command `view`."""

import secrets
import webbrowser
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from foldgauss._runtime.checks import invalid, require
from foldgauss.cli.app.application import command, err, out
from foldgauss.cli.shared.arguments import Overwrite, refuse_together
from foldgauss.cli.shared.console import show_status
from foldgauss.cli.shared.files import check_output, read_fitted_clip, refuse_existing
from foldgauss.cli.viewing.page_server import PageServer, script_path
from foldgauss.io._atomic import atomic_path, write_or_keep
from foldgauss.io.media.clip import Clip
from foldgauss.io.models.video_model import load_video_model
from foldgauss.io.page.player_page import (
    HTML_SUFFIX,
    QUALITY,
    SaveTarget,
    empty_page,
    html_page,
    linked_file,
    warn_of_size,
    write_html,
)
from foldgauss.video.motion.moving_object import NothingMoves


@command("view")
def view_command(
    model_path: Annotated[
        Path | None,
        typer.Argument(
            metavar="MODEL",
            help="Model file; without one --out writes a page that opens model files.",
        ),
    ] = None,
    out_path: Annotated[
        Path | None,
        typer.Option(
            "--out", metavar="FILE.html", help="Write the page here, to be sent or hosted, and do not serve it."
        ),
    ] = None,
    original: Annotated[
        Path | None,
        typer.Option(
            metavar="CLIP",
            help="The clip that the model was fitted to, to show next to it.",
        ),
    ] = None,
    original_quality: Annotated[
        int, typer.Option(help="WebP quality of the clip's frames in the page.", min=1, max=100)
    ] = QUALITY,
    moving: Annotated[
        bool,
        typer.Option("--moving-object", help="Find the object that moves (0.5 s per frame): a button selects it."),
    ] = False,
    linked: Annotated[
        bool, typer.Option("--linked", help="With --out: the model in a .fgz beside the page, read in parts over HTTP.")
    ] = False,
    port: Annotated[int, typer.Option(help="Serve at this port.", min=0, max=65535, show_default="a free one")] = 0,
    browser: Annotated[bool, typer.Option("--browser/--no-browser", help="Open the browser.")] = True,
    overwrite: Overwrite = False,
) -> None:
    """Play and edit a model in the browser, or write the page that does.

    The page is served to this machine only, until Ctrl-C. It saves the edit as MODEL.edit.toml beside the model, and
    opens what is there. With --out the page is written to a file instead, which makes no requests; see docs/player.md.
    """
    if out_path is None:
        require(model_path is not None, "MODEL", expected="a model file, or --out", got="neither")
        require(not linked, "--linked", expected="--out too", got="--linked alone")
        _serve(model_path, _read_original(model_path, original), original_quality, moving, port, browser)
        return
    require(out_path.suffix.lower() == HTML_SUFFIX, "--out", expected=f"a name ending in {HTML_SUFFIX}", got=out_path)
    refuse_together("--out", {"--moving-object": moving, "--port": port or None})
    check_output(out_path, overwrite, {"model": model_path, "clip": original})
    if model_path is None:
        refuse_together("--out without MODEL", {"--original": original, "--linked": linked})
        with atomic_path(out_path) as temporary:
            temporary.write_text(empty_page(), encoding="utf-8")
        out.print(f"{out_path}: a page that opens model files", soft_wrap=True)
        return
    beside = linked_file(out_path, model_path) if linked else None
    if beside is not None and not (beside.exists() and beside.samefile(model_path)):
        refuse_existing(beside, overwrite)
    options = {"original": _read_original(model_path, original), "quality": original_quality, "linked": linked}
    with show_status("Writing the page"):
        path = write_or_keep(out_path, lambda path: write_html(path, model_path, **options))
    reads = f", which reads {linked_file(path, model_path)}" if linked else ""
    out.print(f"{path}: a page of {path.stat().st_size / 1e6:.1f} MB{reads}", soft_wrap=True)


def _read_original(model_path: Path, original: Path | None) -> Clip | None:
    if original is None:
        return None
    return read_fitted_clip(load_video_model(model_path), model_path, original, None, name="--original")


def _serve(model_path: Path, original: Clip | None, quality: int, moving: bool, port: int, browser: bool) -> None:
    script, token = script_path(model_path), secrets.token_urlsafe(32)
    target = SaveTarget(script.name, token)
    make_page = partial(html_page, model_path, original=original, quality=quality, save_to=target)
    with show_status("Searching for what moves, writing the page" if moving else "Writing the page"):
        try:
            page = make_page(moving=moving)
        except NothingMoves as error:
            err.print(f"The page has no button for the moving object: {error}", soft_wrap=True)
            page = make_page()
    warn_of_size(page)
    try:
        server = PageServer(page.encode(), port, script=script, token=token)
    except OSError as error:
        raise invalid(
            "--port",
            expected="a free port",
            got=f"{port} ({error.strerror})",
            cure="Choose another, or omit the option for a free one.",
        ) from error
    with server:
        out.print(f"{model_path.name}, {len(page) / 1e6:.1f} MB, until Ctrl-C at {server.url}", soft_wrap=True)
        if browser:
            webbrowser.open(server.url)
        try:
            server.serve_forever()
        except KeyboardInterrupt:
            out.print("Stopped.")
