"""Forms of pose files: each system's is read, a header decides, what is in doubt is refused."""

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gvo.errors import TrajectoryError
from gvo.trajectory.formats import read_trajectory
from tests.trajectory.paths import random_trajectory

DOCS = Path(__file__).parents[2] / "docs" / "frames.md"

TRUTH = random_trajectory(5, 12)
STAMPS_NS = 1_403_636_584_713_560_000 + 50_000_000 * np.arange(len(TRUTH))
QUATERNIONS = Rotation.from_matrix(TRUTH.T_world_frame[:, :3, :3]).as_quat()

Row = Callable[[int], str]


def numbers(values: object, separator: str = " ") -> str:
    return separator.join(f"{value:.12f}" for value in np.ravel(np.asarray(values)))


def seconds(k: int) -> str:
    return f"{STAMPS_NS[k] // 10**9}.{STAMPS_NS[k] % 10**9:09d}"


def stamp(k: int, exponent: int) -> str:
    """Return the stamp in units of ten to this exponent, nanoseconds."""
    whole, rest = divmod(int(STAMPS_NS[k]), 10**exponent)
    return f"{whole}.{rest:0{exponent}d}" if exponent else str(whole)


def position(k: int, separator: str = " ") -> str:
    return numbers(TRUTH.positions[k], separator)


def xyzw(k: int, separator: str = " ") -> str:
    return numbers(QUATERNIONS[k], separator)


def wxyz(k: int, separator: str = " ") -> str:
    return numbers(np.roll(QUATERNIONS[k], 1), separator)


def rows_of_matrix(k: int, separator: str = " ") -> str:
    return numbers(TRUTH.T_world_frame[k, :3], separator)


def angles(k: int) -> str:
    yaw, pitch, roll = Rotation.from_quat(QUATERNIONS[k]).as_euler("ZYX")
    return numbers([roll, pitch, yaw], ",")


def state(n: int, separator: str = " ") -> str:
    return separator.join(["0.125"] * n)


