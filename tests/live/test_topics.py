"""A camera in a network: found as in a bag, tracked as a bag, answered in the network."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import gvo
from gvo.config import Config, Parameters
from gvo.errors import ConfigurationError, RecordingError
from gvo.geometry import se3
from gvo.io.bag.messages import stamp_of, transform_of
from gvo.io.bag.reader import BagMessage, BagReader, serialize, typestore
from gvo.io.bag.topics import IMAGE_TYPE, IMAGE_TYPES
from gvo.io.poses.base_frame import BaseFrame
from gvo.io.recording import ChosenImages, StampedImage
from gvo.live.odometry import LiveOdometry, Stretches
from gvo.live.topics import NetworkReader, TopicSource, wait_for
from gvo.odometry.graph import RunGraph
from gvo.runs.outputs.bag import TOPICS
from gvo.trajectory.formats import read_trajectory
from gvo.types import FloatArray, Optimum, Progress
from tests.conftest import TABLES, assert_same_files
from tests.live.conftest import N_FRAMES
from tests.live.network import NO_REPORT, ODOMETRY, SECOND_NS, Network, Play, recorded, shifted


def pose_of(message: Any) -> FloatArray:
    pose = message.pose.pose
    T = transform_of(pose.position, pose.orientation)
    assert isinstance(T, np.ndarray)
    return T


def half(play: Play) -> int:
    """Return where the second half of the pairs begins."""
    numbers = [n for n, each in enumerate(play.messages) if each.topic.type == IMAGE_TYPE]
    return numbers[N_FRAMES]


@pytest.mark.parametrize("name", ["drive", "room"])
def test_what_is_sent_in_a_network_is_tracked_as_in_a_bag(
    name: str, tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    play = Play(request.getfixturevalue(f"{name}_bag"))
    ((folder, result),) = play.run(tmp_path / "live")
    assert result.is_complete
    run = request.getfixturevalue(f"{name}_run")
    assert_same_files(folder, run, (*TABLES, "global.txt", "graph.g2o"))
    assert {name: type_ for name, (type_, _) in play.network.opened.items()} == TOPICS
    assert play.network.opened["/tf_static"][1]
    stamps = [stamp_of(each.header) for each in play.sent(ODOMETRY)]
    assert len(stamps) == N_FRAMES
    moved = [
        (stamp_of(each.header), each.child_frame_id)
        for message in play.sent("/tf")
        for each in message.transforms
    ]
    camera = play.sent(ODOMETRY)[0].child_frame_id
    assert [stamp for stamp, child in moved if child == camera] == stamps
    assert [stamp for stamp, child in moved if child == "gvo/odom"] == stamps
    assert {each.header.frame_id for each in play.sent("/gvo/points")} == {
        camera.replace("odom", "causal")
    }
    path_poses = play.sent("/gvo/smoothed/path")[-1].poses
    assert [stamp_of(each.header) for each in path_poses] == stamps


def test_without_tf_none_is_sent_and_no_pictures_drawn(drive_bag: Path, tmp_path: Path) -> None:
    play = Play(drive_bag, with_tf=False)
    play.network.unheard = {"/gvo/points", "/gvo/matches/compressed"}
    play.run(tmp_path / "out")
    assert not {"/tf", "/tf_static", *play.network.unheard} & play.network.sent.keys()
    assert len(play.sent(ODOMETRY)) == N_FRAMES


def test_the_frames_are_of_a_robot_that_places_its_camera(drive_bag: Path, tmp_path: Path) -> None:
    base = BaseFrame("base_link", se3.make_transform(np.eye(3), np.array([0.1, 0.0, 0.5])))
    play = Play(drive_bag, base_frame=base)
    play.run(tmp_path / "out")
    pairs = {
        (each.header.frame_id, each.child_frame_id)
        for message in play.sent("/tf")
        for each in message.transforms
    }
    assert {("map", "odom"), ("odom", "base_link"), ("map", "gvo/causal/base_link")} <= pairs
    static = [each.header.frame_id for m in play.sent("/tf_static") for each in m.transforms]
    assert "base_link" not in static
    assert "gvo/causal/base_link" in static
    assert (play.sent(ODOMETRY)[0].header.frame_id, play.sent(ODOMETRY)[0].child_frame_id) == (
        "odom",
        "base_link",
    )


def test_each_drop_is_told_and_the_newest_are_tracked(drive_bag: Path, tmp_path: Path) -> None:
    n_before = N_FRAMES // 2

    def script(play: Play) -> None:
        play.send(0, half(play))
        play.network.wait_for(ODOMETRY, n_before)
        play.send(half(play), len(play.messages))

    play = Play(drive_bag, script, max_waiting=2)
    n_dropped = N_FRAMES - n_before - 2

    def hold(progress: Progress) -> None:
        end_s = time.monotonic() + 60.0
        while progress.n_done == n_before and play.live.n_dropped < n_dropped:  # it is behind
            assert time.monotonic() < end_s
            time.sleep(0.005)

    ((folder, result),) = play.live.run(tmp_path / "out", outputs=NO_REPORT, on_progress=hold)
    left = [each.decode() for each in play.messages if "left/image" in each.topic.name]
    stamps = [stamp_of(each.header) for each in left]
    dropped = stamps[n_before:-2]
    assert play.live.n_dropped == n_dropped
    assert [stamp_of(each.header) for each in play.sent(ODOMETRY)] == [
        stamp for stamp in stamps if stamp not in dropped
    ]
    reason = "dropped, tracking is behind: 2 pairs wait (--queue)"
    told = [
        stamp_of(message.header)
        for message in play.sent("/diagnostics")
        for status in message.status
        if status.message == f"skipped: {reason}"
    ]
    assert told == dropped
    assert (folder / "frames.csv").read_text().count(reason) == n_dropped
    assert result.summary["frames"] == N_FRAMES
    assert result.summary["status_counts"]["skipped"] == n_dropped


def test_another_run_begins_after_a_reset_and_where_the_stamps_go_back(
    drive_bag: Path, tmp_path: Path
) -> None:
    def script(play: Play) -> None:
        play.send(0, half(play))
        play.network.wait_for(ODOMETRY, 4)
        assert play.call("/gvo/reset").success
        play.send(half(play), len(play.messages))
        play.network.wait_for(ODOMETRY, N_FRAMES)
        for message in play.messages:
            play.network.send(shifted(message, -10 * SECOND_NS))

    play = Play(drive_bag, script)
    outputs = gvo.RunOutputs(report=False, bag=tmp_path / "b.mcap")
    runs = play.run(tmp_path / "out", outputs)
    assert [each.folder.name for each in runs] == ["out", "out-2", "out-3"]
    n_frames = [each.result.summary["frames"] for each in runs]
    assert (n_frames[0] + n_frames[1], n_frames[2]) == (N_FRAMES, N_FRAMES)
    assert any("a new run begins" in line and "it was reset" in line for line in play.said)
    assert any("a new run begins" in line and "go back" in line for line in play.said)
    assert (tmp_path / "b.mcap").exists()
    assert (tmp_path / "b-3.mcap").exists()
    np.testing.assert_array_equal(pose_of(play.sent(ODOMETRY)[N_FRAMES]), np.eye(4))


def test_a_run_is_saved_moved_and_changed_while_it_goes_on(drive_bag: Path, tmp_path: Path) -> None:
    T_set = se3.make_transform(np.diag([-1.0, -1.0, 1.0]), np.array([5.0, -2.0, 1.0]))
    saved: list[tuple[int, str]] = []

    def script(play: Play) -> None:
        play.send(0, half(play))
        play.network.wait_for(ODOMETRY, 4)
        answer = play.call("/gvo/save")
        assert answer.success, answer.message
        n_lines = (tmp_path / "out" / "global.txt").read_text().count("\n")
        saved.append((n_lines, (tmp_path / "out" / "summary.json").read_text()))
        set_pose(play, T_set, "elsewhere")
        set_pose(play, T_set, "map")
        assert play.network.parameters is not None
        play.network.parameters.set({"klt.n_corners": 60})
        play.send(half(play), len(play.messages))

    play = Play(drive_bag, script)
    ((folder, result),) = play.run(tmp_path / "out")
    assert result.is_complete
    ((n_saved, summary),) = saved
    assert 4 <= n_saved < N_FRAMES
    assert '"state": "running"' in summary
    assert (folder / "global.txt").read_text().count("\n") == N_FRAMES

    rows = (folder / "frames.csv").read_text().splitlines()[1:]
    counts = [int(row.split(",")[3]) for row in rows]
    assert min(counts[:4]) > 60 >= max(counts[7:])
    assert result.summary["configuration"]["klt"]["n_corners"] == 60

    assert any("not set" in line and "elsewhere" in line for line in play.said)
    odom = np.array([pose_of(each)[:3, 3] for each in play.sent(ODOMETRY)])
    assert np.linalg.norm(np.diff(odom, axis=0), axis=1).max() < 2.0  # it does not jump
    causal = np.array([pose_of(each) for each in play.sent("/gvo/causal/odometry")])
    jumps = np.linalg.norm(np.diff(causal[:, :3, 3], axis=0), axis=1)
    last = int(np.argmax(jumps))
    written = read_trajectory(folder / "causal.txt").T_world_frame
    step = se3.invert(written[last]) @ written[last + 1]
    np.testing.assert_allclose(causal[last + 1], T_set @ step, atol=1e-6)


def test_tracking_goes_on_while_a_run_is_saved(
    drive_bag: Path, drive_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    begun, may_end = threading.Event(), threading.Event()
    optimize = RunGraph.optimize

    def hold(graph: RunGraph) -> Optimum:
        begun.set()
        assert may_end.wait(60)
        return optimize(graph)

    monkeypatch.setattr(RunGraph, "optimize", hold)
    answers: list[Any] = []

    def script(play: Play) -> None:
        play.send(0, half(play))
        play.network.wait_for(ODOMETRY, N_FRAMES // 2)
        saving = threading.Thread(target=lambda: answers.append(play.call("/gvo/save")))
        saving.start()
        assert begun.wait(60)
        play.send(half(play), len(play.messages))
        play.network.wait_for(ODOMETRY, N_FRAMES)
        may_end.set()
        saving.join(60)
        lines = (tmp_path / "out" / "global.txt").read_text().splitlines()
        answers.append(len(lines))

    ((folder, _),) = Play(drive_bag, script).run(tmp_path / "out")
    answer, n_saved = answers
    assert (answer.success, answer.message) == (True, f"{n_saved} frames are written")
    assert n_saved == N_FRAMES // 2
    assert_same_files(folder, drive_run, (*TABLES, "global.txt", "graph.g2o"))


def set_pose(play: Play, T: FloatArray, frame: str) -> None:
    types = typestore(is_ros1=False).types

    def made(name: str, **fields: Any) -> Any:
        return types[name](**fields)

    x, y, z = T[:3, 3].tolist()
    qx, qy, qz, qw = Rotation.from_matrix(T[:3, :3]).as_quat().tolist()
    stamp = made("builtin_interfaces/msg/Time", sec=0, nanosec=0)
    pose = made(
        "geometry_msgs/msg/Pose",
        position=made("geometry_msgs/msg/Point", x=x, y=y, z=z),
        orientation=made("geometry_msgs/msg/Quaternion", x=qx, y=qy, z=qz, w=qw),
    )
    stamped = made(
        "geometry_msgs/msg/PoseWithCovarianceStamped",
        header=made("std_msgs/msg/Header", stamp=stamp, frame_id=frame),
        pose=made("geometry_msgs/msg/PoseWithCovariance", pose=pose, covariance=np.zeros(36)),
    )
    play.call("/gvo/set_pose", pose=stamped)


def test_a_parameter_that_does_not_exist_changes_none() -> None:
    parameters, told = Parameters(Config()), list[Config]()
    parameters.follow(told.append)
    for values in ({"klt.nothing": 1}, {"window": 1}, {"window.size": -1}, {"window.size": "x"}):
        with pytest.raises(ConfigurationError):
            parameters.set({"loops.enabled": False, **values})
    assert parameters.config == Config()
    assert told == []
    assert parameters.set({"loops.enabled": False}).loops.enabled is False
    assert told == [parameters.config]


def test_what_is_missing_is_said_until_it_comes(drive_bag: Path) -> None:
    network, said = Network(), []
    reader, messages = NetworkReader(network), recorded(drive_bag)
    topics = BagReader(drive_bag).topics
    steps: list[Callable[[], object]] = [
        lambda: network.announce([t for t in topics if "left/image" in t.name]),
        lambda: network.announce([t for t in topics if "right/image" in t.name]),
        lambda: network.announce([t for t in topics if "camera_info" in t.name]),
        lambda: [*map(network.send, [m for m in messages if "camera_info" in m.topic.name])],
    ]

    def say(line: str) -> None:
        said.append(line)
        if steps and "image topics: " not in line:
            steps.pop(0)()

    source = wait_for(lambda: TopicSource(reader), say, threading.Event())
    assert source is not None
    assert source.info.frame_id
    text = "\n".join(said)
    for missing in ("no image topics", "one camera alone", "no CameraInfo", "nothing came on"):
        assert missing in text, said


@pytest.mark.parametrize(
    ("name", "data"),
    [
        ("drive", lambda data: data[:100]),
        ("room", lambda data: data[:100]),
        ("drive", lambda _: b""),
        ("room", lambda _: b"\xff" * 99),
    ],
)
def test_a_damaged_message_is_a_faulty_frame_at_its_stamp(
    name: str, data: Callable[[bytes], bytes], tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    def script(play: Play) -> None:
        n_images = 0
        for message in play.messages:
            n_images += message.topic.type in IMAGE_TYPES
            sent = data(message.data) if n_images == 11 else message.data
            late_ns = message.log_time_ns + 3600 * SECOND_NS  # the clock of the computer
            play.network.send(message._replace(data=sent, log_time_ns=late_ns))

    ((folder, result),) = Play(request.getfixturevalue(f"{name}_bag"), script).run(tmp_path / "out")
    assert result.summary["status_counts"]["skipped"] == 1
    stamps = [
        [int(row.split(",")[0]) for row in (run / "frames.csv").read_text().splitlines()[1:]]
        for run in (folder, request.getfixturevalue(f"{name}_run"))
    ]
    np.testing.assert_allclose(np.diff(stamps, axis=0), 0, atol=2)


def image(stamp_ms: int, stream: int = 0) -> StampedImage:
    return StampedImage(stream=stream, stamp_ns=stamp_ms * 10**6, load=lambda: np.eye(2))


def cut(images: list[StampedImage]) -> list[list[int]]:
    """Return the stamps of both streams in ms, one after the other, by stretch."""
    stretches, found = Stretches(iter(images)), []
    while not stretches.is_ended:
        found.append([each.stamp_ns // 10**6 for each in stretches.next_stretch()])
    return found


@pytest.mark.parametrize(
    ("stamps_ms", "stretches"),
    [
        ([], [[]]),
        ([5000, 5100, 4900, 5200], [[5000, 5100, 4900, 5200]]),
        ([5000, 5100, 0, 5200, 5300], [[5000, 5100, 0, 5200, 5300]]),
        ([5000, 5100, -1, 0, 5200], [[5000, 5100, -1, 0, 5200]]),
        ([5000, 5100, 0, 0, 0, 0, 5200], [[5000, 5100, 0, 0, 0, 0, 5200]]),
        ([5000, 6600, 5100, 5200, 5300, 5400], [[5000, 6600, 5100, 5200, 5300, 5400]]),
        ([5000, 5100, 0, 100], [[5000, 5100, 0, 100]]),
        ([5000, 5100, 0, 100, 200], [[5000, 5100], [0, 100, 200]]),
        ([9000, 5000, 5100, 5200, 0, 9, 99], [[9000], [5000, 5100, 5200], [0, 9, 99]]),
    ],
)
def test_a_run_ends_where_three_of_both_streams_go_back(
    stamps_ms: list[int], stretches: list[list[int]]
) -> None:
    found = cut([image(stamp, stream) for stamp in stamps_ms for stream in (0, 1)])
    assert [sorted(each) for each in found] == [sorted(2 * each) for each in stretches]


def test_a_stream_that_comes_late_or_goes_back_alone_ends_no_run() -> None:
    late = [image(stamp, 0) for stamp in range(0, 9000, 100)]
    late += [image(stamp, 1) for stamp in range(0, 9000, 100)]
    assert cut(late) == [[each.stamp_ns // 10**6 for each in late]]
    alone = [
        image(stamp - (stream == 0 and stamp > 5000) * 3000, stream)
        for stamp in range(0, 30_000, 100)
        for stream in (0, 1)
    ]
    (found,) = cut(alone)
    assert sorted(found) == sorted(each.stamp_ns // 10**6 for each in alone)


@pytest.mark.parametrize("stray_ms", [0, -5, 1500, 10**13])
def test_a_pair_with_a_wrong_stamp_is_skipped_and_counted(
    stray_ms: int, drive_bag: Path, tmp_path: Path
) -> None:
    source, network, said = gvo.open_recording(drive_bag), Network(), list[str]()
    images = [*source.images()]
    ns = stray_ms * 10**6 + (images[0].stamp_ns if stray_ms > 0 else 0)
    images[8:10] = [replace(each, stamp_ns=ns) for each in images[8:10]]
    chosen = ChosenImages(info=source.info, images=lambda: iter(images))
    live = LiveOdometry(chosen, sinks=[network], max_waiting=1000, say=said.append)
    outputs = gvo.RunOutputs(report=False, bag=tmp_path / "run.mcap")
    ((_, result),) = live.run(tmp_path / "out", outputs=outputs)
    assert result.summary["frames"] == N_FRAMES
    assert result.summary["status_counts"]["skipped"] == 1
    assert len(result.warnings) == 1, result.warnings
    assert len(network.sent[ODOMETRY]) == N_FRAMES - 1
    assert outputs.bag is not None
    assert outputs.bag.exists()


def test_a_stream_that_comes_late_is_paired_as_in_a_run(
    drive_bag: Path, drive_run: Path, tmp_path: Path
) -> None:
    source = gvo.open_recording(drive_bag)
    images = sorted(source.images(), key=lambda each: each.stream)  # all left ones, then all right
    chosen = ChosenImages(info=source.info, images=lambda: iter(images))
    ((folder, _),) = LiveOdometry(chosen, max_waiting=1000).run(tmp_path / "out", outputs=NO_REPORT)
    assert_same_files(folder, drive_run, (*TABLES, "global.txt", "graph.g2o"))


def test_images_that_nobody_takes_are_given_up_with_a_word(
    drive_bag: Path, caplog: pytest.LogCaptureFixture
) -> None:
    def script(play: Play) -> None:
        for _ in range(20):
            play.send_all()

    play = Play(drive_bag, script)
    play.wait()
    assert len([*play.reader.images()]) == 300
    assert caplog.text.count("images are dropped") == 1
    n_dropped = 20 * 2 * N_FRAMES - 300
    assert f"{n_dropped} images were dropped before they were paired" in caplog.text
    first = next(each for each in play.messages if each.topic.type == IMAGE_TYPE)
    large = BagMessage(first.topic, 0, bytes(60_000_000))
    for _ in range(20):
        play.network.send(large)
    assert len([*play.reader.images()]) == 8  # of 512 MB


def test_a_camera_info_that_changes_is_told_once(
    drive_bag: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    def script(play: Play) -> None:
        infos = [each for each in play.messages if "camera_info" in each.topic.name]
        play.send_all()
        play.network.wait_for(ODOMETRY, N_FRAMES)
        for message in 3 * infos:
            content = message.decode()
            content.k = content.k + np.eye(3).ravel()
            data = serialize(content, message.topic.type, is_ros1=message.topic.is_ros1)
            play.network.send(message._replace(data=data))

    ((_, result),) = Play(drive_bag, script).run(tmp_path / "out")
    assert caplog.text.count("camera_info changes on the way: the first one is used") == 1
    assert result.is_complete
    assert any("CameraInfo changes on the way (" in line for line in result.warnings)


def test_a_run_is_not_complete_if_its_camera_has_vanished_at_its_end(
    drive_bag: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    images = Play(drive_bag).source.images()
    now_s = time.monotonic()
    monkeypatch.setattr(time, "monotonic", lambda: now_s)
    for _ in range(2 * N_FRAMES):
        next(images)
    now_s += 4.0
    with pytest.raises(RecordingError, match=r"/stereo/left.*: no images in the last 4 s"):
        next(images)


def test_a_stream_that_stops_is_told_with_the_rate_of_the_other(
    drive_bag: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    arrivals = Play(drive_bag).live.arrivals
    assert arrivals.state() == ""
    now_s = time.monotonic() + 4.0
    monkeypatch.setattr(time, "monotonic", lambda: now_s)
    assert "no images for 4 s on /stereo/left" in arrivals.state()
    for stamp_ms in (0, 33, 67, 100):
        now_s += 0.033
        list(arrivals.watch([image(stamp_ms)]))
    state = arrivals.state()
    assert "no right image for 4 s on /stereo/right/image_rect; left comes at 30.3 Hz" in state
