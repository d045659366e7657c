"""The front-end of tracks, on rendered rooms with known poses and depths."""

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest

import gvo
from gvo.config import Config
from gvo.frontend.descriptor import DescriptorFrontend
from gvo.frontend.factory import make_frontend
from gvo.frontend.klt import KltFrontend, KltObservations
from gvo.frontend.registration import check_view
from gvo.geometry import se3
from gvo.io.recording import Sensor
from gvo.types import Failure, FloatArray, Frame, MotionPrior, RelativePose, RgbdFrame, StereoFrame
from tests.make.recordings import frames_of

N_FRAMES = 6
SENSORS: list[Sensor] = ["stereo", "rgbd"]


@cache
def recording(sensor: Sensor) -> gvo.SyntheticRecording:
    return gvo.SyntheticRecording("handheld", sensor, n_frames=N_FRAMES, scale=0.5)


@cache
def frames(sensor: Sensor) -> list[Frame]:
    return frames_of(recording(sensor))


def frontend(sensor: Sensor, **sections: dict[str, Any]) -> KltFrontend:
    return KltFrontend(recording(sensor).info.camera, Config.model_validate(sections))


@cache
def observations(sensor: Sensor) -> list[KltObservations]:
    return [frontend(sensor).extract(frame) for frame in frames(sensor)]


def true_motion(sensor: Sensor, reference: int, current: int) -> FloatArray:
    poses = recording(sensor).ground_truth().T_world_frame
    return np.asarray(se3.invert(poses[reference]) @ poses[current])


def wrong(T: FloatArray, size_rad: float) -> FloatArray:
    return np.asarray(T @ se3.exp(size_rad * np.array([1.0, -1.0, 0.5, 2.0, -2.0, 2.0])))


@pytest.mark.parametrize("sensor", SENSORS)
def test_the_points_lie_on_the_surfaces(sensor: Sensor) -> None:
    seen = observations(sensor)[0]
    assert seen.stamp_ns == frames(sensor)[0].stamp_ns
    assert seen.n_keypoints >= len(seen) > 150
    camera = frontend(sensor).camera
    uvd = seen.corners.uvd
    np.testing.assert_allclose(camera.project_stereo(seen.points_cam), uvd, atol=1e-9)
    columns, rows = seen.keypoints.astype(int).T
    depth = recording(sensor).render_depth(0)[rows, columns].astype(float)
    errors = camera.depth_to_disparity(depth) - uvd[:, 2]
    assert np.median(np.abs(errors)) < (0.1 if sensor == "stereo" else 0.2)
    assert np.mean(np.abs(errors) < 1.0) > 0.85


def expect(T: FloatArray | None) -> MotionPrior | None:
    return None if T is None else MotionPrior(T_predicted=T)


@pytest.mark.parametrize("sensor", SENSORS)
@pytest.mark.parametrize("prior", ["none", "true", "wrong", "far off"])
def test_the_motion_is_found_with_and_without_a_prediction(sensor: Sensor, prior: str) -> None:
    T = true_motion(sensor, 0, 2)
    priors = {"none": None, "true": T, "wrong": wrong(T, 0.005), "far off": wrong(T, 0.02)}
    first, _, third = observations(sensor)[:3]
    T_predicted = priors[prior]
    expected = None if T_predicted is None else MotionPrior(T_predicted=T_predicted, T_recent=T)
    result = frontend(sensor).register(first, third, expected)
    assert isinstance(result, RelativePose)
    error = se3.log(se3.invert(result.T_reference_current) @ T)
    assert np.linalg.norm(error[:3]) < 1.5e-3
    assert np.linalg.norm(error[3:]) < 4e-3
    # Patches that are aligned from a wrong prediction find some of the corners only.
    assert result.n_inliers > (60 if prior == "wrong" else 100)


