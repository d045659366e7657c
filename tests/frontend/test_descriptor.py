"""The front-end on pictures of two walls at known depths."""

from dataclasses import replace
from typing import Literal

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gvo.config import Config
from gvo.frontend.descriptor import DescriptorFrontend, as_stereo
from gvo.frontend.offsets import RigOffsets
from gvo.geometry.camera import PinholeCamera, StereoCamera
from gvo.types import (
    Failure,
    FloatArray,
    ImageArray,
    MotionPrior,
    Observations,
    RelativePose,
    RgbdFrame,
    StereoFrame,
)

CAMERA = StereoCamera(fx=200.0, fy=200.0, cx=159.5, cy=99.5, width=320, height=200, baseline=0.12)
COLOUR = PinholeCamera(fx=200.0, fy=200.0, cx=159.5, cy=99.5, width=320, height=200)
# The upper half of the image shows a wall 2.4 m away, the lower half one 1.2 m away.
DISPARITIES = (10.0, 20.0)
SIXTEENTHS = 4  # OpenCV draws at sixteenths of a pixel

Kind = Literal["orb", "sift", "fast", "gftt"]


def draw(x_m: float = 0.0) -> ImageArray:
    """Draw what a camera sees that was moved to the right by `x_m` metres."""
    rng = np.random.default_rng(0)
    image = np.full((200, 320), 120, dtype=np.uint8)
    for half, disparity in enumerate(DISPARITIES):
        part = np.full((100, 320), 120, dtype=np.uint8)
        for u, v, radius, grey in zip(
            rng.uniform(-40, 360, 350),
            rng.integers(0, 100, 350),
            rng.integers(2, 9, 350),
            rng.integers(0, 256, 350),
            strict=True,
        ):
            moved = u - disparity * x_m / CAMERA.baseline
            centre = (round(16 * moved), 16 * int(v))
            cv2.circle(part, centre, 16 * int(radius), int(grey), -1, cv2.LINE_AA, SIXTEENTHS)
        image[100 * half : 100 * half + 100] = part
    return np.asarray(cv2.GaussianBlur(image, (0, 0), 0.8), dtype=np.uint8)


def stereo_frame(x_m: float = 0.0, stamp_ns: int = 0) -> StereoFrame:
    return StereoFrame(stamp_ns=stamp_ns, left=draw(x_m), right=draw(x_m + CAMERA.baseline))


def depth_image() -> np.ndarray[tuple[int, ...], np.dtype[np.float32]]:
    depths = 24.0 / np.repeat(DISPARITIES, 100)
    return np.tile(depths[:, np.newaxis], (1, 320)).astype(np.float32)


def rgbd_frame(x_m: float = 0.0, stamp_ns: int = 0) -> RgbdFrame:
    return RgbdFrame(stamp_ns=stamp_ns, image=draw(x_m), depth=depth_image())


def configure(kind: Kind = "orb", threads: int = 1, **sections: dict[str, object]) -> Config:
    values: dict[str, dict[str, object]] = {
        "features": {"kind": kind, "n_features": 400, "n_octaves": 1},
        "stereo": {"min_depth_m": 0.6, "max_depth_m": 20.0},
        "depth": {
            "min_depth_m": 0.5,
            "max_depth_m": 10.0,
            "sigma_px": 0.4,
            "max_edge_step": 0.05,
            "edge_radius_px": 2,
        },
        "temporal": {"radius_px": 10.0, "max_distance": 0.25},
        "ransac": {"n_hypotheses": 100, "min_inliers": 12, "min_disparity_px": 2.0},
        "runtime": {"threads": threads},
    }
    for name, changes in sections.items():
        values[name] = values.get(name, {}) | changes
    return Config.model_validate(values)


def check_consistency(observations: Observations, camera: StereoCamera) -> None:
    n = len(observations)
    uvd = np.column_stack([observations.keypoints, observations.disparities])
    np.testing.assert_allclose(camera.project_stereo(observations.points_cam), uvd, atol=1e-9)
    assert observations.sigmas.shape == (n, 3)
    assert len(observations.descriptors_left) == n
    assert observations.n_keypoints >= n


