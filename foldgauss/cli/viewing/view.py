"""The command `view`."""

import webbrowser
from functools import partial
from typing import Annotated

import typer

from foldgauss.cli.app.application import app, err, out, wrong_use
from foldgauss.cli.shared.arguments import ModelFile, Original, OriginalQuality
from foldgauss.cli.shared.clips import read_fitted_clip
from foldgauss.cli.shared.log_lines import show_status
from foldgauss.cli.viewing.page_server import PageServer, make_token, script_path
from foldgauss.io.models.video_model import load_video_model
from foldgauss.io.page.player_page import QUALITY, SaveTarget, html_page, warn_of_size
from foldgauss.video.motion.moving_object import NothingMoves


@app.command(name="view")
def view_command(
    model_path: ModelFile,
    original: Original = None,
    original_quality: OriginalQuality = QUALITY,
    moving: Annotated[
        bool,
        typer.Option("--moving-object", help="Find the object that moves (0.5 s per frame): a button selects it."),
    ] = False,
    port: Annotated[int, typer.Option(help="Serve at this port.", min=0, max=65535, show_default="a free one")] = 0,
    browser: Annotated[bool, typer.Option("--browser/--no-browser", help="Open the browser.")] = True,
) -> None:
    """Play and edit a model in the browser, until Ctrl-C.

    The page is served to this machine only. It saves the edit as MODEL.edit.toml beside the model, and opens what is
    there. To save the page itself: foldgauss export MODEL --format html.
    """
    frames = None
    if original is not None:
        frames = read_fitted_clip(load_video_model(model_path), model_path, original, None, name="--original")
    script, token = script_path(model_path), make_token()
    target = SaveTarget(script.name, token)
    make_page = partial(html_page, model_path, original=frames, quality=original_quality, save_to=target)
    with show_status("Searching for what moves, writing the page" if moving else "Writing the page"):
        try:
            page = make_page(moving=moving)
        except NothingMoves as error:
            err.print(f"The page has no button for the moving object: {error}", soft_wrap=True)
            page = make_page()
    warn_of_size(page, original is not None)
    try:
        server = PageServer(page.encode(), port, script=script, token=token)
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