@pytest.mark.parametrize("sensor", SENSORS)
def test_what_follows_a_failure_is_believed_where_enough_of_it_is_seen(sensor: Sensor) -> None:
    first, second = observations(sensor)[:2]
    T = true_motion(sensor, 0, 1)
    priors = [MotionPrior(T_predicted=T, T_recent=T, is_confirmed=told) for told in (True, False)]
    for prior in priors:
        assert isinstance(frontend(sensor).register(first, second, prior), RelativePose)
    frame = second.frame
    left = second.image.copy()
    left[48:] = 0  # a sixth of the view is left
    covered = frontend(sensor).extract(
        replace(frame, left=left) if isinstance(frame, StereoFrame) else replace(frame, image=left)
    )
    sure, doubtful = (frontend(sensor).register(first, covered, prior) for prior in priors)
    assert isinstance(sure, RelativePose)
    assert isinstance(doubtful, Failure)
    assert "to know a place again" in doubtful.reason


@pytest.mark.parametrize("prior", ["none", "true", "far off"])
def test_the_view_of_what_follows_a_failure_is_checked_once(
    monkeypatch: pytest.MonkeyPatch, prior: str
) -> None:
    checked: list[RelativePose | Failure] = []

    def note(result: RelativePose | Failure, *given: Any) -> RelativePose | Failure:
        checked.append(check_view(result, *given))
        return checked[-1]

    monkeypatch.setattr("gvo.frontend.klt.check_view", note)
    T = true_motion("stereo", 0, 1)
    T = T if prior == "true" else wrong(T, 0.2)  # near such a prediction nothing is tracked
    doubtful = MotionPrior(T_predicted=T, T_recent=T, is_confirmed=False)
    first, second = observations("stereo")[:2]
    result = frontend("stereo").register(first, second, None if prior == "none" else doubtful)
    assert [isinstance(each, RelativePose) for each in [*checked, result]] == [True, True]


@pytest.mark.parametrize("sensor", SENSORS)
def test_what_a_registration_rests_on_is_told(sensor: Sensor) -> None:
    first, second = observations(sensor)[:2]
    result = frontend(sensor).register(first, second)
    assert isinstance(result, RelativePose)
    indices = result.matches[:, 0]
    assert len(np.unique(indices)) == len(indices)
    assert indices.min() >= 0
    assert indices.max() < len(first)
    np.testing.assert_array_equal(result.matches[:, 1], -1)
    assert len(result.inliers) == len(indices)
    chosen = indices[result.inliers]
    T_current_reference = se3.invert(true_motion(sensor, 0, 1))
    points = se3.transform_points(T_current_reference, first.points_cam[chosen])
    flow = frontend(sensor).camera.project(points) - first.keypoints[chosen]
    assert result.flow_px == pytest.approx(np.median(np.linalg.norm(flow, axis=1)), abs=0.1)
    np.testing.assert_array_equal(result.pixels_reference, first.keypoints[indices])
    seen = result.pixels_current[result.inliers]
    assert np.median(np.linalg.norm(seen - first.keypoints[chosen] - flow, axis=1)) < 0.2
    off = np.linalg.norm(result.points_current[result.inliers] - points, axis=1)
    assert np.median(off / points[:, 2]) < 0.01


@pytest.mark.parametrize("sensor", SENSORS)
def test_the_errors_are_of_the_size_that_the_covariance_says(sensor: Sensor) -> None:
    squares = []
    seen = observations(sensor)
    for reference in range(N_FRAMES):
        for current in range(N_FRAMES):
            if reference == current:
                continue
            T = true_motion(sensor, reference, current)
            result = frontend(sensor).register(
                seen[reference], seen[current], expect(wrong(T, 0.002))
            )
            assert isinstance(result, RelativePose)
            error = se3.log(se3.invert(result.T_reference_current) @ T)
            squares.append(error @ np.linalg.solve(result.covariance, error) / 6)
    # Few frames, of one scene, that share their noise: a wide interval around one.
    assert 0.1 < np.mean(squares) < 4.0