# system -> its header and its rows, as its program or its data set writes them
TUM_HEADER = "# timestamp tx ty tz qx qy qz qw\n"
STATE = "# timestamp(s) q p v bg ba cam_imu_dt num_cam cam0_k cam0_d cam0_rot cam0_trans .... etc\n"
POSES = f"{TUM_HEADER.strip()} Pr11 Pr12 Pr13 Pr22 Pr23 Pr33 Pt11 Pt12 Pt13 Pt22 Pt23 Pt33\n"
OKVIS = ", ".join(
    ["timestamp", *(f"p_WS_W_{a}" for a in "xyz"), *(f"q_WS_{a}" for a in "xyzw")]
    + [f"{name}_{a}" for name in ("v_WS_W", "b_g", "b_a") for a in "xyz"]
)
EUROC = (
    "#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], "
    "q_RS_z [], v_RS_R_x [m s^-1], v_RS_R_y [m s^-1], v_RS_R_z [m s^-1], b_w_RS_S_x [rad s^-1], "
    "b_w_RS_S_y [rad s^-1], b_w_RS_S_z [rad s^-1], b_a_RS_S_x [m s^-2], b_a_RS_S_y [m s^-2], "
    "b_a_RS_S_z [m s^-2]\n"
)
UNKNOWN = "".join(f"{STAMPS_NS[0] // 1000 - 10_000 * k}{', NaN' * 6}\n" for k in range(150, 0, -1))
SYSTEMS: dict[str, list[tuple[str, Row]]] = {
    "TUM": [
        (TUM_HEADER, lambda k: f"{seconds(k)[:-4]} {position(k)} {xyzw(k)}"),
        ("", lambda k: f"{seconds(k)};{position(k, ';')};{xyzw(k, ';')}"),
    ],
    "ORB-SLAM3": [
        ("", lambda k: f"{seconds(k)[:-3]} {position(k)} {xyzw(k)}"),
        ("", lambda k: f"{STAMPS_NS[k]}.000000 {position(k)} {xyzw(k)}"),
    ],
    "EuRoC": [
        (EUROC, lambda k: f"{STAMPS_NS[k]},{position(k, ',')},{wxyz(k, ',')},{state(9, ',')}"),
        ("", lambda k: f"{STAMPS_NS[k]},{position(k, ',')},{wxyz(k, ',')},{state(9, ',')}"),
        (
            EUROC,
            lambda k: f"{STAMPS_NS[k]}, {position(k, ', ')}, {wxyz(k, ', ')}, {state(9, ', ')}",
        ),
    ],
    "VINS": [
        ("", lambda k: f"{STAMPS_NS[k]},{position(k, ',')},{wxyz(k, ',')},{state(3, ',')},"),
        ("", lambda k: f"{STAMPS_NS[k]},{position(k, ',')},{wxyz(k, ',')},"),
    ],
    "OKVIS": [
        (
            f"{OKVIS}\n",
            lambda k: f"{STAMPS_NS[k]}, {position(k, ', ')}, {xyzw(k, ', ')}, {state(9, ', ')}",
        ),
    ],
    "OpenVINS": [
        (STATE, lambda k: f"{seconds(k)[:-4]} {xyzw(k)} {position(k)} {state(10)} 1 {state(15)}"),
        ("", lambda k: f"{seconds(k)[:-4]} {xyzw(k)} {position(k)} {state(9)}"),
        (POSES, lambda k: f"{seconds(k)[:-4]} {position(k)} {xyzw(k)} {state(12)}"),
        ("", lambda k: f"{seconds(k)[:-4]} {position(k)} {xyzw(k)} {state(12)}"),
        (POSES, lambda k: f"{seconds(k)[:-4]} {position(k)} {xyzw(k)}"),
    ],
    "RTAB-Map": [
        (
            "#timestamp x y z qx qy qz qw id\n",
            lambda k: f"{seconds(k)[:-3]} {position(k)} {xyzw(k)} {k + 1}",
        ),
        (
            "#timestamp x y z qx qy qz qw\n",
            lambda k: f"{seconds(k)[:-3]} {position(k)} {xyzw(k)}",
        ),
    ],
    "KAIST": [("", lambda k: f"{STAMPS_NS[k]},{rows_of_matrix(k, ',')}")],
    "NCLT": [
        ("", lambda k: f"{STAMPS_NS[k] // 1000},{position(k, ',')},{angles(k)}"),
        (UNKNOWN, lambda k: f"{STAMPS_NS[k] // 1000}, {position(k, ', ')}, {angles(k)}"),
    ],
    "KITTI": [("", rows_of_matrix)],
    "KITTI-360": [
        ("", lambda k: f"{2 * k + 1} {rows_of_matrix(k)}"),
        ("", lambda k: f"{2 * k + 1} {rows_of_matrix(k)} 0.0 0.0 0.0 1.0"),
    ],
    "TartanAir": [("", lambda k: f"{position(k)} {xyzw(k)}")],
}
EXPECTED_S = {"KITTI": np.arange(12), "KITTI-360": 2 * np.arange(12) + 1}
EXPECTED_S["TartanAir"] = EXPECTED_S["KITTI"]


def write(path: Path, header: str, row: Row) -> Path:
    path.write_text(header + "".join(f"{row(k)}\n" for k in range(len(TRUTH))))
    return path


@pytest.mark.parametrize(
    ("system", "header", "row"),
    [(system, *form) for system, forms in SYSTEMS.items() for form in forms],
)
def test_a_file_in_the_form_of_a_system_is_read(
    tmp_path: Path, system: str, header: str, row: Row
) -> None:
    read = read_trajectory(write(tmp_path / "poses.txt", header, row))
    np.testing.assert_allclose(read.T_world_frame, TRUTH.T_world_frame, atol=1e-9)
    expected_ns = EXPECTED_S[system] * 10**9 if system in EXPECTED_S else STAMPS_NS
    np.testing.assert_array_equal(read.stamps_ns, expected_ns)
    assert read.stamps_from == ("rows" if system in EXPECTED_S else "file")


