"""Poses of the base frame, against composition by hand and sampled covariances."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from gvo.errors import ConfigurationError, RecordingError
from gvo.geometry import se3
from gvo.io.poses.base_frame import BaseFrame, mount_by_tf, parse_initial_pose
from gvo.io.poses.tf import TfBuffer
from gvo.trajectory.trajectory import Trajectory
from gvo.types import Edge, Estimate, FloatArray, InertialState
from tests.make.bags import add_transform
from tests.make.results import estimate_at

seeds = st.integers(min_value=0, max_value=2**32 - 1)
STAMPS_NS = [1_700_000_000_000_000_000 + n * 100_000_000 for n in range(6)]


def random_transform(rng: np.random.Generator) -> FloatArray:
    return se3.exp(np.concatenate([rng.uniform(-1.5, 1.5, size=3), rng.normal(size=3)]))


def random_covariance(rng: np.random.Generator, scale: float = 1.0) -> FloatArray:
    A = rng.normal(size=(6, 6))
    return np.asarray(scale**2 * (A @ A.T + 0.1 * np.eye(6)))


def camera_drive(rng: np.random.Generator) -> list[Estimate]:
    """Return estimates of a camera, the first at the origin of the world."""
    poses = [np.eye(4)]
    for _ in STAMPS_NS[1:]:
        poses.append(poses[-1] @ random_transform(rng))
    return [
        estimate_at(stamp_ns, T, covariance=random_covariance(rng))
        for stamp_ns, T in zip(STAMPS_NS, poses, strict=True)
    ]


def on_tf(
    buffer: TfBuffer, frame: str, camera: str, T_initial: FloatArray | None = None
) -> BaseFrame:
    return BaseFrame(frame, mount_by_tf(buffer, frame, camera, "drive.bag"), T_initial=T_initial)


def apply_all(frame: BaseFrame, estimates: Sequence[Estimate]) -> list[Estimate]:
    return [frame.apply(estimate) for estimate in estimates]


def mounted(rng: np.random.Generator, stamps_ns: Sequence[int]) -> tuple[TfBuffer, FloatArray]:
    """Return base -> pan (moving) -> mast -> cam (static), and T_base_cam (n, 4, 4) by hand."""
    buffer = TfBuffer()
    T_pan_mast, T_mast_cam = random_transform(rng), random_transform(rng)
    add_transform(buffer, "pan", "mast", 0, T_pan_mast, is_static=True)
    add_transform(buffer, "mast", "cam", 0, T_mast_cam, is_static=True)
    T_base_pan = [random_transform(rng) for _ in stamps_ns]
    for stamp_ns, T in zip(stamps_ns, T_base_pan, strict=True):
        add_transform(buffer, "base", "pan", stamp_ns, T)
    return buffer, np.array([T @ T_pan_mast @ T_mast_cam for T in T_base_pan])


def test_the_camera_itself_comes_back_untouched() -> None:
    drive = camera_drive(np.random.default_rng(0))
    for frame in (BaseFrame(), on_tf(TfBuffer(), "cam", "cam")):
        assert all(out is given for out, given in zip(apply_all(frame, drive), drive, strict=True))
        assert frame.first_stamp_ns == STAMPS_NS[0]


@given(seed=seeds)
def test_a_static_mount_is_composed_as_by_hand(seed: int) -> None:
    rng = np.random.default_rng(seed)
    drive, T_body_cam, T_initial = camera_drive(rng), random_transform(rng), random_transform(rng)
    frame = BaseFrame("body", T_body_cam, T_initial=T_initial)
    outs = apply_all(frame, drive)
    np.testing.assert_allclose(outs[0].T_world_frame, T_initial, rtol=0, atol=1e-12)
    for out, given_ in zip(outs, drive, strict=True):
        # a body's motion since the start is the camera's, seen from the body
        T_first_now = T_body_cam @ given_.T_world_frame @ np.linalg.inv(T_body_cam)
        np.testing.assert_allclose(out.T_world_frame, T_initial @ T_first_now, rtol=0, atol=1e-9)
        assert (out.stamp_ns, out.status) == (given_.stamp_ns, given_.status)
    assert frame.n_guessed == 0


@given(seed=seeds)
def test_a_mount_that_moves_is_composed_as_by_hand_in_any_order(seed: int) -> None:
    rng = np.random.default_rng(seed)
    drive = camera_drive(rng)
    buffer, T_base_cam = mounted(rng, STAMPS_NS)
    frame = on_tf(buffer, "base", "cam")
    frame.start(STAMPS_NS[0])
    for n in rng.permutation(len(drive)):
        expected = T_base_cam[0] @ drive[n].T_world_frame @ np.linalg.inv(T_base_cam[n])
        out = frame.apply(drive[n]).T_world_frame
        np.testing.assert_allclose(out, expected, rtol=0, atol=1e-9)
    assert frame.n_guessed == 0


@given(seed=seeds)
def test_an_edge_leads_from_base_to_base(seed: int) -> None:
    rng = np.random.default_rng(seed)
    buffer, _ = mounted(rng, STAMPS_NS)
    frame = on_tf(buffer, "base", "cam")
    first, *_, last = camera_drive(rng)
    edge = Edge(
        reference_id=first.stamp_ns,
        T_reference_frame=se3.invert(first.T_world_frame) @ last.T_world_frame,
        covariance=last.covariance,
    )
    found = frame.apply_to_edge(last.stamp_ns, edge)
    a, b = apply_all(frame, [first, last])
    T_a_b = se3.invert(a.T_world_frame) @ b.T_world_frame
    np.testing.assert_allclose(found.T_reference_frame, T_a_b, atol=1e-9)
    np.testing.assert_allclose(found.covariance, b.covariance, atol=1e-9)
    assert BaseFrame("cam").apply_to_edge(last.stamp_ns, edge) is edge


def test_the_covariance_is_that_of_sampled_poses() -> None:
    rng = np.random.default_rng(3)
    buffer, _ = mounted(rng, STAMPS_NS)
    frame = on_tf(buffer, "base", "cam")
    frame.start(STAMPS_NS[0])
    T, covariance = random_transform(rng), random_covariance(rng, scale=1e-4)

    def of(T_world_cam: FloatArray) -> Estimate:
        return frame.apply(estimate_at(STAMPS_NS[3], T_world_cam, covariance=covariance))

    out = of(T)
    twists = rng.multivariate_normal(np.zeros(6), covariance, size=1000)
    poses = np.array([of(T @ se3.exp(xi)).T_world_frame for xi in twists])
    moved = se3.log(np.linalg.inv(out.T_world_frame) @ poses)
    sampled = moved.T @ moved / len(moved)
    # whitened by the stated covariance it is the identity; its entries scatter by 0.03 to 0.045
    L_inverse = np.linalg.inv(np.linalg.cholesky(out.covariance))
    np.testing.assert_allclose(L_inverse @ sampled @ L_inverse.T, np.eye(6), atol=0.2)
    assert np.array_equal(out.covariance, out.covariance.T)


def test_where_tf_starts_late_and_ends_early_the_nearest_transform_is_taken_and_counted() -> None:
    rng = np.random.default_rng(1)
    drive = camera_drive(rng)
    buffer, T_base_cam = mounted(rng, STAMPS_NS[2:5])
    frame = on_tf(buffer, "base", "cam")
    for _ in range(2):  # raw and causal, say
        outs = apply_all(frame, drive)
    rows = [0, 0, 0, 1, 2, 2]
    for out, given_, row in zip(outs, drive, rows, strict=True):
        expected = T_base_cam[0] @ given_.T_world_frame @ np.linalg.inv(T_base_cam[row])
        np.testing.assert_allclose(out.T_world_frame, expected, rtol=0, atol=1e-9)
    assert frame.n_guessed == 3


@pytest.mark.parametrize(
    ("frame", "camera", "words"),
    [
        ("base_lnk", "cam", ("no frame base_lnk", "nearest: base_link", "mast")),
        ("base_link", "kamera_optical", ("no frame kamera_optical", "it holds base_link")),
        ("base_link", "", ("frame_id is empty",)),
        ("base_link", "lidar", ("does not connect", "lidar at car", "tf holds base_link")),
        ("base_link", "late", ("late is known from", "rider")),
    ],
)
def test_frames_that_tf_does_not_connect_are_refused_in_one_line(
    frame: str, camera: str, words: Sequence[str]
) -> None:
    buffer = TfBuffer()
    add_transform(buffer, "base_link", "mast", 0, np.eye(4), is_static=True)
    add_transform(buffer, "mast", "cam", 0, np.eye(4), is_static=True)
    add_transform(buffer, "car", "lidar", 0, np.eye(4), is_static=True)
    add_transform(buffer, "base_link", "rider", 1, np.eye(4))
    add_transform(buffer, "rider", "late", 2, np.eye(4))
    with pytest.raises(RecordingError) as caught:
        on_tf(buffer, frame, camera)
    text = str(caught.value)
    assert "\n" not in text
    for word in ("drive.bag", f"--frame {frame}", "--calibration", camera, *words):
        assert word in text


@pytest.mark.parametrize("is_moving", [False, True])
def test_what_an_imu_tells_of_the_camera_is_told_of_the_frame(is_moving: bool) -> None:
    rng, stamp_ns = np.random.default_rng(6), STAMPS_NS[0]
    way, swing = rng.normal(size=6), 0.3 * rng.normal(size=6) * is_moving
    T_start, T_mount = random_transform(rng), random_transform(rng)

    def mount(at_ns: int) -> tuple[FloatArray, bool]:
        return T_mount @ se3.exp(swing * 1e-9 * (at_ns - stamp_ns)), False

    def base_at(at_ns: int) -> FloatArray:
        T_world_cam = T_start @ se3.exp(way * 1e-9 * (at_ns - stamp_ns))
        return np.asarray(T_world_cam @ np.linalg.inv(mount(at_ns)[0]))

    up_world, A = np.array([0.0, 0.6, 0.8]), rng.normal(size=(6, 6))
    told = InertialState(
        stamp_ns=stamp_ns,
        twist=way,
        twist_covariance=A @ A.T,
        up=T_start[:3, :3].T @ up_world,
        gyro_bias=np.ones(3),
        acceleration_bias=np.ones(3),
        sigmas=np.ones(3),
    )
    frame = BaseFrame("base", mount if is_moving else T_mount)
    found = frame.apply_to_inertial(told)
    assert found is not None
    before, after = base_at(stamp_ns - 10_000), base_at(stamp_ns + 10_000)
    R, step = before[:3, :3].T, (after - before)[:3, 3] / 2e-5
    turn = Rotation.from_matrix(R @ after[:3, :3]).as_rotvec() / 2e-5
    np.testing.assert_allclose(found.twist, [*turn, *(R @ step)], rtol=1e-3, atol=1e-3)
    np.testing.assert_allclose(found.velocity, found.twist[3:])
    np.testing.assert_allclose(base_at(stamp_ns)[:3, :3] @ found.up, up_world, atol=1e-9)
    # a velocity that is wrong by some amount is moved by the same lever
    wrong = replace(told, twist=way + A[:, 0], twist_covariance=np.outer(A[:, 0], A[:, 0]))
    moved = frame.apply_to_inertial(wrong)
    assert moved is not None
    error = moved.twist - found.twist
    np.testing.assert_allclose(moved.twist_covariance, np.outer(error, error), atol=1e-9)
    assert BaseFrame().apply_to_inertial(told) is told
    assert frame.apply_to_inertial(None) is None


@pytest.mark.parametrize("is_moving", [False, True])
def test_true_poses_of_the_camera_become_those_of_the_frame_in_its_world(is_moving: bool) -> None:
    rng = np.random.default_rng(4)
    drive = camera_drive(rng)
    buffer, T_base_cam = mounted(rng, STAMPS_NS[1:])
    static = BaseFrame("base", T_base_cam[0], T_initial=random_transform(rng))
    frame = on_tf(buffer, "base", "cam") if is_moving else static
    truth = frame.convert(Trajectory.of(drive))
    first = 1 if is_moving else 0  # tf says nothing of the first stamp
    assert truth.stamps_ns.tolist() == STAMPS_NS[first:]
    for n, T_world_base in enumerate(truth.T_world_frame):
        T = T_base_cam[n] if is_moving else T_base_cam[0]
        np.testing.assert_allclose(T_world_base @ T, drive[n + first].T_world_frame, atol=1e-9)


@pytest.mark.parametrize(
    "text",
    [
        *("", "1,2", "1,2,x", "1,2,nan", "1,2,3,0,0,90", "Truth", "1,2,3,0,0,0,0", "1;2;3"),
        "1,2,3,-1e308,2,0,0",
    ],
)
def test_an_initial_pose_that_is_none_is_refused_in_one_line(text: str) -> None:
    with pytest.raises(ConfigurationError, match=r"--initial-pose .*expected") as caught:
        parse_initial_pose(text)
    assert "\n" not in str(caught.value)


@given(seed=seeds)
def test_a_correction_of_the_camera_is_that_of_the_base_frame(seed: int) -> None:
    rng = np.random.default_rng(seed)
    drive = camera_drive(rng)
    buffer, _ = mounted(rng, STAMPS_NS)
    frame = on_tf(buffer, "base", "cam")
    frame.start(STAMPS_NS[0], random_transform(rng))
    T_map_world = random_transform(rng)
    for estimate in drive:
        corrected = replace(estimate, T_world_frame=T_map_world @ estimate.T_world_frame)
        expected = frame.apply(corrected).T_world_frame
        found = frame.apply_to_world(T_map_world) @ frame.apply(estimate).T_world_frame
        np.testing.assert_allclose(found, expected, atol=1e-9)
