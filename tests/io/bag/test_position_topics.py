"""Fixes and points of bags."""

from pathlib import Path

import numpy as np
import pytest

from gvo.errors import RecordingError
from gvo.io.bag.poses import Positions, read_positions
from gvo.io.bag.reader import BagReader
from gvo.io.edges.events import InputFaults
from tests.io.pose_bags import PoseBag

NAN, INF = float("nan"), float("inf")
HELSINKI = (60.0, 25.0, 30.0)
# of latitude there: one over the meridian's radius of curvature, a (1 - e^2) / (1 - 3/4 e^2)^1.5
METRE_DEG = np.degrees(1.0 / 6383453.857)


def read(path: Path) -> tuple[Positions, InputFaults]:
    faults = InputFaults()
    reader = BagReader(path)
    return read_positions(reader, reader.topics[0], faults), faults


@pytest.mark.parametrize("name", ["a.bag", "a.mcap"])
def test_fixes_are_east_north_and_up_of_the_first_one(tmp_path: Path, name: str) -> None:
    bag = PoseBag(tmp_path / name)
    for n in (0, 2, 1):
        place = (60.0 + n * METRE_DEG, 25.0, 30.0 + 2.0 * n)
        bag.fix(n * 10**9 + 7, place, frame="/gps_link")
    found, faults = read(bag.write())
    assert found.stamps_ns.tolist() == [7, 10**9 + 7, 2 * 10**9 + 7]
    np.testing.assert_allclose(found.positions, [[0, n, 2 * n] for n in range(3)], atol=1e-3)
    assert (found.child_frame, found.parent_frame) == ("gps_link", "")
    assert found.origin == "east, north, up of 60.0000000 deg, 25.0000000 deg, 30.00 m"
    assert not faults


def test_what_is_no_fix_is_skipped_and_counted_and_is_no_origin(tmp_path: Path) -> None:
    bag = PoseBag(tmp_path / "a.mcap")
    bag.fix(0, [1.0, 2.0, 3.0], status=-1)
    for n, spoilt in enumerate([(NAN, 25, 0), (60, INF, 0), (60, 25, NAN), (91, 25, 0)], start=1):
        bag.fix(n, spoilt)
    bag.fix(5, HELSINKI, status=2)
    found, faults = read(bag.write())
    assert found.stamps_ns.tolist() == [5]
    np.testing.assert_array_equal(found.positions, [[0.0, 0.0, 0.0]])
    (warning,) = faults.warnings()
    assert warning.startswith("5 messages hold no position and were skipped; the first: /fix at 0")
    assert "status -1" in warning


def test_a_topic_without_any_fix_is_refused(tmp_path: Path) -> None:
    bag = PoseBag(tmp_path / "a.bag")
    bag.fix(0, HELSINKI, status=-1)
    with pytest.raises(RecordingError, match="/fix: holds no position: 1 messages"):
        read(bag.write())


def test_points_are_positions_in_their_frame(tmp_path: Path) -> None:
    bag = PoseBag(tmp_path / "a.bag")
    bag.point("/leica/position", 1, (1.0, 2.0, 3.0), frame="room")
    bag.point("/leica/position", 2, (NAN, 2.0, 3.0), frame="room")
    found, faults = read(bag.write())
    np.testing.assert_array_equal(found.positions, [[1.0, 2.0, 3.0]])
    assert (found.child_frame, found.parent_frame, found.origin) == ("", "room", "")
    assert len(faults.warnings()) == 1
