"""Windows that walk straight on, and GTSAM made to fail."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import gtsam
import numpy as np
import pytest

from gvo.backend.window import SlidingWindow
from gvo.config import WindowConfig
from gvo.geometry import se3
from gvo.types import Edge, Estimate, FloatArray, FrameId

STEP_NS = 100_000_000
STEP = se3.exp(np.array([0.02, 0.1, -0.01, 0.1, 0.0, 0.5]))


def edge(reference_id: FrameId, T: FloatArray, sigma: float = 0.01) -> Edge:
    return Edge(reference_id=reference_id, T_reference_frame=T, covariance=sigma**2 * np.eye(6))


def power(n: int) -> FloatArray:
    return se3.normalize(np.linalg.matrix_power(STEP, n))


def walk(config: WindowConfig, n: int) -> SlidingWindow:
    """Return a window that was given n poses, each seen from the one before."""
    window = SlidingWindow(config)
    for frame in range(n):
        edges = [edge(frame - 1, STEP)] if frame else []
        window.add_pose(frame, frame * STEP_NS, edges)
    return window


def go_on(window: SlidingWindow, start: int, stop: int) -> list[Estimate]:
    """Add poses, each seen from the one before."""
    return [
        window.add_pose(frame, frame * STEP_NS, [edge(frame - 1, STEP)] if frame else [])
        for frame in range(start, stop)
    ]


@contextmanager
def failing_updates(*calls: int) -> Iterator[list[int]]:
    """Let updates of ISAM2 fail at these calls."""
    original = gtsam.ISAM2.update
    seen: list[int] = []

    def update(self: Any, *arguments: Any) -> Any:
        seen.append(len(seen))
        if seen[-1] in calls:
            raise RuntimeError("Indeterminant linear system detected\nand more lines")
        return original(self, *arguments)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(gtsam.ISAM2, "update", update)
        yield seen


@contextmanager
def giving_up(*names: str) -> Iterator[None]:
    """Let methods of ISAM2 fail."""

    def give_up(*_: Any) -> None:
        raise RuntimeError("Indeterminant linear system detected\nand more lines")

    with pytest.MonkeyPatch.context() as patch:
        for name in names:
            patch.setattr(gtsam.ISAM2, name, give_up)
        yield


def messages(caplog: pytest.LogCaptureFixture) -> list[str]:
    return [each.getMessage() for each in caplog.records if each.name.startswith("gvo")]