def test_the_documentation_has_a_row_for_each_system() -> None:
    section = DOCS.read_text().partition("\n## Pose files\n")[2].partition("\n## ")[0]
    assert re.findall(r"^\| ([A-Z][\w-]+)", section, re.MULTILINE) == list(SYSTEMS)


@pytest.mark.parametrize(
    ("header", "row"),
    [
        # order
        ("# timestamp tx ty tz qw qx qy qz", lambda k: f"{seconds(k)} {position(k)} {wxyz(k)}"),
        ("# tx ty tz qw qx qy qz", lambda k: f"{seconds(k)} {position(k)} {wxyz(k)}"),
        (
            "# TUM format: timestamp tx ty tz qx qy qz qw\n# timestamp tx ty tz qx qy qz qw",
            lambda k: f"{seconds(k)} {position(k)} {xyzw(k)}",
        ),
        (
            "# not (w, x, y, z), but\n# timestamp tx ty tz qx qy qz qw",
            lambda k: f"{seconds(k)} {position(k)} {xyzw(k)}",
        ),
        ("t;q_x;q_y;q_z;q_w;p_x;p_y;p_z", lambda k: f"{seconds(k)};{xyzw(k)} {position(k)}"),
        (
            "# stamp, position (x, y, z), quaternion (w, x, y, z)",
            lambda k: f"{STAMPS_NS[k]},{position(k, ',')},{wxyz(k, ',')}",
        ),
        # unit, by its name or by the step
        ("time_us x y z qx qy qz qw", lambda k: f"{stamp(k, 3)} {position(k)} {xyzw(k)}"),
        ("timestamp [ms] x y z qx qy qz qw", lambda k: f"{stamp(k, 6)} {position(k)} {xyzw(k)}"),
        ("utime x y z qx qy qz qw", lambda k: f"{stamp(k, 3)} {position(k)} {xyzw(k)}"),
        ("timestamp(ns) x y z qx qy qz qw", lambda k: f"{stamp(k, 0)} {position(k)} {xyzw(k)}"),
        ("# position x y z", lambda k: f"{seconds(k)} {position(k)} {xyzw(k)}"),
        (
            "# position and quaternion (x, y, z, w)",
            lambda k: f"{STAMPS_NS[k]},{position(k, ',')},{xyzw(k, ',')}",
        ),
        ("timestamp x y z qx qy qz qw", lambda k: f"{stamp(k, 0)} {position(k)} {xyzw(k)}"),
        # further columns
        (
            "num,t,x,y,z,qx,qy,qz,qw",
            lambda k: f"{k},{seconds(k)},{position(k, ',')},{xyzw(k, ',')}",
        ),
        (
            "%time,field.header.seq,field.header.stamp,field.header.frame_id,"
            + ",".join(f"field.pose.position.{a}" for a in "xyz")
            + ","
            + ",".join(f"field.pose.orientation.{a}" for a in "xyzw"),
            lambda k: f"7,{k},{STAMPS_NS[k]},odom,{position(k, ',')},{xyzw(k, ',')}",
        ),
    ],
)
def test_a_header_decides(tmp_path: Path, header: str, row: Row) -> None:
    read = read_trajectory(write(tmp_path / "poses.txt", f"{header}\n", row))
    np.testing.assert_allclose(read.T_world_frame, TRUTH.T_world_frame, atol=1e-9)
    np.testing.assert_array_equal(read.stamps_ns, STAMPS_NS)


