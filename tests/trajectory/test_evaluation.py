"""Errors of trajectories against the evo programs, KITTI's devkit and published figures."""

import itertools
import json
import os
import subprocess
import sys
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given

from gvo.errors import TrajectoryError
from gvo.geometry import se3
from gvo.io.run_folder.verdict import likely_causes
from gvo.trajectory.alignment import AlignMode, Similarity
from gvo.trajectory.evaluation import (
    Evaluation,
    evaluate,
    evaluations_json,
    relative_errors,
)
from gvo.trajectory.formats import read_trajectory, write_kitti, write_tum
from gvo.trajectory.trajectory import Trajectory
from tests.trajectory.paths import circle, seeds, straight

ALIGNED: tuple[AlignMode, ...] = ("se3", "sim3")


def drive(n: int, step_m: float = 1.0, *, seed: int = 0) -> Trajectory:
    """Return a winding drive along z at 10 Hz with steps of about equal length."""
    twists = np.random.default_rng(seed).normal(size=(n, 6)) * [0.01, 0.05, 0.01, 0.02, 0.02, 0.1]
    twists[:, 5] += step_m
    poses = [np.eye(4)]
    for step in se3.exp(twists[1:]):
        poses.append(poses[-1] @ step)
    return Trajectory(stamps_ns=10**18 + np.arange(n) * 100_000_000, T_world_frame=np.array(poses))


def disturbed(trajectory: Trajectory, *, seed: int = 1, sigma: float = 0.005) -> Trajectory:
    """Return the chain of the trajectory's steps, each with an error."""
    T = trajectory.T_world_frame
    twists = np.random.default_rng(seed).normal(size=(len(T), 6)) * sigma
    poses = [T[0]]
    for step, error in zip(se3.invert(T[:-1]) @ T[1:], se3.exp(twists[1:]), strict=True):
        poses.append(poses[-1] @ step @ error)
    return Trajectory(stamps_ns=trajectory.stamps_ns, T_world_frame=np.array(poses))


def measures(evaluation: Evaluation) -> list[float | None]:
    return [
        evaluation.ate_m,
        evaluation.rpe_m,
        evaluation.rpe_deg,
        evaluation.t_pct,
        evaluation.r_deg_per_100m,
    ]


def run_evo(folder: Path, *arguments: str | Path) -> dict[str, float]:
    """Return the statistics that an evo program computes, in full precision."""
    program = Path(sys.executable).parent / str(arguments[0])
    results = folder / "results.zip"
    results.unlink(missing_ok=True)
    subprocess.run(
        [program, *arguments[1:], "--save_results", results],
        check=True,
        capture_output=True,
        env={**os.environ, "HOME": str(folder)},
    )
    with zipfile.ZipFile(results) as archive:
        return dict(json.loads(archive.read("stats.json")))


def devkit_errors(
    T_ref: np.ndarray, T_est: np.ndarray, lengths: list[float], step: int
) -> tuple[float, float]:
    """Return the mean errors by the loops of KITTI's evaluate_odometry.cpp."""
    distances = [0.0]
    for before, after in itertools.pairwise(T_ref):
        distances.append(distances[-1] + float(np.linalg.norm(after[:3, 3] - before[:3, 3])))
    t_errors, r_errors = [], []
    for first in range(0, len(T_ref), step):
        for length in lengths:
            last = first
            while last < len(T_ref) and distances[last] <= distances[first] + length:
                last += 1
            if last == len(T_ref):
                continue
            delta_ref = np.linalg.inv(T_ref[first]) @ T_ref[last]
            delta_est = np.linalg.inv(T_est[first]) @ T_est[last]
            error = np.linalg.inv(delta_est) @ delta_ref
            cosine = np.clip(0.5 * (np.trace(error[:3, :3]) - 1.0), -1.0, 1.0)
            r_errors.append(float(np.arccos(cosine)) / length)
            t_errors.append(float(np.linalg.norm(error[:3, 3])) / length)
    return 100.0 * float(np.mean(t_errors)), 100.0 * float(np.rad2deg(np.mean(r_errors)))


