"""Trajectory files: round trips, published files, messages for broken ones."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from scipy.spatial.transform import Rotation

from gvo.errors import TrajectoryError
from gvo.geometry import se3
from gvo.trajectory.formats import (
    COVARIANCE_HEADER,
    format_covariance_line,
    format_tum_line,
    read_covariances,
    read_trajectory,
    write_euroc,
    write_kitti,
    write_tum,
)
from gvo.trajectory.trajectory import PoseLayout, Trajectory
from tests.trajectory.paths import random_trajectory, seeds

GOOD = "1.0 0 0 0 0 0 0 1\n"


def write_covariances(path: Path, trajectory: Trajectory) -> None:
    assert trajectory.covariances is not None
    rows = zip(trajectory.stamps_ns.tolist(), trajectory.covariances, strict=True)
    lines = [COVARIANCE_HEADER, *(format_covariance_line(stamp_ns, C) for stamp_ns, C in rows)]
    path.write_text("".join(f"{line}\n" for line in lines))


@given(seeds)
def test_files_give_back_stamps_and_covariances_exactly_and_poses_to_nanometres(
    tmp_path_factory: pytest.TempPathFactory, seed: int
) -> None:
    folder = tmp_path_factory.mktemp("files")
    trajectory = random_trajectory(seed, 8, size_m=500.0)
    for write, stamps_from, expected_ns in (
        (write_tum, "file", trajectory.stamps_ns),
        (write_kitti, "rows", 10**9 * np.arange(8)),
        (write_euroc, "file", trajectory.stamps_ns),
    ):
        write(folder / "00.txt", trajectory)
        back = read_trajectory(folder / "00.txt")
        np.testing.assert_array_equal(back.stamps_ns, expected_ns)
        np.testing.assert_allclose(back.T_world_frame, trajectory.T_world_frame, atol=1e-9)
        assert back.stamps_from == stamps_from
    write_covariances(folder / "covariances.csv", trajectory)
    stamps_ns, covariances = read_covariances(folder / "covariances.csv")
    assert trajectory.covariances is not None
    np.testing.assert_array_equal(stamps_ns, trajectory.stamps_ns)
    np.testing.assert_array_equal(np.triu(covariances), np.triu(trajectory.covariances))
    np.testing.assert_array_equal(covariances, covariances.transpose(0, 2, 1))
    with pytest.raises(TrajectoryError, match="expected the header stamp_ns,rx_rx"):
        read_covariances(folder / "00.txt")


def test_the_covariance_line_holds_the_upper_triangle_row_by_row() -> None:
    covariance = np.arange(36.0).reshape(6, 6)
    names, values = COVARIANCE_HEADER.split(","), format_covariance_line(3, covariance).split(",")
    assert len(names) == len(values) == 22
    named = dict(zip(names, values, strict=True))
    assert (named["stamp_ns"], named["rx_ry"], named["ry_ry"], named["rz_tx"]) == (
        "3", "1.0", "7.0", "15.0",
    )  # fmt: skip


def test_poses_have_the_covariances_of_the_file_beside_them(tmp_path: Path) -> None:
    trajectory = random_trajectory(0, 5)
    write_tum(tmp_path / "smoothed.txt", trajectory)
    assert read_trajectory(tmp_path / "smoothed.txt").covariances is None
    write_covariances(tmp_path / "smoothed_covariance.csv", trajectory)
    read = read_trajectory(tmp_path / "smoothed.txt")
    assert read.covariances is not None
    assert trajectory.covariances is not None
    np.testing.assert_array_equal(np.triu(read.covariances), np.triu(trajectory.covariances))
    lines = (tmp_path / "smoothed_covariance.csv").read_text().splitlines(keepends=True)
    # as of a run that was killed: the last line is cut off, or a line is missing
    for cut in ("".join(lines)[:-9], "".join([*lines[:2], *lines[3:]])):
        (tmp_path / "smoothed_covariance.csv").write_text(cut)
        assert read_trajectory(tmp_path / "smoothed.txt").covariances is None


@given(seeds)
def test_a_line_has_nine_decimals_of_the_stamp_and_no_negative_w(seed: int) -> None:
    T = se3.exp(np.random.default_rng(seed).normal(size=6) * 3)
    fields = format_tum_line(1_403_636_579_763_555_584, T).split()
    assert fields[0] == "1403636579.763555584"
    assert float(fields[7]) >= 0
    R = np.asarray(Rotation.from_quat([float(field) for field in fields[4:]]).as_matrix())
    np.testing.assert_allclose(R, T[:3, :3], atol=1e-11)


@pytest.mark.parametrize(
    ("text", "stamp_ns"),
    [
        ("1311868164.363181", 1_311_868_164_363_181_000),
        ("1403636579.763555584", 1_403_636_579_763_555_584),
        ("1.403636579763555584e+09", 1_403_636_579_763_555_584),
        ("1403636579763555584e-9", 1_403_636_579_763_555_584),
        ("9223372036.854775806", 2**63 - 2),
        ("0", 0),
        ("-0.5", -500_000_000),
        ("0.0000000004", 0),
    ],
)
def test_stamps_are_read_in_decimal_arithmetic(tmp_path: Path, text: str, stamp_ns: int) -> None:
    path = tmp_path / "stamps.txt"
    path.write_text(f"{text} 1 2 3 0 0 0 1\n")
    assert read_trajectory(path).stamps_ns.tolist() == [stamp_ns]


def test_commas_comments_blank_lines_and_a_byte_order_mark_are_read(tmp_path: Path) -> None:
    path = tmp_path / "loose.csv"
    lines = [
        *("\ufeff# stamp tx", "", "1,1,2,3,0,0,0,1", "# more", " 2.5\t1, 2 ,3 0 0 0 -1 # end", ""),
    ]
    path.write_bytes("\r\n".join(lines).encode())
    trajectory = read_trajectory(path)
    assert trajectory.stamps_ns.tolist() == [10**9, 2_500_000_000]
    np.testing.assert_array_equal(trajectory.T_world_frame[1, :3, :3], np.eye(3))


def test_of_repeated_stamps_in_a_tum_file_the_last_row_is_kept(tmp_path: Path) -> None:
    path = tmp_path / "repeated.txt"
    path.write_text("1 0 0 0 0 0 0 1\n2.0 5 0 0 0 0 0 1\n2.00 6 0 0 0 0 0 1\n3 7 0 0 0 0 0 1\n")
    trajectory = read_trajectory(path)
    assert trajectory.positions[:, 0].tolist() == [0.0, 6.0, 7.0]
    assert trajectory.n_repeated == 1


@pytest.mark.parametrize("columns", [8, 17])
def test_a_euroc_file_is_told_by_its_header_or_its_17_columns(tmp_path: Path, columns: int) -> None:
    path = tmp_path / "data.csv"
    header = "#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x []\n"
    quarter_turn_about_z = "0.707107,0,0,0.707107"
    extra = ",9" * (columns - 8)
    path.write_text(
        (header if columns == 8 else "")
        + f"1403636579763555584,1,2,3,{quarter_turn_about_z}{extra}\n"
    )
    trajectory = read_trajectory(path)
    assert trajectory.stamps_ns.tolist() == [1_403_636_579_763_555_584]
    T = trajectory.T_world_frame[0]
    np.testing.assert_allclose(T @ [1, 0, 0, 1], [1, 3, 3, 1], atol=1e-6)


@pytest.mark.parametrize(
    ("name", "layout", "start"),
    [
        ("a.txt", None, "0.100000000 "),
        ("a.csv", None, "#timestamp"),
        ("a.csv", "tum", "0.100000000 "),
        ("a.txt", "kitti", "1.000000000000e+00 "),
    ],
)
def test_a_trajectory_writes_itself(
    tmp_path: Path, name: str, layout: PoseLayout | None, start: str
) -> None:
    T = se3.exp(np.outer(np.arange(4), [0.0, 0.1, 0.0, 1.0, 0.0, 0.2]))
    written = Trajectory(stamps_ns=np.arange(1, 5) * 10**8, T_world_frame=T)
    written.write(tmp_path / name, layout=layout)
    assert (tmp_path / name).read_text().startswith(start)
    found = read_trajectory(tmp_path / name)
    np.testing.assert_allclose(found.T_world_frame, T, atol=1e-9)
    if layout != "kitti":
        np.testing.assert_array_equal(found.stamps_ns, written.stamps_ns)
    with pytest.raises(ValueError, match="layout must be one of"):
        written.write(tmp_path / name, layout="csv")  # type: ignore[arg-type]


@pytest.mark.parametrize("place", ["poses/times.txt", "sequences/00/times.txt"])
def test_kitti_poses_take_stamps_of_a_file_of_as_many_rows(tmp_path: Path, place: str) -> None:
    poses, times = tmp_path / "poses" / "00.txt", tmp_path / place
    poses.parent.mkdir()
    times.parent.mkdir(parents=True, exist_ok=True)
    poses.write_text("1 0 0 0 0 1 0 0 0 0 1 0\n" * 3)
    times.write_text("0.000000e+00\n1.036224e-01\n2.072448e-01\n")
    trajectory = read_trajectory(poses)
    assert trajectory.stamps_ns.tolist() == [0, 103_622_400, 207_244_800]
    assert trajectory.stamps_from == "times"
    times.write_text("0\n1\n")
    assert read_trajectory(poses).stamps_from == "rows"
    times.write_text("0\n2\n1\n")
    with pytest.raises(TrajectoryError, match=r"times\.txt:3: the stamp 1\.0+ is not after 2"):
        read_trajectory(poses)


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("", "holds no poses"),
        (GOOD + "hello world\n", r":2: expected 8 columns, got 2"),
        ("hello world\n", r":1: 2 columns between blanks.*'hello': no form"),
        (GOOD + "2 0 0 x 0 0 0 1\n", r":2: could not convert.*'x'.*expected 8 numbers"),
        (GOOD + "2 0 0 0_100000 0 0 0 1\n", r":2: '0_100000' is no decimal number"),
        (GOOD + "\u0662 0 0 0 0 0 0 1\n", r":2: the stamp '\u0662' is no number"),
        (GOOD + "nan 0 0 0 0 0 0 1\n", r":2: the stamp 'nan' is out of range"),
        (
            "1403636579763555584 0 0 0 0 0 0 1\n",
            r":1: .*'1403636579763555584': this fits TUM in nanosec.* and Eu",
        ),
        (GOOD + "2 0 0 nan 0 0 0 1\n", r":2: a number is not finite"),
        (GOOD + "2 0 0 0 0 0 0 0\n", r":2: the quaternion is not of length one"),
        (GOOD + "\n0.5 0 0 0 0 0 0 1\n", r":3: the stamp 0.50+ is not after 1.0+ of line 1"),
        ("1 0 0 0 0 1 0 0 0 0 1 0\n1 0 0 0 0 1 0 0 0 0 0 0\n", r":2: the first three.*rotation"),
        ("1 0 0 0 0 1 0 0 0 0 -1 0\n", r":1: the first three columns.*rotation"),
        ("1 0 0 0 0 1 0 0 0 0 1 0\n1 0 0\n", r":2: expected 12 columns, got 3"),
    ],
)
def test_a_broken_file_is_refused_with_its_line(tmp_path: Path, text: str, match: str) -> None:
    path = tmp_path / "broken.txt"
    path.write_text(text)
    with pytest.raises(TrajectoryError, match=match) as caught:
        read_trajectory(path)
    message = str(caught.value)
    assert message.startswith(str(path))
    assert "\n" not in message


def test_what_is_no_text_file_is_refused(tmp_path: Path) -> None:
    binary = tmp_path / "binary.bag"
    binary.write_bytes(b"#ROSBAG V2.0\n\xff\xfe\x00")
    for path, match in [
        (binary, "is no text"),
        (tmp_path / "missing.txt", "No such file"),
        (tmp_path, "directory"),
    ]:
        with pytest.raises(TrajectoryError, match=match):
            read_trajectory(path)


@pytest.mark.recorded
@pytest.mark.parametrize(
    ("name", "n", "stamps_from"),
    [
        ("trajectories/KITTI_00_gt.txt", 4541, "rows"),
        ("trajectories/fr2_desk_ORB.txt", 2893, "file"),
        ("rgbd_dataset_freiburg1_xyz_start/groundtruth.txt", 324, "file"),
        ("kitti_06_start/poses.txt", 51, "times"),
        ("euroc_mh01_start/mav0/state_groundtruth_estimate0/data.csv", 510, "file"),
    ],
)
def test_published_files_are_whole(gvo_data: Path, name: str, n: int, stamps_from: str) -> None:
    trajectory = read_trajectory(gvo_data / name)
    assert (len(trajectory), trajectory.stamps_from) == (n, stamps_from)


def test_positions_without_rotations_are_no_file_of_poses(tmp_path: Path) -> None:
    points = Trajectory.of_positions(np.arange(2), np.zeros((2, 3)))
    for write in (write_tum, write_kitti):
        with pytest.raises(ValueError, match="positions without rotations"):
            write(tmp_path / "poses.txt", points)
    assert not (tmp_path / "poses.txt").exists()


def test_growing_files_are_read_as_far_as_they_go_and_sorted(tmp_path: Path) -> None:
    poses, covariances = tmp_path / "poses.txt", tmp_path / "covariances.csv"
    assert len(read_trajectory(poses, is_growing=True)) == 0
    assert [len(part) for part in read_covariances(covariances)] == [0, 0]
    trajectory = random_trajectory(3)
    write_tum(poses, trajectory)
    write_covariances(covariances, trajectory)
    lines = poses.read_text().splitlines(keepends=True)
    poses.write_text("".join([*reversed(lines[:-1]), lines[-1][:-1]]))
    covariances.write_text(covariances.read_text()[:-1])
    expected = trajectory.stamps_ns[:-1].tolist()
    assert read_trajectory(poses, is_growing=True).stamps_ns.tolist() == expected
    stamps_ns, found = read_covariances(covariances)
    assert stamps_ns.tolist() == expected
    assert len(found) == len(expected)