@pytest.mark.parametrize(
    ("header", "row", "match"),
    [
        ("", lambda k: f"{seconds(k)} {position(k)}", r":1: 4 columns between blanks.*no form"),
        ("", lambda k: f"{rows_of_matrix(k)} 0 0 0 1", ":1: 16 columns.*no form.*keep three rows"),
        (
            "",
            lambda k: f"{STAMPS_NS[k]} {position(k)} {wxyz(k)}",
            r":1: 8 columns.*fits TUM in nanoseconds \(.* and EuRoC \(.*; name the columns",
        ),
        (
            "",
            lambda k: f"{STAMPS_NS[k]},{position(k, ',')},{wxyz(k, ',')}",
            r":1: 8 columns.*fits TUM in nanoseconds \(.* and EuRoC \(.*; name the columns",
        ),
        (
            "",
            lambda k: f"{STAMPS_NS[k]}, {position(k, ', ')}, {xyzw(k, ', ')}, {state(9, ', ')}",
            r":1: 17 columns.*fits EuRoC \(.* and OKVIS \(.*; name the columns",
        ),
        (
            "x y z qx qy qz qw id stamp\n",
            lambda k: f"{position(k)} {xyzw(k)} 1",
            ":2: the header names no stamps",
        ),
        ("", lambda k: f"{50 * k} {position(k)} {xyzw(k)}", ":1: 8 columns.*first of them '0'"),
        (
            "",
            lambda k: f"{seconds(k)};{position(k, ';')};{xyzw(k, ';')}".replace(".", ","),
            r":1: could not convert.*'-?\d+,\d+'.*expected 8 numbers",
        ),
        (
            "# quaternion w x y z\n",
            lambda k: f"{seconds(k)} {position(k)} {xyzw(k)}",
            ":2: 8 columns.*no form",
        ),
        (
            "# tx ty tz qx qy qz qw id\n",
            lambda k: f"{position(k)} {xyzw(k)} {k}",
            ":2: the header names no stamps",
        ),
        (
            TUM_HEADER,
            lambda k: f"{50 * k} {position(k)} {xyzw(k)}",
            r":2: the header names no unit of the stamps.*step 50\)",
        ),
        (
            "# timestamp [s] qx qy qz qw x y z\n",
            lambda k: f"{seconds(k)} {position(k)} {xyzw(k)}",
            ":2: the quaternion is not of length one.*the header",
        ),
    ],
)
def test_what_fits_no_form_or_two_is_refused(
    tmp_path: Path, header: str, row: Row, match: str
) -> None:
    path = write(tmp_path / "poses.txt", header, row)
    with pytest.raises(TrajectoryError, match=match) as caught:
        read_trajectory(path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("first_s", [0, 1_403_636_579])
@pytest.mark.parametrize(
    ("step_s", "decimals"), [(12, "250000"), (3600, "250000"), (90_000, "000000000")]
)
def test_six_decimals_are_seconds_of_a_slow_recording_nine_of_any(
    tmp_path: Path, first_s: int, step_s: int, decimals: str
) -> None:
    path = tmp_path / "slow.txt"
    rows = [f"{first_s + step_s * k}.{decimals} {k} 0 0 0 0 0 1\n" for k in range(3)]
    path.write_text("".join(rows))
    stamps_s = [first_s + step_s * k + float(f"0.{decimals}") for k in range(3)]
    np.testing.assert_array_equal(read_trajectory(path).stamps_ns, np.array(stamps_s) * 1e9)


@pytest.mark.parametrize("stamp", ["{}", "{}.5", "{}.333", "14036{:05}", "1403636{:06}.000000"])
def test_steps_of_other_units_are_not_taken_for_seconds(tmp_path: Path, stamp: str) -> None:
    path = tmp_path / "poses.txt"
    step = 33_333 if "06" in stamp else 33
    path.write_text("".join(f"{stamp.format(k * step)} {k} 0 0 0 0 0 1\n" for k in range(3)))
    with pytest.raises(TrajectoryError, match="no form of poses"):
        read_trajectory(path)


def test_rows_of_a_matrix_are_no_quaternion_where_x_is_zero(tmp_path: Path) -> None:
    path = tmp_path / "cam0_to_world.txt"
    poses = ("1 0 0 0 0 1 0 0 0 0 1 {0} 0 0 0 1", "1 0 0 0 0 1 0 0 0 0 1 {0}")
    for pose in poses:
        path.write_text("".join(f"{k} {pose.format(k)}\n" for k in range(1, 9)))
        read = read_trajectory(path)
        np.testing.assert_array_equal(read.positions[:, 2], np.arange(1, 9))
        np.testing.assert_array_equal(read.stamps_ns, 10**9 * np.arange(1, 9))
