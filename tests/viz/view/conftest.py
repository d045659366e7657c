"""Pages that end with the test."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import pytest

from tests.viz.view.fakes import FakePlayer, as_player

if TYPE_CHECKING:
    from gvo.viz.view.page import Page


@pytest.fixture
def player() -> FakePlayer:
    return FakePlayer()


@pytest.fixture
def page(player: FakePlayer) -> Iterator[Page]:
    """The page of a player that computes nothing, on any port."""
    from gvo.viz.view import serve

    with serve(as_player(player), port=0) as opened:
        yield opened