@pytest.mark.parametrize(
    ("n", "step_m", "lengths", "step", "options"),
    [
        (150, 0.5, [20.0, 50.0], 1, {}),
        # KITTI's lengths where the path holds them, by its step from 200 m on
        (150, 1.0, [20.0, 50.0, 100.0], 1, {}),
        (260, 1.0, [100.0, 200.0], 10, {}),
        (700, 2.0, [100.0 * k for k in range(1, 9)], 10, {}),
        (150, 1.0, [30.0], 7, {"segments": [30.0], "segment_step": 7}),
        (40, 0.1, [0.5], 1, {"segments": [0.5]}),  # of a hand
    ],
)
def test_segment_errors_are_those_of_the_devkit(
    n: int, step_m: float, lengths: list[float], step: int, options: dict[str, Any]
) -> None:
    reference = drive(n, step_m)
    estimate = disturbed(reference)
    expected = devkit_errors(reference.T_world_frame, estimate.T_world_frame, lengths, step)
    evaluation = evaluate(reference, estimate, name="estimate", **options)
    assert (evaluation.t_pct, evaluation.r_deg_per_100m) == pytest.approx(expected, rel=1e-7)
    assert evaluation.segments_m == tuple(lengths)


@given(seeds)
def test_a_trajectory_has_no_error_against_itself_wherever_it_lies(seed: int) -> None:
    reference = drive(80, seed=seed)
    T = se3.exp(np.random.default_rng(seed).normal(size=6) * [1, 1, 1, 50, 50, 50])
    evaluation = evaluate(reference, Similarity(T_a_b=T).apply(reference), name="same")
    np.testing.assert_allclose(np.array(measures(evaluation), dtype=float), 0.0, atol=1e-5)
    assert (evaluation.n, evaluation.reference_share) == (80, 1.0)
    assert evaluation.path_ratio == pytest.approx(1.0)


def test_a_wrong_scale_is_measured_and_taken_out_by_sim3() -> None:
    reference = drive(300)
    T = reference.T_world_frame.copy()
    T[:, :3, 3] *= 1.02
    estimate = Trajectory(stamps_ns=reference.stamps_ns, T_world_frame=T)
    rigid = evaluate(reference, estimate, name="scaled")
    similar = evaluate(reference, estimate, name="scaled", align="sim3")
    assert rigid.path_ratio == similar.path_ratio == pytest.approx(1.02)
    assert rigid.ate_m > 0.1
    assert measures(similar) == pytest.approx([0.0] * 5, abs=1e-5)


def test_steps_that_are_too_long_give_their_share_on_a_straight_drive() -> None:
    evaluation = evaluate(straight(101, 1.0), straight(101, 1.01), name="e", align="origin")
    assert evaluation.rpe_m == pytest.approx(0.01)
    assert evaluation.rpe_deg == pytest.approx(0.0, abs=1e-9)
    # a segment of 20 m spans 21 steps, one of 50 m spans 51; 80 and 50 of them fit
    assert evaluation.n_segments == 130
    assert evaluation.t_pct == pytest.approx((80 * 21 / 20 + 50 * 51 / 50) / 130)
    np.testing.assert_allclose(evaluation.errors_m, np.arange(101) * 0.01, atol=1e-12)
    assert evaluation.ate_max_m == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("reference_m", "estimate_m", "ratio"),
    [
        (10.0, 0.0, 0.0),
        (2e-6, 1e-6, 0.5),
        (1e-6, 1e-6, None),  # a path of a micrometre is no motion
        (1.001e-6, 1.001e-6, 1.0),
    ],
)
def test_the_ratio_of_paths_needs_a_reference_that_moves(
    reference_m: float, estimate_m: float, ratio: float | None
) -> None:
    reference, estimate = straight(3, 0.5 * reference_m), straight(3, 0.5 * estimate_m)
    found = evaluate(reference, estimate, name="e", align="none")
    assert found.path_ratio == pytest.approx(ratio)


def test_what_cannot_be_measured_is_none() -> None:
    still = straight(3, 0.0)
    evaluation = evaluate(still, still, name="still", rpe_delta=3)
    assert measures(evaluation) == [0.0, None, None, None, None]
    assert (evaluation.path_ratio, evaluation.reference_share, evaluation.n_segments) == (
        None,
        1.0,
        0,
    )
    assert evaluate(straight(20, 1.0), straight(20, 1.0), name="short").t_pct is None