def test_what_is_not_known_yet_of_the_camera_is_doubted_in_the_covariance() -> None:
    covariances = []
    for sigma_s in (0.0, 1e-5, 2e-5):
        learning = frontend("stereo", camera={"readout_ms": 0.0})
        first, second = (learning.extract(frame) for frame in frames("stereo")[:2])
        learning.rig_offsets.readout = 0.0, sigma_s
        result = learning.register(first, second)
        assert isinstance(result, RelativePose)
        covariances.append(result.covariance)
    small, medium, large = covariances
    doubt = medium - small
    # Of one direction, that in which a readout moves the pose.
    assert np.linalg.matrix_rank(doubt, tol=1e-3 * np.linalg.norm(doubt)) == 1
    np.testing.assert_allclose(large - medium, 3.0 * doubt, rtol=1e-3, atol=1e-3 * abs(doubt).max())


def test_points_out_of_the_limits_of_depth_are_left_out() -> None:
    near = frontend("stereo", stereo={"min_depth_m": 1.5, "max_depth_m": 2.5})
    depths = near.extract(frames("stereo")[0]).points_cam[:, 2]
    assert len(depths) > 20
    assert depths.min() >= 1.5
    assert depths.max() <= 2.5
    assert observations("stereo")[0].points_cam[:, 2].max() > 2.5


def test_points_of_unknown_depth_are_left_out() -> None:
    frame = frames("rgbd")[0]
    assert isinstance(frame, RgbdFrame)
    depth = frame.depth.copy()
    depth[:, 160:] = np.nan
    seen = frontend("rgbd").extract(replace(frame, depth=depth))
    assert len(seen) > 20
    assert seen.keypoints[:, 0].max() < 160


def blank(sensor: Sensor) -> Frame:
    frame = frames(sensor)[0]
    grey = np.full((240, 320), 90, dtype=np.uint8)
    if isinstance(frame, StereoFrame):
        return replace(frame, left=grey, right=grey)
    return replace(frame, image=grey, depth=np.full_like(frame.depth, np.nan))


@pytest.mark.parametrize("sensor", SENSORS)
def test_blank_images_give_no_points_and_no_motion(sensor: Sensor) -> None:
    klt = frontend(sensor)
    nothing, something = klt.extract(blank(sensor)), observations(sensor)[0]
    assert len(nothing) == 0
    for pair in ((nothing, something), (something, nothing), (nothing, nothing)):
        for prior in (None, np.eye(4), np.diag([-1.0, 1.0, -1.0, 1.0])):
            result = klt.register(*pair, expect(prior))
            assert isinstance(result, Failure)
            assert "ransac.min_inliers" in result.reason


def test_a_view_from_elsewhere_is_no_motion() -> None:
    frame = frames("stereo")[-1]
    assert isinstance(frame, StereoFrame)
    klt = frontend("stereo")
    upside_down = replace(frame, left=frame.left[::-1].copy(), right=frame.right[::-1].copy())
    result = klt.register(observations("stereo")[0], klt.extract(upside_down))
    assert isinstance(result, Failure)


@pytest.mark.parametrize(
    ("kind", "expected"), [("descriptor", DescriptorFrontend), ("klt", KltFrontend)]
)
def test_the_configuration_names_the_front_end(kind: str, expected: type) -> None:
    config = Config.model_validate({"frontend": {"kind": kind}})
    assert type(make_frontend(recording("stereo").info.camera, config)) is expected
    assert type(make_frontend(recording("rgbd").info.camera)) is KltFrontend


