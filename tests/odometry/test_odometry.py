"""Odometry on frames rendered of a textured box, with known poses."""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cache
from itertools import pairwise
from typing import Any

import cv2
import numpy as np
import pytest

from gvo.config import CameraConfig, Config, FrontendConfig
from gvo.frontend.klt import KltFrontend
from gvo.frontend.offsets import RigOffsets
from gvo.geometry import se3
from gvo.geometry.camera import PinholeCamera, StereoCamera
from gvo.odometry.odometry import Odometry
from gvo.types import (
    DepthArray,
    Estimate,
    Failure,
    FloatArray,
    Frame,
    FrameResult,
    ImageArray,
    MotionPrior,
    RelativePose,
    RgbdFrame,
    Status,
    StereoFrame,
)

CAMERA = StereoCamera(fx=200.0, fy=200.0, cx=159.5, cy=99.5, width=320, height=200, baseline=0.12)
PINHOLE = PinholeCamera(fx=200.0, fy=200.0, cx=159.5, cy=99.5, width=320, height=200)
STEP_NS = 50_000_000
N_FRAMES = 16
NAMES = ("raw", "causal", "smoothed", "global")
# Planes n . p = c of a room, and the two axes that their texture is laid along.
PLANES = [
    (np.array([0.0, 0.0, 1.0]), 4.0, [0, 1]),
    (np.array([0.0, 1.0, 0.0]), 1.2, [0, 2]),
    (np.array([0.0, -1.0, 0.0]), 1.5, [0, 2]),
    (np.array([1.0, 0.0, 0.0]), 2.5, [1, 2]),
    (np.array([-1.0, 0.0, 0.0]), 2.5, [1, 2]),
]
TEXELS_PER_M = 55.0


@cache
def texture(seed: int) -> ImageArray:
    rng = np.random.default_rng(seed)
    image = np.full((512, 512), 120, dtype=np.uint8)
    for u, v, radius, grey in zip(
        *rng.integers(0, 512, (2, 2500)),
        rng.integers(2, 9, 2500),
        rng.integers(10, 246, 2500),
        strict=True,
    ):
        cv2.circle(image, (int(u), int(v)), int(radius), int(grey), -1)
    return np.asarray(cv2.GaussianBlur(image, (0, 0), 1.0), dtype=np.uint8)


def render(T_world_cam: FloatArray) -> tuple[ImageArray, DepthArray]:
    """Cast one ray per pixel against all planes."""
    v, u = np.indices((CAMERA.height, CAMERA.width)).astype(float)
    rays = np.stack([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, np.ones_like(u)], -1)
    directions = rays @ T_world_cam[:3, :3].T
    origin = T_world_cam[:3, 3]
    image = np.zeros(u.shape, dtype=np.uint8)
    depth: FloatArray = np.full(u.shape, np.inf)
    for seed, (normal, distance, axes) in enumerate(PLANES):
        with np.errstate(divide="ignore"):
            hit = (distance - origin @ normal) / (directions @ normal)
        is_nearest = (hit > 0) & (hit < depth)
        at = (origin + np.where(is_nearest, hit, 0.0)[..., None] * directions)[..., axes]
        columns, rows = np.moveaxis((TEXELS_PER_M * at + 256).astype(np.float32), -1, 0)
        colours = cv2.remap(
            texture(seed), columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP
        )
        image[is_nearest] = np.asarray(colours)[is_nearest]
        depth[is_nearest] = hit[is_nearest]
    return image, depth.astype(np.float32)


def true_pose(index: int) -> FloatArray:
    """Return T_world_cam of a camera on an arc: it sways, turns and comes forward."""
    phase = 0.12 * index
    return se3.exp(
        np.array(
            [0.04 * np.sin(phase), 0.1 * np.sin(phase), 0.0, 0.4 * np.sin(phase), 0, 0.05 * phase]
        )
    )


@cache
def stereo_frame(index: int) -> StereoFrame:
    to_right = np.eye(4)
    to_right[0, 3] = CAMERA.baseline
    return StereoFrame(
        stamp_ns=index * STEP_NS,
        left=render(true_pose(index))[0],
        right=render(true_pose(index) @ to_right)[0],
    )


@cache
def rgbd_frame(index: int) -> RgbdFrame:
    image, depth = render(true_pose(index))
    return RgbdFrame(stamp_ns=index * STEP_NS, image=image, depth=depth)


