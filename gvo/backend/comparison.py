"""The price of a window: the same measurements smoothed in a window, whole, and in a batch."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field

import gtsam

from gvo.backend.graph import PoseGraph
from gvo.backend.polish import polish
from gvo.errors import SmoothingError
from gvo.types import Estimate, FloatArray, FrameId


@dataclass(frozen=True, slots=True, kw_only=True)
class _Update:
    """One update of a window's graph."""

    factors: gtsam.NonlinearFactorGraph
    values: gtsam.Values
    leaving: Sequence[int]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Smoothing:
    """One way of smoothing, and what it came to.

    Parameters
    ----------
    name : str
        `window`, `full iSAM2` or `batch LM`.
    poses : dict of hashable to ndarray of float64, shape (4, 4)
        T_world_frame by frame.
    error : float
        Half the sum of the squared whitened residuals of all measurements (of their kernels'
        costs), as GTSAM counts it.
    elapsed_s : float
        Seconds for all updates, covariances apart.
    """

    name: str
    poses: dict[FrameId, FloatArray]
    error: float
    elapsed_s: float


@dataclass(slots=True)
class MeasurementLog:
    """All that went into a window's graph, so that it can be smoothed again in other ways.

    Unlike the window it keeps everything. Give it to `SlidingWindow`.
    """

    _updates: list[_Update] = field(default_factory=list)
    _keys: dict[FrameId, int] = field(default_factory=dict)

    def add(
        self,
        factors: gtsam.NonlinearFactorGraph,
        values: gtsam.Values,
        *,
        keys: dict[FrameId, int],
        leaving: Sequence[int] = (),
    ) -> None:
        """Take what one update added: factors, start values, the new frames and their keys."""
        self._updates.append(_Update(factors=factors, values=values, leaving=tuple(leaving)))
        self._keys |= keys

    def __len__(self) -> int:
        """Return the number of poses."""
        return len(self._keys)

    @property
    def is_windowed(self) -> bool:
        """Tell whether poses left: else the window is full smoothing itself."""
        return any(update.leaving for update in self._updates)

    def compare(self, smoothed: Sequence[Estimate]) -> list[Smoothing]:
        """Smooth everything again, as a whole and in a batch.

        Parameters
        ----------
        smoothed : sequence of Estimate
            What the window gave for all its poses.

        Returns
        -------
        list of Smoothing
            The window, if poses left it; iSAM2 without marginalization; Levenberg-Marquardt over
            all factors, started where iSAM2 ended.
        """
        factors = gtsam.NonlinearFactorGraph()
        for update in self._updates:
            factors.push_back(update.factors)
        graph, whole_s = self._replay_whole()
        whole = graph.values()
        start = time.perf_counter()
        optimum, _ = polish(factors, whole)
        batch_s = time.perf_counter() - start
        smoothings = [
            self._smoothing("full iSAM2", factors, whole, whole_s),
            self._smoothing("batch LM", factors, optimum, batch_s),
        ]
        if self.is_windowed:
            values, elapsed_s = self._values(smoothed, whole), self._replay_windowed()
            smoothings.insert(0, self._smoothing("window", factors, values, elapsed_s))
        return smoothings

    def _replay_windowed(self) -> float:
        """Do the window's updates again, and return how long they took."""
        graph, alive = PoseGraph(), dict[int, None]()
        start = time.perf_counter()
        for update in self._updates:
            new = update.values.keys()
            before = {key: graph.pose3(key) for key in update.factors.keyVector() if key in alive}
            before |= {key: update.values.atPose3(key) for key in new}
            graph.update(update.factors, update.values, alive=alive, leaving=update.leaving)
            alive |= dict.fromkeys(new)
            graph.settle(before, alive=alive, leaving=update.leaving)
            graph.marginalize(update.leaving)
            for key in update.leaving:
                del alive[key]
        return time.perf_counter() - start

    def _replay_whole(self) -> tuple[PoseGraph, float]:
        graph = PoseGraph(is_whole=True)
        start = time.perf_counter()
        for update in self._updates:
            try:
                with graph.restored_on_error():
                    graph.update(update.factors, update.values)
            except SmoothingError:
                graph = graph.hardened()
                graph.update(update.factors, update.values)
        return graph, time.perf_counter() - start

    def _values(self, smoothed: Sequence[Estimate], others: gtsam.Values) -> gtsam.Values:
        """Return the window's poses; those that it never held, as others have them."""
        values = gtsam.Values(others)
        for estimate in smoothed:
            if estimate.frame_id in self._keys:
                values.update(self._keys[estimate.frame_id], gtsam.Pose3(estimate.T_world_cam))
        return values

    def _smoothing(
        self,
        name: str,
        factors: gtsam.NonlinearFactorGraph,
        values: gtsam.Values,
        elapsed_s: float,
    ) -> Smoothing:
        return Smoothing(
            name=name,
            poses={frame_id: values.atPose3(key).matrix() for frame_id, key in self._keys.items()},
            error=float(factors.error(values)),
            elapsed_s=elapsed_s,
        )