@pytest.mark.parametrize("align", ["none", "se3"])
def test_fewer_than_three_poses_in_common_measure_nothing(align: AlignMode) -> None:
    with pytest.raises(TrajectoryError, match=r"^few and .*: 2, expected at least 3$"):
        evaluate(straight(30, 1.0), straight(2, 1.0), name="few", align=align)
    assert evaluate(straight(30, 1.0), straight(3, 1.0), name="few", align=align).n == 3


def test_the_share_is_that_of_the_reference_that_the_estimate_reaches() -> None:
    reference = drive(101)
    half = reference.select(slice(25, 76, 2))
    evaluation = evaluate(reference, half, name="half")
    assert (evaluation.n, evaluation.reference_share) == (26, 0.5)
    np.testing.assert_array_equal(evaluation.reference.stamps_ns, half.stamps_ns)


def test_rotation_errors_are_of_the_rotation_since_the_first_pose() -> None:
    truth = circle(50)
    turned = truth.T_world_frame.copy()
    turned[25:] = turned[25:] @ se3.exp(np.array([0.0, 0.0, 0.1, 0.0, 0.0, 0.0]))
    estimate = Trajectory(stamps_ns=truth.stamps_ns, T_world_frame=turned)
    errors = evaluate(truth, estimate.moved(truth.T_world_frame[7]), name="a").errors_rad
    assert errors is not None
    np.testing.assert_allclose(errors, [0.0] * 25 + [0.1] * 25, atol=1e-6)


def test_wrong_use_is_refused() -> None:
    reference = drive(30)
    with pytest.raises(ValueError, match="delta must be at least 1"):
        evaluate(reference, reference, name="e", rpe_delta=0)
    with pytest.raises(ValueError, match="step and lengths must be positive"):
        evaluate(reference, reference, name="e", segment_step=0)
    for length in (0.0, -1.0, np.nan, np.inf):
        with pytest.raises(ValueError, match="step and lengths must be positive"):
            evaluate(reference, reference, name="e", segments=[length])


def test_stamps_may_differ_by_what_is_allowed_and_no_more() -> None:
    reference = drive(30)
    late = Trajectory(
        stamps_ns=reference.stamps_ns + 12_000_000, T_world_frame=reference.T_world_frame
    )
    with pytest.raises(TrajectoryError, match=r"^late and the reference share no stamps"):
        evaluate(reference, late, name="late")
    assert evaluate(reference, late, name="late", max_difference_ns=12_000_000).n == 30
    with pytest.raises(TrajectoryError, match="share no stamps"):
        evaluate(reference, late, name="late", max_difference_ns=11_999_999)


def test_pairs_as_far_apart_as_the_trajectory_is_long_are_none() -> None:
    for delta, n_pairs in ((1, 4), (4, 1), (5, 0), (9, 0)):
        errors, turns = relative_errors(straight(5, 1.0), straight(5, 1.1), delta=delta)
        np.testing.assert_allclose(errors, [0.1 * delta] * n_pairs, atol=1e-12)
        np.testing.assert_array_equal(turns, [0.0] * n_pairs)
    assert evaluate(straight(5, 1.0), straight(5, 1.1), name="e", rpe_delta=5).rpe_m is None


