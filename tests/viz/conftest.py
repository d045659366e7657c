"""The one browser of all tests of pages."""

from collections.abc import Iterator

import pytest

from tests.viz.browser import Browser, chromium


@pytest.fixture(scope="session")
def chromium_of_all(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    """Return the one browser of all tests of pages."""
    with chromium(tmp_path_factory.mktemp("chromium")) as running:
        yield running


@pytest.fixture
def browser(chromium_of_all: Browser) -> Iterator[Browser]:
    """Return the one browser of all tests of pages; a page left open would go on drawing."""
    yield chromium_of_all
    chromium_of_all.driver.get("about:blank")
