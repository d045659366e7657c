"""Each recorded bag, good and bad: what is read of it, or why it is refused."""

from collections import Counter
from pathlib import Path
from typing import NamedTuple

import pytest

from gvo.errors import RecordingError
from gvo.io.bag.reader import BagReader

pytestmark = pytest.mark.recorded

_TURTLES = {
    "/rosout": 10,
    "/tf": 2688,
    "/tf_static": 1,
    "/turtle1/cmd_vel": 357,
    "/turtle1/color_sensor": 1351,
    "/turtle1/pose": 1344,
    "/turtle2/cmd_vel": 208,
    "/turtle2/color_sensor": 1344,
    "/turtle2/pose": 1344,
}
_TALKER = {"/parameter_events": 0, "/rosout": 10, "/topic": 10}


class _Held(NamedTuple):
    """What a bag holds: the messages of its topics, or topics and messages where there are many."""

    counts: dict[str, int] | tuple[int, int]
    note: str = ""
    damage: str = ""


_READ = {
    "good/compressed_image.bag": _Held(
        {"/raspicam_node/camera_info": 15, "/raspicam_node/image/compressed": 1}
    ),
    "good/nav2_turtlebot.mcap": _Held(
        {"/amcl_pose": 135, "/odom": 2639, "/tf": 5422, "/tf_static": 1}
    ),
    "good/pose_streams.bag": _Held({"groundtruth": 12765, "ORB-SLAM": 8362, "S-PTAM": 5439}),
    "good/realsense_rgbd.bag": _Held((70, 135)),
    "good/ros2_all_types_mcap": _Held((94, 188)),
    "good/ros2_all_types_sqlite3": _Held((94, 188)),
    "good/tf_bz2.bag": _Held(_TURTLES),
    "good/tf_example.bag": _Held({"/tf": 517, "/tf_static": 1}),
    "good/tf_example_ros2": _Held({"/tf": 517, "/tf_static": 1}),
    "good/tf_lz4.bag": _Held(_TURTLES),
    "good/tf_uncompressed.bag": _Held(_TURTLES),
    # the size of an index record is not that of its entries
    "bad/assertion_in_reader.bag": _Held({"/scan": 360}, note="read without its index"),
    "bad/empty_message_definition.bag": _Held({"/led_array_status": 14}),
    "bad/no-messages.bag": _Held({}),
    "bad/old_type_names.db3": _Held(
        {"/fix": 1, "/image": 1, "/image/compressed": 1, "/imu": 1, "/text": 1}
    ),
    "bad/silent_zero_messages_mcap": _Held(_TALKER),
    "bad/silent_zero_messages_sqlite3": _Held(_TALKER),
    "bad/truncated.bag": _Held({"/rosout_agg": 3}, damage="100 of 5992 bytes (1.7 %)"),
    "bad/truncated.mcap": _Held({"/diagnostics_agg": 4, "/rosout": 10}, damage="bytes"),
    "bad/unindexed.bag": _Held(
        {"/diagnostics_agg": 4, "/rosout_agg": 10}, note="`rosbag reindex` on a copy writes one"
    ),
}
_REFUSED = {
    "bad/damaged.bag": "rosbag reindex",
    "bad/empty-file.bag": "the file is empty",
    "bad/not_a_bag.mcap": "not an MCAP file",
    "bad/version1.bag": "rosbag fix",
}


def test_each_bag_has_a_test(gvo_data: Path) -> None:
    found = {f"{path.parent.name}/{path.name}" for path in (gvo_data / "bags").glob("*/*")}
    assert found == {*_READ, *_REFUSED}


@pytest.mark.parametrize("name", sorted(_READ))
def test_a_bag_is_read_through(gvo_data: Path, name: str) -> None:
    held = _READ[name]
    reader = BagReader(gvo_data / "bags" / name)
    counts = {topic.name: topic.n_messages for topic in reader.topics}
    yielded = Counter(message.topic.name for message in reader.messages(list(counts)))
    assert yielded == Counter(counts)
    expected = held.counts
    assert expected == (
        counts if isinstance(expected, dict) else (len(counts), sum(counts.values()))
    )
    assert any(held.note in note for note in reader.notes) if held.note else reader.notes == []
    assert held.damage in reader.damage if held.damage else reader.damage == ""
    assert not any("\n" in text for text in (*reader.notes, reader.damage))


@pytest.mark.parametrize("name", sorted(_REFUSED))
def test_a_bag_is_refused_in_one_line(gvo_data: Path, name: str) -> None:
    path = gvo_data / "bags" / name
    with pytest.raises(RecordingError) as caught:
        BagReader(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert _REFUSED[name] in str(caught.value)
    assert "\n" not in str(caught.value)