def test_ate_and_rpe_are_those_of_evo(tmp_path: Path) -> None:
    reference = drive(200)
    estimate = disturbed(reference)
    late = estimate.select(np.arange(5, 200, 3))
    late = Trajectory(stamps_ns=late.stamps_ns + 3_000_000, T_world_frame=late.T_world_frame)
    tum = tmp_path / "reference.txt", tmp_path / "estimate.txt"
    kitti = tmp_path / "reference_rows.txt", tmp_path / "estimate_rows.txt"
    write_tum(tum[0], reference)
    write_tum(tum[1], late)
    write_kitti(kitti[0], reference)
    write_kitti(kitti[1], estimate)
    rigid, scaled = (
        evaluate(*map(read_trajectory, tum), name="e", align=align) for align in ALIGNED
    )
    rows = evaluate(*map(read_trajectory, kitti), name="e", align="origin", rpe_delta=3)
    pairs = ["--align_origin", "-d", "3", "-u", "f", "--all_pairs"]
    programs: list[tuple[dict[str, float | None], list[str | Path]]] = [
        (
            {
                "rmse": rigid.ate_m,
                "mean": rigid.ate_mean_m,
                "median": rigid.ate_median_m,
                "std": rigid.ate_std_m,
                "max": rigid.ate_max_m,
            },
            ["evo_ape", "tum", *tum, "-a"],
        ),
        ({"rmse": scaled.rpe_m}, ["evo_rpe", "tum", *tum, "-as", "-d", "1", "-u", "f"]),
        ({"rmse": rows.ate_m}, ["evo_ape", "kitti", *kitti, "--align_origin"]),
        ({"rmse": rows.rpe_deg}, ["evo_rpe", "kitti", *kitti, *pairs, "-r", "angle_deg"]),
    ]
    for found, program in programs:
        stats = run_evo(tmp_path, *program)
        assert found == pytest.approx({key: stats[key] for key in found}, abs=1e-6)


@pytest.mark.parametrize(
    ("factor", "jump_m", "causes"),
    [
        (1.0, 0.0, []),
        (0.9, 0.0, ["the scale, the path is 0.9 times as long as the true one (is the baseline"]),
        (1.0, 3.0, ["a jump of 3 m at frame 100 (1000000010.000 s)"]),
        (4.0, 30.0, ["the scale, the path is 4.", "a jump of 1"]),
    ],
)
def test_the_likely_cause_of_errors_comes_first(
    factor: float, jump_m: float, causes: list[str]
) -> None:
    reference = drive(200)
    T = disturbed(reference, sigma=1e-4).T_world_frame.copy()
    T[100:, 0, 3] += jump_m
    T[:, :3, 3] *= factor
    estimate = Trajectory(stamps_ns=reference.stamps_ns, T_world_frame=T)
    row = json.loads(json.dumps(evaluations_json([evaluate(reference, estimate, name="")])))
    found = likely_causes(row["estimates"][0], sensor="stereo")
    assert [each[: len(start)] for each, start in zip(found, causes, strict=True)] == causes


@pytest.mark.recorded
@pytest.mark.parametrize(
    ("reference", "estimate", "expected"),
    [
        ("KITTI_00_gt", "KITTI_00_ORB", (1.303, 0.700, 0.253)),
        ("KITTI_00_gt", "KITTI_00_SPTAM", (3.74, 1.487, 0.558)),
        ("fr2_desk_groundtruth", "fr2_desk_ORB", (0.0081, None, None)),
    ],
)
def test_published_figures_are_met(
    gvo_data: Path,
    reference: str,
    estimate: str,
    expected: tuple[float, float | None, float | None],
) -> None:
    truth, result = (
        read_trajectory(gvo_data / "trajectories" / f"{name}.txt") for name in (reference, estimate)
    )
    evaluation = evaluate(truth, result, name=estimate)
    ate_m, t_pct, r_deg_per_100m = expected
    assert evaluation.ate_m == pytest.approx(ate_m, rel=3e-3)
    assert evaluation.t_pct == pytest.approx(t_pct, abs=5e-4)
    assert evaluation.r_deg_per_100m == pytest.approx(r_deg_per_100m, abs=5e-4)


def test_against_positions_the_place_is_measured_and_no_rotation() -> None:
    reference = drive(900)
    estimate = disturbed(reference)
    points = Trajectory.of_positions(reference.stamps_ns, reference.positions)
    unturned = Trajectory.of_positions(estimate.stamps_ns, estimate.positions)
    full = evaluate(reference, estimate, name="full")
    for bare in (evaluate(points, estimate, name="e"), evaluate(reference, unturned, name="e")):
        np.testing.assert_allclose(bare.errors_m, full.errors_m, atol=1e-9)
        assert measures(bare) == [pytest.approx(full.ate_m), None, None, None, None]
        assert (bare.n_segments, bare.reference_share, bare.path_ratio) == (0, 1.0, full.path_ratio)
