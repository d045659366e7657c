"""What tests of running cameras share."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.conftest import complete_run, write_drive, write_room
from tests.live.ros1 import Ros, master

N_FRAMES = 12


@pytest.fixture(scope="session")
def drive_bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a bag of a drive of 12 frames, a small stereo camera."""
    path = tmp_path_factory.mktemp("bags") / "drive.mcap"
    return write_drive(path, n_frames=N_FRAMES, scale=0.4)


@pytest.fixture(scope="session")
def room_bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a bag of ROS 1 of 12 frames in a room, a small RGB-D camera."""
    path = tmp_path_factory.mktemp("bags") / "room.bag"
    return write_room(path, n_frames=N_FRAMES, scale=0.4)


@pytest.fixture(scope="session")
def drive_run(drive_bag: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the run over `drive_bag`."""
    return complete_run(drive_bag, tmp_path_factory.mktemp("drive_run"))


@pytest.fixture(scope="session")
def room_run(room_bag: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the run over `room_bag`."""
    return complete_run(room_bag, tmp_path_factory.mktemp("room_run"))


@pytest.fixture(scope="module")
def ros(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Ros]:
    """Return a master of ROS 1; its nodes use a simulated clock."""
    with master(tmp_path_factory.mktemp("ros")) as running:
        running.use_simulated_clock()
        yield running
