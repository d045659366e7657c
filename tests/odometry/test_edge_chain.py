"""The raw chain: first edges composed, whatever else is measured."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gvo.config import Config, WindowConfig
from gvo.geometry import se3
from gvo.io.edges.events import PoseEvent
from gvo.io.run_folder.writer import RunFolder
from gvo.odometry.chain import EdgeChain
from gvo.runs.smooth import POSES_HEADER, Smoother
from gvo.types import Edge, Estimate, FloatArray, PosePrior, Status
from tests.make.results import estimate_at

SECOND = 1_000_000_000


def causal(n: int, T: FloatArray | None = None) -> Estimate:
    """Return what the window says of pose n; of later poses the chain takes only the name."""
    return estimate_at(n * SECOND, T, covariance=1e-10 * np.eye(6), frame_id=n)


def edge(reference: int, T: FloatArray, sigma: float = 0.1) -> Edge:
    covariance = sigma**2 * np.eye(6)
    return Edge(reference_id=reference, T_reference_frame=T, covariance=covariance)


@given(st.integers(0, 2**32 - 1))
def test_the_chain_is_the_product_of_the_first_edges(seed: int) -> None:
    rng = np.random.default_rng(seed)
    chain = EdgeChain()
    T = [se3.exp(rng.normal(size=6))]
    chain.advance(causal(0, T[0]), [], None)
    for n in range(1, 8):
        reference = int(rng.integers(0, n))
        step, other = se3.exp(rng.normal(size=6)), se3.exp(rng.normal(size=6))
        T.append(T[reference] @ step)
        raw = chain.advance(causal(n), [edge(reference, step), edge(n - 1, other)], None)
        np.testing.assert_allclose(raw.T_world_frame, T[n], atol=1e-9)
        assert raw.status is Status.OK


def test_an_unusable_edge_is_passed_over() -> None:
    chain = EdgeChain()
    chain.advance(causal(0), [], None)
    step = se3.exp(np.array([0.0, 0.0, 0.1, 1.0, 0.0, 0.0]))
    edges = [edge(0, np.full((4, 4), np.nan)), edge(77, np.eye(4)), edge(0, step)]
    raw = chain.advance(causal(1), edges, None)
    np.testing.assert_allclose(raw.T_world_frame, step, atol=1e-12)


def test_without_an_edge_the_last_velocity_goes_on() -> None:
    chain = EdgeChain()
    chain.advance(causal(0), [], None)
    step = se3.exp(np.array([0.0, 0.0, 0.1, 1.0, 0.0, 0.0]))
    before = chain.advance(causal(1), [edge(0, step)], None)
    raw = chain.advance(causal(2), [], None)
    np.testing.assert_allclose(raw.T_world_frame, step @ step, atol=1e-9)
    assert raw.status is Status.COASTING
    assert np.all(np.linalg.eigvalsh(raw.covariance - before.covariance)[-3:] > 0.1)
    assert chain.advance(causal(3), [edge(2, step)], None).status is Status.RESUMED


def test_without_an_edge_a_known_pose_begins_the_chain_anew() -> None:
    chain = EdgeChain()
    chain.advance(causal(0), [], None)
    T = se3.exp(np.arange(6.0))
    raw = chain.advance(causal(1), [], PosePrior(T_world_frame=T, covariance=np.eye(6)))
    np.testing.assert_allclose(raw.T_world_frame, T)
    assert raw.status is Status.OK


def test_a_forgotten_pose_is_no_reference() -> None:
    chain = EdgeChain()
    for n in range(2):
        chain.advance(causal(n), [edge(0, np.eye(4))] if n else [], None)
    chain.forget([0])
    far = se3.exp(np.full(6, 1.0))
    assert chain.advance(causal(2), [edge(0, far)], None).status is Status.COASTING


def test_the_covariance_grows_along_the_chain() -> None:
    chain = EdgeChain()
    traces = []
    for n in range(5):
        edges = [edge(n - 1, np.eye(4))] if n else []
        traces.append(chain.advance(causal(n), edges, None).covariance.trace())
    np.testing.assert_allclose(np.diff(traces), 6 * 0.01, rtol=1e-9)


@pytest.mark.parametrize("size", [2, 5])
def test_nothing_but_the_window_is_kept_in_memory(tmp_path: Path, size: int) -> None:
    config = Config(window=WindowConfig(size=size))
    with RunFolder(tmp_path, columns=POSES_HEADER) as folder:
        smoother = Smoother(folder, config, keyframes="manual")
        for n in range(40):
            edges = (edge(n - 1, np.eye(4)),) if n else ()
            smoother.add_pose(PoseEvent(frame_id=n, stamp_ns=n * SECOND, edges=edges))
            assert len(smoother.chain) == len(smoother.window) <= size
        smoother.finish()
        assert len(smoother.chain) == 0