def test_a_drive_at_a_low_rate_begins_without_a_prediction() -> None:
    # Four frames apart the road moves by more than a track can follow, and nothing is predicted.
    drive = gvo.SyntheticRecording("driving", n_frames=5, seed=2)
    seen = [frame for frame in gvo.frames(drive, Config()) if isinstance(frame, StereoFrame)]
    tracker = KltFrontend(drive.info.camera, Config())
    first, last = tracker.extract(seen[0]), tracker.extract(seen[4])
    result = tracker.register(first, last)
    assert isinstance(result, RelativePose)
    poses = drive.ground_truth().T_world_frame
    error = se3.log(
        se3.invert(result.T_reference_current) @ np.asarray(se3.invert(poses[0]) @ poses[4])
    )
    assert np.linalg.norm(error[3:]) < 0.05


@pytest.mark.parametrize("kind", ["klt", "descriptor"])
@pytest.mark.parametrize("sensor", SENSORS)
def test_a_place_is_small_and_recognized(sensor: Sensor, kind: str) -> None:
    config = Config.model_validate({"frontend": {"kind": kind}})
    finder = make_frontend(recording(sensor).info.camera, config)
    seen = [finder.extract(frame) for frame in frames(sensor)]
    first, last = (finder.describe(each) for each in (seen[0], seen[-1]))  # type: ignore[arg-type]
    assert len(first.points_cam) == len(first.descriptors_left) <= 400
    arrays = [getattr(first, name, None) for name in first.__dataclass_fields__]
    assert sum(each.nbytes for each in arrays if isinstance(each, np.ndarray)) < 100_000
    result = finder.recognize(first, last, seen[-1])  # type: ignore[arg-type]
    assert isinstance(result, RelativePose)
    true = true_motion(sensor, 0, N_FRAMES - 1)
    error = se3.log(se3.invert(true) @ result.T_reference_current)
    assert np.linalg.norm(error[3:]) < 0.01
    assert se3.mahalanobis(error, result.covariance) < 40.0


@pytest.mark.parametrize("sensor", SENSORS)
def test_more_corners_of_a_place_are_described_where_it_matters(sensor: Sensor) -> None:
    klt = frontend(sensor, camera={"readout_ms": 0.0})
    first, *_, last = observations(sensor)
    places = klt.describe(first), klt.describe_densely(last)
    assert len(places[1].points_cam) > 1.5 * len(klt.describe(last).points_cam)
    result = klt.recognize(*places, last)
    assert isinstance(result, RelativePose)
    error = se3.invert(true_motion(sensor, 0, N_FRAMES - 1)) @ result.T_reference_current
    assert np.linalg.norm(error[:3, 3]) < 0.01


@pytest.mark.parametrize("sensor", SENSORS)
def test_another_place_is_not_recognized(sensor: Sensor) -> None:
    klt, frame = frontend(sensor), frames(sensor)[-1]
    turned: Frame = (
        replace(frame, left=frame.left[::-1].copy(), right=frame.right[::-1].copy())
        if isinstance(frame, StereoFrame)
        else replace(frame, image=frame.image[::-1].copy(), depth=frame.depth[::-1].copy())
    )
    other, nothing = klt.extract(turned), klt.extract(blank(sensor))
    here = observations(sensor)[0]
    for first, second in ((here, other), (other, here), (here, nothing), (nothing, here)):
        result = klt.recognize(klt.describe(first), klt.describe(second), second)
        assert isinstance(result, Failure)


def test_depth_that_contradicts_a_place_is_no_place() -> None:
    klt, (first, *_, last) = frontend("rgbd"), observations("rgbd")
    assert isinstance(last.frame, RgbdFrame)
    # The corners stay where they were; what lies between them is seen through.
    depth = np.full_like(last.frame.depth, 0.9 * Config().depth.max_depth_m)
    for u, v in np.rint(last.keypoints).astype(int):
        around = slice(v - 4, v + 5), slice(u - 4, u + 5)
        depth[around] = last.frame.depth[around]
    pierced = klt.extract(replace(last.frame, depth=depth))
    result = klt.recognize(klt.describe(first), klt.describe(pierced), pierced)
    assert isinstance(result, Failure)
    assert "free space" in result.reason
