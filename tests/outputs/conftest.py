"""Fixtures of the tests of what is written."""

import pytest

from tests.io.conftest import Tiny


@pytest.fixture(scope="session")
def tiny() -> Tiny:
    """Return the makers of tiny recordings."""
    return Tiny()
