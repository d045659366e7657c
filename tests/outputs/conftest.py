"""Fixtures of the tests of what is written."""

import pytest

from tests.sources.conftest import Tiny


@pytest.fixture(scope="session")
def tiny() -> Tiny:
    """Return the makers of tiny recordings."""
    return Tiny()
