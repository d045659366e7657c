"""The values that travel between the stages."""

import numpy as np
import pytest

from gvo.types import Edge, Estimate, RelativePose, RgbdFrame, StereoFrame


def grey(*shape: int) -> np.ndarray[tuple[int, ...], np.dtype[np.uint8]]:
    return np.zeros(shape, dtype=np.uint8)


def test_a_relative_pose_is_truthy_and_counts_its_matches() -> None:
    pose = RelativePose(
        T_reference_current=np.eye(4),
        covariance=np.eye(6),
        matches=np.array([[0, 1], [1, 0], [2, 2]]),
        inliers=np.array([True, False, True]),
    )
    assert pose
    assert (pose.n_matches, pose.n_inliers) == (3, 2)


@pytest.mark.parametrize(
    ("left", "right"), [((4, 5), (4, 6)), ((4, 5), (5, 5)), ((4, 5, 3), (4, 5, 3)), ((5,), (5,))]
)
def test_a_stereo_frame_needs_two_grey_images_of_one_size(
    left: tuple[int, ...], right: tuple[int, ...]
) -> None:
    with pytest.raises(ValueError, match="one size"):
        StereoFrame(stamp_ns=0, left=grey(*left), right=grey(*right))


@pytest.mark.parametrize(("image", "depth"), [((4, 5), (4, 6)), ((4, 5, 3), (4, 5, 3))])
def test_an_rgbd_frame_needs_depth_of_the_size_of_its_grey_image(
    image: tuple[int, ...], depth: tuple[int, ...]
) -> None:
    with pytest.raises(ValueError, match="size"):
        RgbdFrame(stamp_ns=0, image=grey(*image), depth=np.zeros(depth, dtype=np.float32))


def test_images_of_another_type_are_refused() -> None:
    floats = np.zeros((4, 5), dtype=np.float32)
    with pytest.raises(ValueError, match="uint8"):
        StereoFrame(stamp_ns=0, left=floats, right=floats)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="uint8"):
        RgbdFrame(stamp_ns=0, image=floats, depth=floats)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="float32"):
        RgbdFrame(stamp_ns=0, image=grey(4, 5), depth=grey(4, 5))  # type: ignore[arg-type]


def test_what_is_no_array_and_no_stamp_is_refused() -> None:
    with pytest.raises(ValueError, match="must be arrays, got list"):
        StereoFrame(stamp_ns=0, left=[[0]], right=grey(1, 1))  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"int of nanoseconds, got 1\.5"):
        RgbdFrame(stamp_ns=1.5, image=grey(1, 1), depth=grey(1, 1))  # type: ignore[arg-type]


def test_edges_and_estimates_keep_copies_that_nobody_can_write_to() -> None:
    T, covariance = np.eye(4), np.eye(6)
    edge = Edge(reference_id="a", T_reference_frame=T, covariance=covariance)
    estimate = Estimate(stamp_ns=0, T_world_frame=T, covariance=covariance)
    T[0, 3], covariance[0, 0] = 7.0, 7.0
    for array in (edge.T_reference_frame, estimate.T_world_frame):
        assert array[0, 3] == 0.0
    for array in (edge.covariance, estimate.covariance):
        assert array[0, 0] == 1.0
        with pytest.raises(ValueError, match="read-only"):
            array[0, 0] = 2.0


def test_an_estimate_shows_its_position_along_the_axes_of_the_world() -> None:
    pose = np.array([[0.0, 0, 1, 1], [0, 1, 0, 2], [-1, 0, 0, 3], [0, 0, 0, 1]])  # looks along x
    covariance = np.diag(np.square([0.01, 0.02, 0.03, 0.1, 0.1, 0.5]))
    shown = repr(Estimate(stamp_ns=5, T_world_frame=pose, covariance=covariance))
    assert shown == "Estimate(0.000000005 s, (1.000 ± 0.5, 2.000 ± 0.1, 3.000 ± 0.1) m, ok)"
