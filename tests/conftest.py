"""Fixtures that several test modules share."""

import os
from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def gvo_data() -> Path:
    """Return the folder of real recordings; skip without it, fail where it is missing."""
    name = os.environ.get("GVO_DATA")
    if not name:
        pytest.skip("GVO_DATA is not set")
    folder = Path(name).resolve()
    if not folder.is_dir():
        pytest.fail(f"GVO_DATA={name} is no folder")
    return folder
