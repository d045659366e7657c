"""Streams of poses as edges: what is fused, what is left out, how sure the steps are."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gvo.errors import TrajectoryError
from gvo.geometry import se3
from gvo.io.edges.events import PoseEvent
from gvo.io.edges.pose_streams import (
    FusedChains,
    PoseStream,
    StepSigma,
    read_stream,
    step_covariance,
)
from gvo.trajectory.formats import (
    COVARIANCE_HEADER,
    format_covariance_line,
    write_tum,
)
from gvo.trajectory.trajectory import StampsFrom, Trajectory
from gvo.types import FloatArray, PosePrior

SECOND = 1_000_000_000
seeds = st.integers(0, 2**32 - 1)


def motion(seconds: float) -> FloatArray:
    """Return a pose that turns at a constant rate about y, moving along a circle."""
    return se3.exp(seconds * np.array([0.0, 0.3, 0.0, 0.0, 0.0, 1.0]))


def sampled(
    seconds: list[float], T_world: FloatArray | None = None, stamps_from: StampsFrom = "file"
) -> PoseStream:
    T = np.eye(4) if T_world is None else T_world
    poses = Trajectory(
        stamps_ns=np.array([round(s * SECOND) for s in seconds]),
        T_world_frame=np.stack([T @ motion(s) for s in seconds]),
        stamps_from=stamps_from,
    )
    covariances = np.full((len(seconds), 6, 6), np.nan)
    return PoseStream(name=stamps_from, poses=poses, covariances=covariances)


def fuse(*streams: PoseStream) -> tuple[list[PoseEvent], FusedChains]:
    source = FusedChains(streams, [StepSigma()] * len(streams))
    return [event for event in source.events() if isinstance(event, PoseEvent)], source


def test_one_stream_is_a_chain_in_its_own_world() -> None:
    stream = sampled([0.0, 0.1, 0.2, 0.5], se3.exp(np.arange(6.0)))
    events, source = fuse(stream)
    assert [len(event.edges) for event in events] == [0, 1, 1, 1]
    assert isinstance(events[0].prior, PosePrior)
    T = events[0].prior.T_world_frame
    for event, T_world in zip(events, stream.poses.T_world_frame, strict=True):
        for edge in event.edges:
            T = T @ edge.T_reference_frame
        np.testing.assert_allclose(T, T_world, atol=1e-12)
    assert not source.faults.warnings()


def test_another_stream_gives_edges_at_the_stamps_of_the_first_in_any_world() -> None:
    first = sampled([0.0, 0.1, 0.2, 0.3, 0.4])
    dense = sampled([0.005 * n for n in range(40, 200)], se3.exp(np.ones(6)))
    events, _ = fuse(first, dense)
    assert [len(event.edges) for event in events] == [0, 1, 1, 2, 2]
    for event in events[3:]:
        own, other = event.edges
        assert other.reference_id == own.reference_id
        # a circle between poses 5 ms apart is nearly straight
        np.testing.assert_allclose(other.T_reference_frame, own.T_reference_frame, atol=1e-5)


def test_nothing_is_interpolated_over_a_gap() -> None:
    first = sampled([0.1 * n for n in range(13)])
    gappy = sampled([0.1 * n + 0.01 for n in range(-1, 13) if not 4 <= n <= 9])
    events, _ = fuse(first, gappy)
    assert [len(event.edges) for event in events] == [0, 2, 2, 2, 1, 1, 1, 1, 1, 1, 1, 1, 2]


def test_an_input_without_a_common_stamp_is_told() -> None:
    _, source = fuse(sampled([0.0, 0.1]), sampled([5.0, 5.1]))
    (warning,) = source.faults.warnings()
    assert "give no edge" in warning


def test_stamped_and_bare_rows_do_not_mix() -> None:
    bare = sampled([0.0], stamps_from="rows")
    with pytest.raises(TrajectoryError, match=r"rows holds rows .* times\.txt"):
        FusedChains([sampled([0.0]), bare], [StepSigma()] * 2)


def random_covariance(rng: np.random.Generator) -> FloatArray:
    A = rng.normal(size=(6, 6))
    return np.asarray(A @ A.T + 0.1 * np.eye(6)) * 1e-3


@given(seeds)
def test_the_covariance_of_odometrys_step_is_the_growth(seed: int) -> None:
    rng = np.random.default_rng(seed)
    T_step = se3.exp(rng.normal(size=6))
    of_step = random_covariance(rng)
    C_a = random_covariance(rng)
    C_b = se3.compose_covariance(C_a, T_step, of_step)
    found = step_covariance(T_step, C_a, C_b, StepSigma())
    np.testing.assert_allclose(found, of_step, atol=1e-12)


@given(seeds)
def test_the_covariance_between_independent_fixes_is_that_of_samples(seed: int) -> None:
    rng = np.random.default_rng(seed)
    T_a, T_b = se3.exp(rng.normal(size=6)), se3.exp(rng.normal(size=6))
    C_a = random_covariance(rng)
    # smaller than before in every direction: no growth
    C_b = 1e-4 * C_a
    n = 4000
    d_a, d_b = (rng.multivariate_normal(np.zeros(6), 1e-6 * C, n) for C in (C_a, C_b))
    T_ab = se3.invert(T_a) @ T_b
    errors = se3.log(se3.invert(T_ab) @ se3.invert(T_a @ se3.exp(d_a)) @ (T_b @ se3.exp(d_b)))
    expected = 1e6 * np.cov(errors.T)
    C = step_covariance(T_ab, C_a, C_b, StepSigma())
    assert np.abs((C - expected) / np.sqrt(np.outer(np.diag(C), np.diag(C)))).max() < 0.15


@pytest.mark.parametrize("covariance", [np.zeros((6, 6)), np.full((6, 6), np.nan)])
def test_a_pose_without_covariance_has_the_stated_sigma(covariance: FloatArray) -> None:
    C = step_covariance(motion(1.0), covariance, covariance, StepSigma.fixed(0.1, 0.5))
    np.testing.assert_allclose(np.sqrt(np.diag(C)), [0.1] * 3 + [0.5] * 3)


def test_covariances_beside_a_file_are_taken(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    poses, covariances = [np.eye(4)], [1e-10 * np.eye(6)]
    steps = [random_covariance(rng) for _ in range(4)]
    for n, C in enumerate(steps):
        T_step = se3.invert(motion(n)) @ motion(n + 1)
        poses.append(poses[-1] @ T_step)
        covariances.append(se3.compose_covariance(covariances[-1], T_step, C))
    trajectory = Trajectory(
        stamps_ns=np.arange(5) * SECOND,
        T_world_frame=np.stack(poses),
        covariances=np.stack(covariances),
    )
    write_tum(tmp_path / "raw.txt", trajectory)
    rows = map(format_covariance_line, trajectory.stamps_ns.tolist(), covariances)
    (tmp_path / "raw_covariance.csv").write_text("\n".join([COVARIANCE_HEADER, *rows, ""]))
    source = FusedChains([read_stream(tmp_path / "raw.txt")], [StepSigma()])
    events = [event for event in source.events() if isinstance(event, PoseEvent)]
    for event, C in zip(events[1:], steps, strict=True):
        np.testing.assert_allclose(event.edges[0].covariance, C, atol=1e-8)
