"""What the site needs beyond Markdown: pages that stand elsewhere in the repository; mathematics without scripts."""

import importlib
import re
from pathlib import Path

import latex2mathml.converter
from mkdocs.structure.files import File, Files
from nbconvert import MarkdownExporter
from typer.cli import get_docs_for_click

from foldgauss._runtime.settings import setting_of, walk
from foldgauss.cli.app.application import load_commands

ROOT = Path(__file__).parents[1]
#: Files of the repository that are pages of the site, too.
ROOT_PAGES = {"CONTRIBUTING.md": "contributing.md", "CHANGELOG.md": "changelog.md"}
#: A picture that a notebook shows is named `output_CELL_N.png`: it goes to a folder of the notebook's name.
_IMAGE = re.compile(r"\]\((output_[\w.]+)\)")
#: Where an API page shows the table of a dataclass of settings.
_SETTINGS = re.compile(r"<!-- settings of ([\w.]+)\.(\w+) -->")
#: Where a page lists the options of all commands.
_COMMANDS = "<!-- options of all commands -->"
_MATHS = re.compile(r'<(span|div) class="arithmatex">\\[(\[](.*?)\\[)\]]</\1>', re.S)


def on_files(files: Files, config) -> Files:
    """Adds CONTRIBUTING, CHANGELOG, and the notebooks as they were run."""
    for name, page in ROOT_PAGES.items():
        files.append(File.generated(config, page, content=(ROOT / name).read_text()))
    for path in sorted((ROOT / "notebooks").glob("*.ipynb")):
        text, resources = MarkdownExporter().from_filename(str(path))
        text = _IMAGE.sub(rf"]({path.stem}/\1)", text)
        files.append(File.generated(config, f"notebooks/{path.stem}.md", content=text))
        for name, data in resources["outputs"].items():
            files.append(File.generated(config, f"notebooks/{path.stem}/{name}", content=data))
    return files


def on_page_markdown(markdown: str, page, config, files) -> str:
    """Links to files of the repository become links to their pages, and marks of settings and options lists of them."""
    if _COMMANDS in markdown:
        markdown = markdown.replace(_COMMANDS, _options())
    markdown = _SETTINGS.sub(
        lambda found: _settings_table(getattr(importlib.import_module(found[1]), found[2])), markdown
    )
    up = "../" * page.file.src_uri.count("/")
    markdown = re.sub(r"\]\(\.\./notebooks/(\w+)\.ipynb", rf"]({up}notebooks/\1.md", markdown)
    for name, root_page in ROOT_PAGES.items():
        markdown = markdown.replace(f"](../{name}", f"]({up}{root_page}")
    if page.file.src_uri in ROOT_PAGES.values() or page.file.src_uri.startswith("notebooks/"):
        markdown = re.sub(r"\]\((?:\.\./)?docs/", f"]({up}", markdown)
    return markdown


def on_page_content(html: str, page, config, files) -> str:
    """TeX becomes MathML."""
    return _MATHS.sub(_mathml, html)


def _options() -> str:
    """The arguments and options of every command, by Typer."""
    parts = []
    for name, command in load_commands().items():
        context = command.context_class(command, info_name=f"foldgauss {name}")
        parts.append(get_docs_for_click(obj=command, ctx=context, name=name, indent=1, call_prefix="foldgauss"))
    return "".join(parts)


def _mathml(found: re.Match) -> str:
    kind, tex = found.groups()
    tex = tex.replace("&lt;", "<").replace("&gt;", ">").replace("&amp;", "&")
    display = "block" if kind == "div" else "inline"
    return f'<{kind} class="maths">{latex2mathml.converter.convert(tex.strip(), display=display)}</{kind}>'


def _settings_table(settings: type) -> str:
    """The fields of a settings dataclass as a table in Markdown."""
    rows = ["| field | default | meaning | option |", "|---|---|---|---|"]
    for name, field, value in walk(settings):
        about, is_plain = setting_of(field), isinstance(value, int | float | str | None)
        default = f"`{value!r}`" if is_plain else f"`{type(value).__name__}(...)`"
        default += f": {about.unset}" if about.unset else ""
        option = f"`{about.option}`" if about.option else ""
        rows.append(f"| `{name}` | {default} | {f'{about.help}. {about.details}'.rstrip()} | {option} |")
    return "\n".join(rows)
