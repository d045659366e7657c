"""What tests of running cameras share."""

from collections.abc import Iterator

import pytest

from tests.live.ros1 import Ros, master


@pytest.fixture(scope="module")
def ros(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Ros]:
    """Return a master of ROS 1; its nodes use a simulated clock."""
    with master(tmp_path_factory.mktemp("ros")) as running:
        running.use_simulated_clock()
        yield running