@pytest.mark.parametrize("kind", ["orb", "sift", "fast", "gftt"])
def test_stereo_points_lie_on_the_walls(kind: Kind) -> None:
    frontend = DescriptorFrontend(CAMERA, configure(kind))
    observations = frontend.extract(stereo_frame(stamp_ns=5))
    assert observations.stamp_ns == 5
    assert len(observations) > 100
    check_consistency(observations, CAMERA)
    assert observations.descriptors_right is not None
    assert len(observations.descriptors_right) == len(observations)
    rows = observations.keypoints[:, 1]
    errors = observations.disparities - np.where(rows < 100, *DISPARITIES)
    errors = errors[np.abs(rows - 99.5) > 12]  # away from the seam
    assert np.median(np.abs(errors)) < 0.08
    assert np.mean(np.abs(errors) < 0.5) > 0.95
    np.testing.assert_allclose(
        observations.points_cam[:, 2], 24.0 / observations.disparities, rtol=1e-9
    )


@pytest.mark.parametrize("kind", ["orb", "sift", "fast", "gftt"])
def test_sigmas_grow_with_the_octave_from_that_of_the_image(kind: Kind) -> None:
    config = configure(kind, features={"n_octaves": 4, "scale_factor": 1.5})
    sigmas = DescriptorFrontend(CAMERA, config).extract(stereo_frame()).sigmas
    np.testing.assert_array_equal(sigmas[:, 0], sigmas[:, 1])
    np.testing.assert_array_equal(sigmas[:, 2], 0.3)
    # SIFT's octaves halve the image, and the first of them is of twice its size.
    steps = 0.35 * 2.0 ** np.arange(7) if kind == "sift" else 0.7 * 1.5 ** np.arange(4)
    assert np.abs(sigmas[:, :1] - steps).min(axis=1).max() < 1e-9
    assert len(np.unique(sigmas[:, 0])) > 1 or kind in ("fast", "gftt")


@pytest.mark.parametrize(("limits", "half"), [((0.6, 1.8), 1), ((1.8, 20.0), 0)])
def test_points_beyond_limits_of_depth_are_left_out(limits: tuple[float, float], half: int) -> None:
    nearest, farthest = limits
    config = configure(stereo={"min_depth_m": nearest, "max_depth_m": farthest})
    observations = DescriptorFrontend(CAMERA, config).extract(stereo_frame())
    assert len(observations) > 50
    depths = observations.points_cam[:, 2]
    assert np.all((depths >= nearest) & (depths <= farthest))
    in_half = (observations.keypoints[:, 1] >= 100) == bool(half)
    assert in_half.mean() > 0.9  # the others are chance matches of the other wall


def test_the_limits_hold_for_the_refined_depth() -> None:
    # The far wall stands at the very limit: noise puts half of its points beyond.
    config = configure(stereo={"min_depth_m": 0.6, "max_depth_m": 2.4})
    observations = DescriptorFrontend(CAMERA, config).extract(stereo_frame())
    assert np.mean(observations.keypoints[:, 1] < 100) > 0.1
    assert observations.points_cam[:, 2].max() <= 2.4


def test_depth_points_lie_where_the_depth_image_says() -> None:
    frontend = DescriptorFrontend(COLOUR, configure())
    observations = frontend.extract(rgbd_frame(stamp_ns=9))
    assert observations.stamp_ns == 9
    assert len(observations) > 100
    check_consistency(observations, frontend.camera)
    assert observations.descriptors_right is None
    rows = np.rint(observations.keypoints[:, 1]).astype(int)
    np.testing.assert_allclose(observations.points_cam[:, 2], depth_image()[rows, 0], rtol=1e-6)
    assert np.abs(rows - 99.5).min() > 2
    np.testing.assert_array_equal(observations.sigmas[:, 2], 0.4)


def test_points_of_unknown_depth_are_left_out() -> None:
    frame = rgbd_frame()
    depth = frame.depth.copy()
    depth[:, 160:] = np.nan
    frontend = DescriptorFrontend(COLOUR, configure())
    observations = frontend.extract(replace(frame, depth=depth))
    assert len(observations) > 30
    assert observations.keypoints[:, 0].max() < 160
    assert np.isfinite(observations.points_cam).all()
    everything = frontend.extract(replace(frame, depth=np.full_like(depth, np.nan)))
    assert len(everything) == 0
    assert everything.n_keypoints > 100


def test_an_rgbd_camera_is_seen_as_a_stereo_camera_of_the_virtual_baseline() -> None:
    camera = as_stereo(COLOUR)
    assert camera.baseline == 0.075
    np.testing.assert_array_equal(camera.K, COLOUR.K)
    assert (camera.width, camera.height) == (320, 200)
    assert as_stereo(CAMERA) is CAMERA


