"""The documentation is consistent: every page is in the site, links resolve, public names are documented."""

import importlib
import inspect
import os
import re
import subprocess
import sys
from itertools import pairwise
from pathlib import Path

import pytest
import yaml
from guides import PAGES, ROOT
from markdown_it import MarkdownIt

DOCS = ROOT / "docs"
_NAMES = (
    *("distribution", "mixture", "fold", "envelope", "estimator", "estimator.likelihood"),
    *(f"analysis.{name}" for name in ("moments", "divergence", "interop", "plot")),
    *("render", "video", "io", "io.datasets", "uncertainty", "jobs"),
)
#: Modules that have an API page.
MODULES = ["foldgauss." + name for name in _NAMES]


class _Loader(yaml.SafeLoader):
    """Ignores the Python function that mkdocs.yml names."""


_Loader.add_multi_constructor("tag:yaml.org,2002:python/", lambda loader, suffix, node: None)


def _nav_pages() -> list[str]:
    """All pages in the nav."""

    def pages(entry):
        if isinstance(entry, str):
            return [entry]
        return [page for part in (entry.values() if isinstance(entry, dict) else entry) for page in pages(part)]

    return pages(yaml.load((ROOT / "mkdocs.yml").read_text(), _Loader)["nav"])


def test_every_page_is_in_the_nav_once():
    nav = _nav_pages()
    assert len(set(nav)) == len(nav)
    written = {str(path.relative_to(DOCS)) for path in DOCS.rglob("*.md")}
    notebooks = {f"notebooks/{path.stem}.md" for path in (ROOT / "notebooks").glob("*.ipynb")}
    assert set(nav) == written | notebooks | {"contributing.md", "changelog.md"}


def _targets(page: str):
    """All links and pictures of a page."""
    for token in MarkdownIt().enable("table").parse((ROOT / page).read_text()):
        for child in token.children or ():
            target = child.attrGet("href") or child.attrGet("src")
            if target:
                yield target


def _anchors(path: Path) -> set[str]:
    """Of a page's headings, as GitHub and the site (pymdownx.slugs) make them."""
    tokens = MarkdownIt().enable("table").parse(path.read_text())
    headings = [text for opened, text in pairwise(tokens) if opened.type == "heading_open"]
    plain = ["".join(part.content for part in heading.children) for heading in headings]
    return {re.sub(r"\s", "-", re.sub(r"[^\w\s-]", "", text.strip().lower())) for text in plain}


@pytest.mark.parametrize("page", PAGES)
def test_links_and_images_resolve(page):
    for target in _targets(page):
        if re.match(r"https?:|mailto:", target):
            continue
        name, _, anchor = target.partition("#")
        place = ((ROOT / page).parent / name).resolve() if name else ROOT / page
        assert place.exists(), f"{page}: {target}"
        assert place.is_relative_to(ROOT), f"{page}: {target}"
        if anchor and place.suffix == ".md":
            assert anchor in _anchors(place), f"{page}: {target}"


def _documented() -> set[str]:
    """Names documented by API pages: `::: NAME`."""
    pages = (DOCS / "api").glob("*.md")
    return {name for page in pages for name in re.findall(r"^::: ([\w.]+)", page.read_text(), re.M)}


def test_every_public_module_has_its_page():
    assert set(MODULES) <= _documented()
    for name in MODULES:
        assert (DOCS / "api" / f"{name.rpartition('.')[2]}.md").exists()


def _public(module) -> list[str]:
    """`__all__`, or what a module without one defines."""
    own = [name for name, value in vars(module).items() if getattr(value, "__module__", "") == module.__name__]
    return getattr(module, "__all__", [name for name in own if not name.startswith("_")])


@pytest.mark.parametrize("module", MODULES)
def test_every_public_name_has_a_docstring(module):
    pytest.importorskip("sklearn", reason="foldgauss.estimator needs it")
    loaded = importlib.import_module(module)
    for name in _public(loaded):
        value = getattr(loaded, name)
        if callable(value):
            own = value.__doc__ if not inspect.isclass(value) else vars(value).get("__doc__")
            assert own, f"{module}.{name} has no docstring"
            assert not own.startswith(f"{name}("), f"{module}.{name}: the generated docstring of a dataclass is none"


def test_names_at_the_top_are_in_the_api():
    """Names of `foldgauss` are documented in the modules that define them."""
    import foldgauss

    documented = {getattr(importlib.import_module(module), name, None) for module in MODULES for name in _names(module)}
    for name in foldgauss.__all__:
        value = getattr(foldgauss, name)
        assert isinstance(value, str) or value in documented, name


def _names(module: str) -> list[str]:
    loaded = importlib.import_module(module)
    return [name for name in _public(loaded) if callable(getattr(loaded, name))]


def test_no_external_resources():
    """No script, font or style from elsewhere, in the configuration and in the hooks."""
    for path in (ROOT / "mkdocs.yml", DOCS / "_hooks.py", DOCS / "stylesheets" / "site.css"):
        assert not re.search(r"https?://", path.read_text()), path
    assert "font: false" in (ROOT / "mkdocs.yml").read_text()


@pytest.mark.slow
def test_site_builds_without_a_warning_and_fetches_nothing(tmp_path):
    for module in ("mkdocs", "material", "mkdocstrings", "latex2mathml", "nbconvert"):
        pytest.importorskip(module, reason="the site is made with the extra docs: pip install -e '.[docs]'")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(tmp_path / "site")]
    quiet = os.environ | {"NO_MKDOCS_2_WARNING": "1"}
    done = subprocess.run(command, cwd=ROOT, env=quiet, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-3000:]
    assert "WARNING" not in done.stderr
    pages = list((tmp_path / "site").rglob("*.html"))
    assert len(pages) > len(_nav_pages())  # and a page for what is not found
    for page in pages:
        html = page.read_text()
        fetched = re.findall(r'<(?:script|link|img|iframe)\b[^>]*(?:src|href)="(https?:)?//', html)
        assert not fetched, page
        assert "arithmatex" not in html, f"{page}: a formula was left as TeX"
    api = {page.stem: page.read_text() for page in (tmp_path / "site" / "api").glob("*.html")}
    for module in MODULES:
        html = api[module.rpartition(".")[2]]
        for name in _names(module):
            assert re.search(rf'id="foldgauss\.[\w.]*\b{name}"', html), f"{module}.{name} is not on its page"
