"""Windows that walk straight on, and GTSAM made to fail."""

from __future__ import annotations

from collections.abc import Container, Iterable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import gtsam
import numpy as np
import pytest
from hypothesis import strategies as st

from gvo.backend.window import SlidingWindow
from gvo.config import WindowConfig
from gvo.geometry import se3
from gvo.types import Edge, Estimate, FloatArray, FrameId

seeds = st.integers(min_value=0, max_value=2**32 - 1)
STEP_NS = 100_000_000
STEP = se3.exp(np.array([0.02, 0.1, -0.01, 0.1, 0.0, 0.5]))


def edge(reference_id: FrameId, T: FloatArray, sigma: float = 0.01) -> Edge:
    return Edge(reference_id=reference_id, T_reference_frame=T, covariance=sigma**2 * np.eye(6))


def power(n: int) -> FloatArray:
    return se3.normalize(np.linalg.matrix_power(STEP, n))


def shifted(x: float = 0.0, y: float = 0.0, z: float = 0.0) -> FloatArray:
    return se3.make_transform(np.eye(3), np.array([x, y, z]))


def go_on(
    window: SlidingWindow, start: int, stop: int, step: FloatArray = STEP, sigma: float = 0.01
) -> list[Estimate]:
    return [
        window.add_pose(frame, frame * STEP_NS, [edge(frame - 1, step, sigma)] if frame else [])
        for frame in range(start, stop)
    ]


def walk(
    config: WindowConfig, n: int, step: FloatArray = STEP, sigma: float = 0.01
) -> SlidingWindow:
    window = SlidingWindow(config)
    go_on(window, 0, n, step, sigma)
    return window


@contextmanager
def failing(
    name: str, calls: Container[int] | None = None, error: type[BaseException] = RuntimeError
) -> Iterator[list[int]]:
    """Make a method of ISAM2 fail at these calls, or always; give the numbers of all calls."""
    original = getattr(gtsam.ISAM2, name)
    seen: list[int] = []

    def call(self: Any, *arguments: Any, **options: Any) -> Any:
        seen.append(len(seen))
        if calls is None or seen[-1] in calls:
            raise error("Indeterminant linear system detected\nand more lines")
        return original(self, *arguments, **options)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(gtsam.ISAM2, name, call)
        yield seen


def values_of(poses: Mapping[Any, Any] | Iterable[Any]) -> gtsam.Values:
    values = gtsam.Values()
    for key, pose in poses.items() if isinstance(poses, Mapping) else enumerate(poses):
        values.insert(key, gtsam.Pose3(pose))
    return values


def messages(caplog: pytest.LogCaptureFixture) -> list[str]:
    return [each.getMessage() for each in caplog.records if each.name.startswith("gvo")]


def number(frame_id: FrameId) -> int:
    assert isinstance(frame_id, int)
    return frame_id