def blank(index: int) -> StereoFrame:
    grey = np.full((CAMERA.height, CAMERA.width), 100, dtype=np.uint8)
    return StereoFrame(stamp_ns=index * STEP_NS, left=grey, right=grey)


def later(frame: Frame) -> Frame:
    """Return the frame two seconds later, from the fifth on."""
    return replace(frame, stamp_ns=frame.stamp_ns + 2_000_000_000 * (frame.stamp_ns > 4 * STEP_NS))


def configure(threads: int = 1, **window: object) -> Config:
    return Config.model_validate(
        {
            "frontend": {"kind": "descriptor"},
            "features": {"n_features": 300, "cell_size_px": 40, "kind": "orb", "n_octaves": 1},
            "stereo": {"min_depth_m": 0.5, "max_depth_m": 30.0},
            "depth": {"min_depth_m": 0.5, "max_depth_m": 10.0},
            "temporal": {"radius_px": 15.0},
            "ransac": {"n_hypotheses": 100, "min_inliers": 12, "min_disparity_px": 2.0},
            "window": {"size": 4, "n_keyframes": 4, "n_links": 3} | window,
            "runtime": {"threads": threads},
        }
    )


def with_known_readout(config: Config) -> Config:
    """Return a configuration with which links tell the front-end nothing of the camera."""
    return config.model_copy(update={"camera": CameraConfig(readout_ms=0)})


def run(
    frames: Iterable[Frame], config: Config, camera: StereoCamera | PinholeCamera = CAMERA
) -> tuple[list[FrameResult], list[Estimate]]:
    odometry = Odometry(camera, config)
    results = [odometry.track(frame) for frame in frames]
    smoothed = [estimate for result in results for estimate in result.finished]
    smoothed += odometry.finish()
    return results, sorted(smoothed, key=lambda estimate: estimate.stamp_ns)


@cache
def stereo_run() -> tuple[list[FrameResult], list[Estimate]]:
    return run(map(stereo_frame, range(N_FRAMES)), configure())


