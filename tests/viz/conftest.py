"""The one browser of all tests of pages."""

from collections.abc import Iterator

import pytest

from tests.viz.browser import Browser, chromium


@pytest.fixture(scope="session")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    """Return the one browser of all tests of pages."""
    with chromium(tmp_path_factory.mktemp("chromium")) as running:
        yield running