@pytest.mark.parametrize("blank", ["both", "left", "right"])
def test_blank_images_give_no_points_and_no_motion(blank: str) -> None:
    grey, drawn = np.full((200, 320), 90, dtype=np.uint8), draw()
    left, right = (grey if blank in ("both", side) else drawn for side in ("left", "right"))
    frame = StereoFrame(stamp_ns=1, left=left, right=right)
    frontend = DescriptorFrontend(CAMERA, configure())
    nothing, something = frontend.extract(frame), frontend.extract(stereo_frame())
    assert len(nothing) == 0
    for pair in ((nothing, something), (something, nothing), (nothing, nothing)):
        for prior in (None, MotionPrior(T_predicted=np.eye(4))):
            result = frontend.register(*pair, prior)
            assert isinstance(result, Failure)
            assert result.n_matches == 0


def moved(x_m: float) -> FloatArray:
    T = np.eye(4)
    T[0, 3] = x_m
    return T


def expect(x_m: float) -> MotionPrior:
    return MotionPrior(T_predicted=moved(x_m))


@pytest.mark.parametrize("sensor", ["stereo", "rgbd"])
@pytest.mark.parametrize("prior", ["none", "true", "wrong"])
def test_motion_of_frames_is_found_with_and_without_prediction(sensor: str, prior: str) -> None:
    x_m = 0.12  # 10 and 20 px
    if sensor == "stereo":
        frontend = DescriptorFrontend(CAMERA, configure())
        pair = [frontend.extract(stereo_frame(x, stamp_ns=i)) for i, x in enumerate((0.0, x_m))]
    else:
        frontend = DescriptorFrontend(COLOUR, configure())
        pair = [frontend.extract(rgbd_frame(x, stamp_ns=i)) for i, x in enumerate((0.0, x_m))]
    priors = {"none": None, "true": expect(x_m), "wrong": expect(-0.08)}
    result = frontend.register(pair[0], pair[1], priors[prior])
    assert isinstance(result, RelativePose)
    np.testing.assert_allclose(result.T_reference_current, moved(x_m), atol=0.01)
    assert result.n_inliers > 60


def test_what_is_tried_before_a_frame_is_registered_teaches_nothing(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    noted: list[object] = []
    monkeypatch.setattr(RigOffsets, "note", lambda _, told: noted.append(told))
    frontend = DescriptorFrontend(CAMERA, configure())
    first, second, third = (
        frontend.extract(stereo_frame(x, stamp_ns=i)) for i, x in enumerate((0, 0.12, 0.24))
    )
    places = frontend.describe(first), frontend.describe(second)
    assert isinstance(frontend.recognize(*places, second), RelativePose)
    assert isinstance(frontend.register(first, second), RelativePose)
    link = MotionPrior(T_predicted=expect(0.12).T_predicted)
    assert isinstance(frontend.register(first, second, link), RelativePose)
    assert noted == []
    assert isinstance(frontend.register(second, third), RelativePose)
    assert len(noted) == 1


def test_a_wrong_prediction_finds_nothing_where_the_wide_search_ends_before() -> None:
    config = configure(temporal={"radius_px": 1.5, "max_distance": 0.12})
    frontend = DescriptorFrontend(CAMERA, config)
    pair = [frontend.extract(stereo_frame(x, stamp_ns=i)) for i, x in enumerate((0.0, 0.12))]
    assert isinstance(frontend.register(pair[0], pair[1], expect(-0.12)), Failure)
    assert isinstance(frontend.register(pair[0], pair[1], expect(0.12)), RelativePose)


@settings(max_examples=3)
@given(x_m=st.floats(0.0, 0.1))
def test_two_threads_see_what_one_sees(x_m: float) -> None:
    frame = stereo_frame(x_m)
    one, two = (
        DescriptorFrontend(CAMERA, configure(threads=threads)).extract(frame) for threads in (1, 2)
    )
    for name in ("keypoints", "disparities", "points_cam", "descriptors_left", "descriptors_right"):
        np.testing.assert_array_equal(getattr(one, name), getattr(two, name))


def test_chance_matches_do_not_survive_between_unlike_frames() -> None:
    frontend = DescriptorFrontend(CAMERA, configure())
    first = frontend.extract(stereo_frame())
    upside_down = StereoFrame(
        stamp_ns=1, left=draw()[::-1].copy(), right=draw(CAMERA.baseline)[::-1].copy()
    )
    assert isinstance(frontend.register(first, frontend.extract(upside_down)), Failure)
