"""Servers of the page that end with the test."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from gvo.viz.view.server import ViewServer


@pytest.fixture
def view() -> Iterator[ViewServer]:
    """A page without content, on any port."""
    from gvo.viz.view.server import open_server

    with open_server("127.0.0.1", 0, title="gvo") as opened:
        yield opened
