"""A browser, and a page in it, for the player's tests of a module."""

import pytest
from browser import Pages, chromium
from editor_page import save_soft_model


@pytest.fixture(scope="module")
def browser():
    with chromium() as found:
        yield found


@pytest.fixture(scope="module")
def pages(browser, tmp_path_factory):
    return Pages(browser, tmp_path_factory.mktemp("pages"))


@pytest.fixture
def opened(pages):
    """Opens models, see `Pages.open`; at the end the page has said nothing, and asked for nothing."""
    yield pages.open
    pages.shared.check()


@pytest.fixture(scope="session")
def compact(tmp_path_factory):
    """A model as a compact file."""
    return save_soft_model(tmp_path_factory.mktemp("compact"))
