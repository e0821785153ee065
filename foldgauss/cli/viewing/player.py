"""The command `player`."""

from pathlib import Path
from typing import Annotated

import typer

from foldgauss.cli.app.application import app, out, wrong_use
from foldgauss.cli.shared.arguments import Overwrite
from foldgauss.cli.shared.outputs import refuse_existing
from foldgauss.io._atomic import atomic_path
from foldgauss.io.page.player_page import empty_page


@app.command(name="player")
def player_command(
    out_path: Annotated[Path, typer.Option("--out", help="Folder for the page, index.html; it is made if missing.")],
    overwrite: Overwrite = False,
) -> None:
    """Write the player without a model, as a static site: one page that opens model files.

    Files are dropped on the page or chosen. They stay on the computer: the page makes no requests.
    """
    page = out_path / "index.html"
    refuse_existing(page, overwrite)
    try:
        out_path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise wrong_use("--out", expected="a folder", got=f"{out_path} ({error.strerror})") from error
    with atomic_path(page) as temporary:
        temporary.write_text(empty_page(), encoding="utf-8")
    out.print(f"Wrote {page}: open it in a browser, or host the folder anywhere.", soft_wrap=True)