def position_errors(estimates: Iterable[Estimate]) -> FloatArray:
    return np.array(
        [
            np.linalg.norm((e.T_world_frame - true_pose(e.stamp_ns // STEP_NS))[:3, 3])
            for e in estimates
        ]
    )


def test_a_stereo_camera_is_followed_to_centimetres() -> None:
    results, smoothed = stereo_run()
    assert all(result.status == Status.OK for result in results)
    # A step of 5 cm at 4 m is 2.5 px; the corners are whole pixels.
    for estimates in ([r.raw for r in results], [r.causal for r in results], smoothed):
        assert position_errors(estimates).max() < 0.06
    assert np.linalg.norm(true_pose(N_FRAMES - 1)[:3, 3]) > 0.3


def test_a_depth_camera_is_followed_to_centimetres() -> None:
    results, smoothed = run(map(rgbd_frame, range(8)), configure(), PINHOLE)
    assert all(result.status == Status.OK for result in results)
    for estimates in ([r.raw for r in results], [r.causal for r in results], smoothed):
        assert position_errors(estimates).max() < 0.06


def test_the_trajectories_so_far_and_at_the_end_are_those_of_the_results() -> None:
    results, smoothed = stereo_run()
    odometry = Odometry(CAMERA, configure())
    for index in range(N_FRAMES):
        odometry.track(stereo_frame(index))
        if index == 8:
            early = odometry.trajectories()
    assert {name: len(each) for name, each in early.items()} == dict.fromkeys(NAMES, 9)
    odometry.finish()
    found = odometry.trajectories()
    expected = [[r.raw for r in results], [r.causal for r in results], smoothed, smoothed]
    for name, estimates in zip(NAMES, expected, strict=True):
        assert found[name].stamps_ns.tolist() == [e.stamp_ns for e in estimates], name
        poses = [e.T_world_frame for e in estimates]
        np.testing.assert_allclose(found[name].T_world_frame, poses, atol=1e-12, err_msg=name)
        whole = early[name].stamps_ns
        np.testing.assert_array_equal(whole, found[name].stamps_ns[: len(whole)])
    assert found["smoothed"].covariances is not None


def test_a_notebook_shows_one_line_of_each_result() -> None:
    odometry = Odometry(CAMERA, configure())
    for index in range(2):
        result = odometry.track(stereo_frame(index))
    shown = [repr(odometry), repr(result), repr(odometry.optimize())]
    assert all("\n" not in text and len(text) < 200 for text in shown)
    assert "2 frames" in shown[0]
    assert f"{result.n_inliers} inliers of {result.n_matches} matches" in shown[1]
    assert shown[2] == "Optimum(2 poses, 1 edges, 0 loops)"


def test_what_a_frame_gave_is_counted() -> None:
    results, _ = stereo_run()
    for index, result in enumerate(results):
        assert result.stamp_ns == result.raw.stamp_ns == result.causal.stamp_ns == index * STEP_NS
        assert result.raw.status == result.causal.status == result.status
        assert result.raw.frame_id == result.causal.frame_id == result.stamp_ns
        assert result.n_keypoints >= result.n_points > 50
        assert set(result.stage_ms) == {"extract", "register", "links", "window", "loops"}
        assert not result.reason
    assert all(12 <= r.n_inliers <= r.n_matches <= r.n_points for r in results[1:])
    assert all(1 <= r.n_links <= 3 for r in results[1:])
    assert max(r.n_links for r in results) > 1


def test_covariances_are_positive_and_the_smoothed_ones_no_larger() -> None:
    results, smoothed = stereo_run()
    for estimate in [*(r.raw for r in results[1:]), *(r.causal for r in results), *smoothed]:
        assert np.linalg.eigvalsh(estimate.covariance)[0] > 0
    causal = np.array([np.trace(r.causal.covariance) for r in results])
    # Each is exact where its state was linearized, and later measurements move that point.
    assert np.all([np.trace(e.covariance) for e in smoothed] <= causal * (1 + 1e-3))


def same_estimates(first: Iterable[Estimate], second: Iterable[Estimate]) -> bool:
    return all(
        a.stamp_ns == b.stamp_ns
        and a.status == b.status
        and a.T_world_frame.tobytes() == b.T_world_frame.tobytes()
        and a.covariance.tobytes() == b.covariance.tobytes()
        for a, b in zip(first, second, strict=True)
    )


@pytest.mark.parametrize("threads", [1, 2])
def test_a_second_run_is_equal_bit_for_bit_whatever_the_threads(threads: int) -> None:
    results, smoothed = stereo_run()
    again, smoothed_again = run(map(stereo_frame, range(N_FRAMES)), configure(threads))
    assert same_estimates((r.raw for r in results), (r.raw for r in again))
    assert same_estimates((r.causal for r in results), (r.causal for r in again))
    assert same_estimates(smoothed, smoothed_again)


@pytest.mark.parametrize(
    "window",
    [
        {"size": 2, "n_keyframes": 0, "n_links": 1},
        {"size": 12, "n_keyframes": 8, "n_links": 6},
        {"kernel": "cauchy"},
    ],
)
def test_the_raw_chain_does_not_depend_on_the_window(window: dict[str, Any]) -> None:
    (results, _), (others, _) = (
        run(map(stereo_frame, range(N_FRAMES)), with_known_readout(each))
        for each in (configure(), configure(**window))
    )
    # Links tell how much of the stated covariances is true, but nothing of the poses.
    poses, of_others = (np.array([r.raw.T_world_frame for r in each]) for each in (results, others))
    np.testing.assert_array_equal(poses, of_others)
    assert not same_estimates((r.causal for r in results), (r.causal for r in others))


@pytest.mark.parametrize("size", [2, 5, 100])
def test_every_frame_is_finished_exactly_once(size: int) -> None:
    odometry = Odometry(CAMERA, configure(size=size, n_keyframes=2))
    finished: list[int] = []
    for index in range(10):
        result = odometry.track(stereo_frame(index))
        finished += [estimate.stamp_ns for estimate in result.finished]
        assert len(finished) >= index + 1 - size - 3
    finished += [estimate.stamp_ns for estimate in odometry.finish()]
    assert sorted(finished) == [index * STEP_NS for index in range(10)]
    assert not odometry.finish()


@pytest.mark.parametrize("back_ns", [0, 1, 2 * STEP_NS])
def test_stamps_that_go_back_are_misuse(back_ns: int) -> None:
    odometry = Odometry(CAMERA, configure())
    for index in range(3):
        odometry.track(stereo_frame(index))
    image = stereo_frame(3)
    stamp_ns = 2 * STEP_NS - back_ns
    with pytest.raises(ValueError, match=f"stamp {stamp_ns} is not after {2 * STEP_NS}"):
        odometry.track(StereoFrame(stamp_ns=stamp_ns, left=image.left, right=image.right))
    assert odometry.track(image).status == Status.OK


def halved(frame: Frame) -> Frame:
    if isinstance(frame, StereoFrame):
        return StereoFrame(stamp_ns=1, left=frame.left[::2, ::2], right=frame.right[::2, ::2])
    return RgbdFrame(stamp_ns=1, image=frame.image[::2, ::2], depth=frame.depth[::2, ::2])


@pytest.mark.parametrize("is_stereo", [True, False])
@pytest.mark.parametrize("kind", ["klt", "descriptor"])
def test_images_of_another_size_than_the_camera_s_are_refused(kind: str, is_stereo: bool) -> None:
    config = configure().model_copy(
        update={"frontend": FrontendConfig.model_validate({"kind": kind})}
    )
    odometry = Odometry(CAMERA if is_stereo else PINHOLE, config)
    frames = [(stereo_frame if is_stereo else rgbd_frame)(index) for index in range(3)]
    odometry.track(frames[0])
    with pytest.raises(ValueError, match="images are 160x100 pixels, the camera is 320x200"):
        odometry.track(halved(frames[1]))
    assert odometry.track(frames[2]).status == Status.OK
    assert len(odometry.finish()) == 2


def test_a_frame_of_another_sensor_is_refused() -> None:
    with pytest.raises(ValueError, match="StereoCamera: expected a StereoFrame, got RgbdFrame"):
        Odometry(CAMERA, configure()).track(rgbd_frame(0))
    with pytest.raises(ValueError, match="PinholeCamera: expected a RgbdFrame, got StereoFrame"):
        Odometry(PINHOLE, configure()).track(stereo_frame(0))


def test_a_front_end_of_one_s_own_judges_its_frames_itself() -> None:
    frontend = KltFrontend(CAMERA, configure())
    odometry = Odometry(replace(CAMERA, width=99), configure(), frontend=frontend)
    assert odometry.track(stereo_frame(0)).status == Status.OK


def with_blanks(blanks: Iterable[int], n: int) -> list[Frame]:
    chosen = set(blanks)
    return [blank(i) if i in chosen else stereo_frame(i) for i in range(n)]


def test_a_blank_image_is_coasted_over_without_a_jump() -> None:
    results, smoothed = run(with_blanks([6], 10), configure())
    statuses = [result.status for result in results]
    assert statuses == [Status.OK] * 6 + [Status.COASTING, Status.RESUMED, Status.OK, Status.OK]
    assert [bool(result.reason) for result in results] == [i == 6 for i in range(10)]
    assert [estimate.status for estimate in smoothed] == statuses
    for estimates in ([r.raw for r in results], [r.causal for r in results], smoothed):
        errors = position_errors(estimates)
        assert errors[6] < 0.08  # the motion of a step is 5 cm
        assert np.delete(errors, 6).max() < 0.05
    spread = [np.trace(result.causal.covariance) for result in results]
    assert spread[6] > 100 * spread[5]
    assert spread[7] < 0.1 * spread[6]


@pytest.mark.parametrize("n_keyframes", [0, 4])
def test_a_gap_longer_than_the_window_is_bridged(n_keyframes: int) -> None:
    config = configure(size=2, n_keyframes=n_keyframes, n_links=1)
    results, smoothed = run(with_blanks(range(4, 9), 12), config)
    statuses = [result.status for result in results]
    assert statuses == (
        [Status.OK] * 4 + [Status.COASTING] * 5 + [Status.RESUMED] + [Status.OK] * 2
    )
    assert len(smoothed) == 12
    for estimates in ([r.raw for r in results], [r.causal for r in results], smoothed):
        assert position_errors(estimates)[9:].max() < 0.06


def test_coasting_for_long_is_called_lost_until_it_resumes() -> None:
    results, _ = run(map(later, with_blanks(range(3, 8), 12)), configure())
    assert [result.status for result in results[3:]] == (
        [Status.COASTING] * 2 + [Status.LOST] * 4 + [Status.RESUMED] * 2 + [Status.OK]
    )
    # The light comes on where it went out: two frames see the place of the last registered one.
    assert [result.segment for result in results] == [0] * 9 + [1] + [0] * 2
    assert [len(result.joins) for result in results] == [0] * 10 + [1, 0]


def test_a_camera_that_turned_in_the_dark_is_found_again() -> None:
    turned = se3.exp(np.array([0.0, 0.4, 0.0, 0.2, 0.0, 0.0]))

    def pose(index: int) -> FloatArray:
        return np.asarray(true_pose(index) if index < 9 else turned @ true_pose(index))

    def frame(index: int) -> Frame:
        if 4 <= index < 9:
            return blank(index)
        to_right = np.eye(4)
        to_right[0, 3] = CAMERA.baseline
        images = [render(pose(index) @ T)[0] for T in (np.eye(4), to_right)]
        return StereoFrame(stamp_ns=index * STEP_NS, left=images[0], right=images[1])

    results, _ = run(map(later, map(frame, range(13))), configure())
    assert [len(result.joins) for result in results[:10]] == [0] * 10
    joined = [n for n, result in enumerate(results) if result.joins]
    assert joined
    assert joined[0] <= 11
    errors = [
        np.linalg.norm((result.causal.T_world_frame - pose(n))[:3, 3])
        for n, result in enumerate(results)
    ]
    assert errors[joined[0] - 1] > 0.1
    assert max(errors[joined[0] :]) < 0.08


def test_nothing_but_blank_images_gives_finite_poses() -> None:
    results, smoothed = run(with_blanks(range(8), 8), configure())
    assert [result.status for result in results[1:]] == [Status.COASTING] * 7
    assert len(smoothed) == 8
    for estimate in [*(r.raw for r in results), *(r.causal for r in results), *smoothed]:
        np.testing.assert_allclose(estimate.T_world_frame, np.eye(4), atol=1e-6)
        assert np.isfinite(estimate.covariance).all()


def test_blank_images_at_the_start_delay_the_odometry_alone() -> None:
    results, _ = run(with_blanks(range(3), 8), configure())
    assert [result.status for result in results[4:]] == [Status.RESUMED] + [Status.OK] * 3
    T_3 = np.linalg.inv(true_pose(3)) @ true_pose(7)
    moved = np.linalg.inv(results[3].raw.T_world_frame) @ results[7].raw.T_world_frame
    np.testing.assert_allclose(moved, T_3, atol=0.05)


def test_stamps_may_start_at_zero_or_before() -> None:
    frames = [
        StereoFrame(stamp_ns=-STEP_NS + index * STEP_NS, left=frame.left, right=frame.right)
        for index, frame in enumerate(map(stereo_frame, range(3)))
    ]
    results, _ = run(frames, configure())
    assert [result.status for result in results] == [Status.OK] * 3


@dataclass(frozen=True)
class Scan:
    """A frame of another sensor, at a known pose; None where it saw nothing."""

    stamp_ns: int
    T_world_scan: FloatArray | None


class ScanFrontend:
    """Registers scans by their poses, a little wrong; returns no more than it has to."""

    def __init__(self) -> None:
        self.pairs: list[tuple[int, int]] = []

    def extract(self, frame: Scan) -> Scan:
        return frame

    def register(
        self, reference: Scan, current: Scan, prior: MotionPrior | None
    ) -> RelativePose | Failure:
        self.pairs.append((reference.stamp_ns, current.stamp_ns))
        if reference.T_world_scan is None or current.T_world_scan is None:
            return Failure(reason="an empty scan")
        rng = np.random.default_rng([reference.stamp_ns, current.stamp_ns])
        T = se3.invert(reference.T_world_scan) @ current.T_world_scan
        noise = se3.exp(1e-3 * rng.normal(size=6))
        return RelativePose(T_reference_current=T @ noise, covariance=1e-6 * np.eye(6))


def scan_pose(index: int) -> FloatArray:
    return se3.exp(np.array([0.0, 0.02, 0.0, 0.3, 0.0, 0.0]) * index)


def run_scans(n: int, empty: int = -1) -> tuple[list[FrameResult], ScanFrontend]:
    frontend = ScanFrontend()
    config = Config.model_validate({"window": {"size": 3, "keyframe_distance_m": 1.0}})
    odometry = Odometry(config=config, frontend=frontend)
    scans = [Scan(i * STEP_NS, None if i == empty else scan_pose(i)) for i in range(n)]
    return [odometry.track(scan) for scan in scans], frontend


def test_a_front_end_of_ones_own_needs_no_camera_and_counts_nothing() -> None:
    results, _ = run_scans(20)
    assert [result.status for result in results] == [Status.OK] * 20
    for index, result in enumerate(results):
        for estimate in (result.raw, result.causal):
            np.testing.assert_allclose(estimate.T_world_frame, scan_pose(index), atol=0.03)
        assert (result.n_keypoints, result.n_points) == (0, 0)
        assert (result.n_matches, result.n_inliers) == (0, 0)


def test_its_keyframes_are_chosen_by_distance() -> None:
    results, frontend = run_scans(30)
    links = [(a, b) for a, b in frontend.pairs if b - a > STEP_NS]
    assert links
    # A keyframe every fourth scan, the first to be 1 m away; 0.3 m each.
    assert {a // STEP_NS for a, _ in links} <= set(range(0, 30, 4))
    assert max(b - a for a, b in links) > 10 * STEP_NS
    assert max(result.n_links for result in results) == 3


class CautiousFrontend(ScanFrontend):
    """States four times the variances of its errors, and learns of it where it is asked to."""

    def __init__(self, *, is_learning: bool) -> None:
        super().__init__()
        if is_learning:
            self.rig_offsets = RigOffsets(CAMERA, Config())

    def register(
        self, reference: Scan, current: Scan, prior: MotionPrior | None
    ) -> RelativePose | Failure:
        result = super().register(reference, current, prior)
        if isinstance(result, Failure):
            return result
        return replace(result, covariance=4.0 * result.covariance)


@pytest.mark.parametrize("empty", [-1, 70])
def test_covariances_shrink_to_what_loops_show_and_no_pose_moves(empty: int) -> None:
    config = Config.model_validate({"window": {"size": 3, "keyframe_distance_m": 1.0}})
    scans = [Scan(i * STEP_NS, None if i == empty else scan_pose(i)) for i in range(90)]
    runs, factors, values = [], [], [1.0, 1.0]
    for is_learning in (True, False):
        frontend = CautiousFrontend(is_learning=is_learning)
        odometry = Odometry(config=config, frontend=frontend)
        runs.append([odometry.track(scan) for scan in scans])
        factors.append(odometry.window.variance_factor)
        if is_learning:
            # A quarter is kept of what they are too wide, for errors that no loop shows.
            offsets = frontend.rig_offsets
            values = [offsets.chain_factor.value, offsets.window_factor.value]
            assert values[0] == pytest.approx(0.25 + 0.75 / 4.0, abs=0.12)
            # Edges of one frame differ by what their references did when they were given out, too.
            assert values[0] < values[1] < 2.0
    for learnt, stated in zip(*runs, strict=True):
        for kind in ("raw", "causal"):
            one, other = getattr(learnt, kind), getattr(stated, kind)
            np.testing.assert_array_equal(one.T_world_frame, other.T_world_frame)
    learnt, stated = (run[-1] for run in runs)
    # Where the chain was broken the window's rest on a guess, which is as uncertain as before.
    assert factors == [pytest.approx(values[1], rel=0.1) if empty < 0 else 1.0, 1.0]
    expected = factors[0] * stated.causal.covariance
    np.testing.assert_allclose(learnt.causal.covariance, expected, rtol=1e-9)
    if empty < 0:
        shares = np.diag(learnt.raw.covariance) / np.diag(stated.raw.covariance)
        assert np.all((shares > values[0]) & (shares < 0.95))


class OnceWrongFrontend(ScanFrontend):
    """Registers one pair of consecutive scans wrong by a metre and a half, and is sure of it."""

    def register(
        self, reference: Scan, current: Scan, prior: MotionPrior | None
    ) -> RelativePose | Failure:
        result = super().register(reference, current, prior)
        if isinstance(result, Failure) or self.pairs[-1] != (20 * STEP_NS, 21 * STEP_NS):
            return result
        wrong = result.T_reference_current @ se3.exp(np.array([0.0, 0.0, 0.0, 1.5, 0.0, 0.0]))
        return RelativePose(T_reference_current=wrong, covariance=result.covariance)


@pytest.mark.parametrize("step_m", [0.4, 0.8, 1.0, 1.2])
def test_keyframes_outvote_a_wrong_step_also_where_they_are_lost_soon(step_m: float) -> None:
    odometry = Odometry(frontend=OnceWrongFrontend())
    for index in range(40):
        T = se3.exp(np.array([0.0, 0.0, 0.0, step_m * index, 0.0, 0.0]))
        result = odometry.track(Scan(index * STEP_NS, T))
        error_m = np.linalg.norm(result.causal.T_world_frame[:3, 3] - T[:3, 3])
        assert error_m < 0.3  # what the chain drifts by
    assert np.linalg.norm(result.raw.T_world_frame[:3, 3] - T[:3, 3]) > 1.3


def test_an_empty_scan_is_coasted_over() -> None:
    results, _ = run_scans(12, empty=6)
    assert [r.status for r in results[5:8]] == [Status.OK, Status.COASTING, Status.RESUMED]
    assert results[6].reason == "an empty scan"
    np.testing.assert_allclose(results[11].raw.T_world_frame, scan_pose(11), atol=0.03)


def test_neither_camera_nor_front_end_is_misuse() -> None:
    with pytest.raises(ValueError, match="needs a camera, or a front-end"):
        Odometry()


def configure_klt(**window: Any) -> Config:
    values = configure(**window).model_dump()
    return Config.model_validate(values | {"frontend": {"kind": "klt"}})


@cache
def klt_run() -> tuple[list[FrameResult], list[Estimate]]:
    return run(map(stereo_frame, range(N_FRAMES)), configure_klt())


def test_tracks_follow_the_camera_more_closely_than_whole_pixels() -> None:
    results, smoothed = klt_run()
    descriptors, _ = stereo_run()
    assert all(result.status == Status.OK for result in results)
    for estimates in ([r.raw for r in results], [r.causal for r in results], smoothed):
        assert position_errors(estimates).max() < 0.02
    ours, theirs = (position_errors(r.raw for r in each) for each in (results, descriptors))
    assert np.mean(ours) < 0.7 * np.mean(theirs)
    # A track starts at a point of the frame before.
    for before, result in pairwise(results):
        assert 12 <= result.n_inliers <= result.n_matches <= before.n_points


def test_a_front_end_handed_in_gives_what_its_name_gives() -> None:
    config = configure_klt()
    odometry = Odometry(config=config, frontend=KltFrontend(CAMERA, config))
    again = [odometry.track(stereo_frame(index)) for index in range(6)]
    named = klt_run()[0][:6]
    assert same_estimates((r.raw for r in again), (r.raw for r in named))
    assert same_estimates((r.causal for r in again), (r.causal for r in named))


def depth_frame(stamp_ns: int, x_m: float, seed: int) -> RgbdFrame:
    """Return the view of a camera moved to the right and ahead, with a sensor's noise."""
    T = np.eye(4)
    T[:3, 3] = [x_m, 0.0, 0.5 * x_m]
    image, depth = render(T)
    grey = image + np.random.default_rng(seed).normal(scale=1.5, size=image.shape)
    return RgbdFrame(
        stamp_ns=stamp_ns, image=np.clip(np.rint(grey), 0, 255).astype(np.uint8), depth=depth
    )


def walk(positions_m: Iterable[float], config: Config) -> tuple[list[FrameResult], list[Estimate]]:
    frames = [depth_frame(i * STEP_NS, x, i) for i, x in enumerate(positions_m)]
    return run(frames, config, PINHOLE)


def path_length(estimates: Iterable[Estimate]) -> float:
    positions = np.array([estimate.T_world_frame[:3, 3] for estimate in estimates])
    return float(np.linalg.norm(np.diff(positions, axis=0), axis=1).sum())


def test_a_creeping_camera_is_not_frozen() -> None:
    steps = 0.005 * np.arange(33)
    _, smoothed = walk(steps, configure_klt())
    true_length = float(steps[-1] * np.hypot(1.0, 0.5))
    went = np.linalg.norm(smoothed[-1].T_world_frame[:3, 3])
    assert went == pytest.approx(true_length, rel=0.06)
    assert path_length(smoothed) > 0.98 * true_length  # noise lengthens a path
