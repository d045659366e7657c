"""A pose graph that is complete, optimized at once.

References
----------
D. Marquardt, "An algorithm for least-squares estimation of nonlinear parameters", SIAM J. 11(2),
1963, doi:10.1137/0111030.
L. Carlone et al., "Initialization techniques for 3D SLAM: a survey on rotation estimation and its
use in pose graph optimization", ICRA 2015, doi:10.1109/ICRA.2015.7139836 (chordal relaxation).
H. Yang et al., "Graduated non-convexity for robust spatial perception: from non-minimal solvers
to global outlier rejection", RA-L 5(2), 2020, doi:10.1109/LRA.2020.2965893.
"""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Callable, Iterator, Sequence, Set
from dataclasses import dataclass
from typing import Literal, NamedTuple

import gtsam
import numpy as np
from scipy.sparse import csc_array
from scipy.sparse.linalg import splu

from gvo.backend.factors import (
    ORIGIN,
    Factors,
    Measurement,
    check_places,
    definite,
    find_faults,
    first_line,
    prior_fault,
)
from gvo.config import WindowConfig
from gvo.errors import SmoothingError
from gvo.geometry import se3
from gvo.trajectory.trajectory import Trajectory
from gvo.types import Edge, FloatArray, FrameId, PosePrior, Rejected

_LOGGER = logging.getLogger(__name__)

Robust = Literal["none", "huber", "gnc"]

_TOLERANCE = 1e-10
_MAX_ITERATIONS = 200
# 99 % quantile of chi-square with six degrees of freedom: what an edge may have and be right.
INLIER_CHI2 = 16.812
# By which graduated non-convexity sharpens its cost, and how well each of its steps is solved.
_SHARPENING = 1.4
_MAX_SHARPENINGS = 200
_STEPS_EACH = 2
# Below this share of the largest pivot one is rounding.
_LEAST_PIVOT = 1e-15
# Covariances between two reports of progress.
_REPORTED = 20


@dataclass(frozen=True, slots=True, kw_only=True)
class BatchResult:
    """Errors before and after a batch optimization.

    Parameters
    ----------
    error_before, error_after : float
        Half the sum of the squared whitened residuals (of their kernels' costs), as GTSAM
        counts it.
    n_iterations : int
    """

    error_before: float
    error_after: float
    n_iterations: int

    def as_json(self) -> dict[str, float | int]:
        """Return the values under their names in `summary.json`."""
        return {
            "error_isam2": self.error_before,
            "error": self.error_after,
            "iterations": self.n_iterations,
        }


def optimize_batch(
    factors: gtsam.NonlinearFactorGraph, values: gtsam.Values
) -> tuple[gtsam.Values, BatchResult]:
    """Optimize by Levenberg-Marquardt until the error converges.

    Returns
    -------
    values : gtsam.Values
    result : BatchResult
    """
    error, n_iterations = float(factors.error(values)), 0
    before = error
    for values, error, _ in descend(factors, values):  # noqa: B007, B020 - the last ones count
        n_iterations += 1
    result = BatchResult(error_before=before, error_after=error, n_iterations=n_iterations)
    return values, result


def descend(
    factors: gtsam.NonlinearFactorGraph, values: gtsam.Values, *, n_steps: int = _MAX_ITERATIONS
) -> Iterator[tuple[gtsam.Values, float, bool]]:
    """Yield ever better values, their error, and whether it converged, by Levenberg-Marquardt."""
    solver = "MULTIFRONTAL_CHOLESKY"
    optimizer = _optimizer(factors, values, solver)
    error = optimizer.error()
    for _ in range(n_steps):
        try:
            optimizer.iterate()
        except RuntimeError:
            if solver == "MULTIFRONTAL_QR":
                raise
            # Sigmas too many orders of magnitude apart for Cholesky; QR takes five times as long.
            solver = "MULTIFRONTAL_QR"
            optimizer = _optimizer(factors, values, solver)
            continue
        values, before, error = optimizer.values(), error, optimizer.error()
        is_converged = not before - error > _TOLERANCE * before
        yield values, error, is_converged
        if is_converged:
            return


def _optimizer(
    factors: gtsam.NonlinearFactorGraph, values: gtsam.Values, solver: str
) -> gtsam.LevenbergMarquardtOptimizer:
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setLinearSolverType(solver)
    # a step is tried with more damping until it changes the error by less than this
    parameters.setRelativeErrorTol(_TOLERANCE)
    parameters.setAbsoluteErrorTol(0.0)
    return gtsam.LevenbergMarquardtOptimizer(factors, values, parameters)


class Link(NamedTuple):
    """An edge between two poses, given by their numbers in the graph."""

    reference: int
    frame: int
    edge: Edge


class WholeGraph:
    """The poses and edges of a graph, in any order.

    The world is that of the poses with a prior; where there is none, that of the first pose.

    Attributes
    ----------
    frame_ids : list of hashable
        In the order in which they were added.
    stamps_ns : list of int
        Nanoseconds.
    links : list of Link
        The edges that are valid.
    priors : dict of int to PosePrior
        By the number of the pose.
    given : dict of hashable to ndarray of float64, shape (4, 4)
        T_world_frame as first known, of any of the poses; the edges give that of the others.
    rejected : list of Rejected
        Edges and priors that are invalid.
    """

    def __init__(self) -> None:
        self.frame_ids: list[FrameId] = []
        self.stamps_ns: list[int] = []
        self.links: list[Link] = []
        self.priors: dict[int, PosePrior] = {}
        self.given: dict[FrameId, FloatArray] = {}
        self.rejected: list[Rejected] = []
        self._numbers: dict[FrameId, int] = {}
        self._trusted: list[int] = []

    def add_pose(self, frame_id: FrameId, stamp_ns: int, prior: PosePrior | None = None) -> None:
        """Add a pose, and where it is in the world, if that was measured."""
        self._numbers[frame_id] = len(self.frame_ids)
        self.frame_ids.append(frame_id)
        self.stamps_ns.append(stamp_ns)
        if prior is None:
            return
        if fault := prior_fault(prior):
            self.rejected.append(Rejected(frame_id=frame_id, stamp_ns=stamp_ns, reason=fault))
        else:
            self.priors[self._numbers[frame_id]] = prior

    def add_edges(
        self, frame_id: FrameId, edges: Sequence[Edge], *, is_trusted: bool = False
    ) -> None:
        """Add edges that measure a pose; their references are there already.

        Those that are said to be trusted are never refused.
        """
        frame = self._numbers[frame_id]
        for edge, fault in zip(edges, find_faults(edges), strict=True):
            reference = self._numbers.get(edge.reference_id)
            if reference is None or reference == frame:
                fault = (
                    "to itself" if reference == frame else "its reference is no pose of the graph"
                )
            if fault or reference is None:
                self.rejected.append(
                    Rejected(
                        frame_id=frame_id,
                        stamp_ns=self.stamps_ns[frame],
                        reason=fault,
                        reference_id=edge.reference_id,
                    )
                )
            else:
                if is_trusted:
                    self._trusted.append(len(self.links))
                self.links.append(Link(reference, frame, edge))

    def anchors(self) -> dict[int, PosePrior]:
        """Return the priors; that of an origin on the first pose, where there is none."""
        return self.priors or {0: ORIGIN}

    def trusted(self) -> list[int]:
        """Return the indices of the links that are trusted.

        If none was said to be, those of odometry: the first between a pose and the next. Poses
        follow each other by their ids where these are integers, else as they were added.
        """
        if self._trusted:
            return self._trusted
        ids, n = self.frame_ids, len(self.frame_ids)
        is_numbered = all(isinstance(frame_id, int | np.integer) for frame_id in ids)
        order = sorted(range(n), key=lambda k: ids[k] if is_numbered else k)  # type: ignore[arg-type, return-value]
        ranks = {number: rank for rank, number in enumerate(order)}
        found: dict[int, int] = {}
        for index, (reference, frame, _) in enumerate(self.links):
            a, b = ranks[reference], ranks[frame]
            if abs(a - b) == 1:
                found.setdefault(min(a, b), index)
        return list(found.values())

    def chained(self, trusted: Set[int]) -> dict[int, gtsam.Pose3]:
        """Return the poses that are connected with a prior, along as few other links as can be."""
        neighbours: list[list[tuple[int, gtsam.Pose3, bool]]] = [[] for _ in self.frame_ids]
        for index, (reference, frame, edge) in enumerate(self.links):
            T, is_first = gtsam.Pose3(edge.T_reference_frame), index in trusted
            neighbours[reference].append((frame, T, is_first))
            neighbours[frame].append((reference, T.inverse(), is_first))
        queue = deque((key, gtsam.Pose3(p.T_world_frame)) for key, p in self.anchors().items())
        poses: dict[int, gtsam.Pose3] = {}
        while queue:
            key, T_world_key = queue.popleft()
            if key in poses:
                continue
            poses[key] = T_world_key
            for other, T_key_other, is_first in neighbours[key]:
                if other not in poses:
                    add = queue.appendleft if is_first else queue.append
                    add((other, T_world_key.compose(T_key_other)))
        return poses


class BatchOptimizer:
    """Optimizes a graph by Levenberg-Marquardt, a step at a time.

    Begins at the best of three starts, by their errors: the given poses, those along the edges of
    odometry, and the chordal relaxation of the rotations.

    Parameters
    ----------
    graph : WholeGraph
        Poses that no edge connects with one that has a prior are left out.
    robust : {"none", "huber", "gnc"}
        Least squares; Huber's kernel on each edge; or graduated non-convexity: edges other than
        those of odometry count fully or not at all.
    start : {"best", "given"}
        The best of the three starts; or the given poses, which are known to be near the optimum.
    on_step : callable
        Called with the state in words after each step; may raise to end the work.

    Attributes
    ----------
    numbers : list of int
        Of the poses that are optimized.
    raw, values : gtsam.Values
        The poses along odometry, and the best so far.
    starts : dict of str to float
        Errors of the starts, by name; of "gnc" no edge counts more than what is refused.
    start : str
        Name of the one that was taken.
    error : float
        Of the poses so far.
    n_iterations : int
    is_converged : bool
    refused : list of Link
        Edges that graduated non-convexity leaves out.
    """

    def __init__(
        self,
        graph: WholeGraph,
        robust: Robust = "none",
        *,
        start: Literal["best", "given"] = "best",
        on_step: Callable[[str], None] = lambda _: None,
    ) -> None:
        self._on_step, self._is_graduated = on_step, robust == "gnc"
        self._make = Factors(WindowConfig(kernel="huber" if robust == "huber" else "none"))
        trusted = set(graph.trusted())
        chained = graph.chained(trusted)
        self.numbers = sorted(chained)
        self._stamps_ns = np.array([graph.stamps_ns[n] for n in self.numbers], dtype=np.int64)
        self._split(graph, trusted)
        self.raw, self.values = gtsam.Values(), gtsam.Values()
        for key in self.numbers:
            T = graph.given.get(graph.frame_ids[key])
            self.raw.insert(key, chained[key])
            self.values.insert(key, chained[key] if T is None else gtsam.Pose3(T))
        self.refused: list[Link] = []
        self.n_iterations, self.is_converged = 0, True
        self.starts: dict[str, float] = {}
        self._choose_start(is_given=bool(graph.given), is_only=start == "given")

    def _split(self, graph: WholeGraph, trusted: Set[int]) -> None:
        """Make the factors of the graph; those that may be refused apart from the others."""
        self._kept, self._doubted = gtsam.NonlinearFactorGraph(), list[Link]()
        self._edges = list[Edge]()  # those that are kept, after the priors
        for key, prior in graph.anchors().items():
            self._kept.add(self._make.prior(key, prior))
        there = set(self.numbers)
        for index, link in enumerate(graph.links):
            if link.frame not in there:
                continue
            if self._is_graduated and index not in trusted:
                self._doubted.append(link)
            else:
                measurement = Measurement.of(link.edge)
                self._kept.add(self._make.between(link.reference, link.frame, measurement))
                self._edges.append(link.edge)
        self._all = self._factors = self._weighted(np.ones(len(self._doubted)))

    def _weighted(self, weights: FloatArray) -> gtsam.NonlinearFactorGraph:
        """Return the graph in which the doubted edges have weights."""
        factors = gtsam.NonlinearFactorGraph(self._kept)
        for (reference, frame, edge), weight in zip(self._doubted, weights.tolist(), strict=True):
            if weight > 0.0:
                gaussian = gtsam.noiseModel.Gaussian.Covariance(edge.covariance / weight)
                T = gtsam.Pose3(edge.T_reference_frame)
                factors.add(gtsam.BetweenFactorPose3(reference, frame, T, gaussian))
        return factors

    def _chi2(self, values: gtsam.Values) -> FloatArray:
        """Return the chi-square of each doubted edge."""
        first = self._kept.size()
        doubted = range(first, first + len(self._doubted))
        return np.array([2.0 * self._all.at(index).error(values) for index in doubted])

    def _error_of(self, values: gtsam.Values) -> float:
        doubted = np.minimum(self._chi2(values), INLIER_CHI2).sum()
        return float(self._kept.error(values) + 0.5 * doubted)

    def _choose_start(self, *, is_given: bool, is_only: bool) -> None:
        starts = {"given": self.values} if is_given else {}
        if not is_only:
            starts["odometry"] = self.raw
            try:
                starts["chordal"] = gtsam.InitializePose3.initialize(self._factors)
            except RuntimeError:
                _LOGGER.debug("no chordal relaxation")
        self.starts = {name: self._error_of(values) for name, values in starts.items()}
        self.start = min(self.starts, key=self.starts.__getitem__)
        self.values, self.error = starts[self.start], self.starts[self.start]

    def run(self) -> None:
        """Optimize until the error converges.

        Raises
        ------
        SmoothingError
            If GTSAM fails, or poses diverge; the best poses so far stand.
        """
        try:
            if self._is_graduated and self._doubted:
                self._graduate()
            self.is_converged = self._descend(_MAX_ITERATIONS)
            check_places(self.poses()[:, :3, 3])
        except RuntimeError as error:
            raise SmoothingError(f"GTSAM: {first_line(error)}") from error

    def _descend(self, n_steps: int) -> bool:
        """Descend at most so many steps; tell whether the error has converged."""
        is_converged = False
        for step in descend(self._factors, self.values, n_steps=n_steps):
            self.values, self.error, is_converged = step
            self.n_iterations += 1
            self._on_step(f"iteration {self.n_iterations}: error {self.error:.6g}")
        return is_converged

    def _graduate(self) -> None:
        """Find out which of the doubted edges count, by a cost that becomes ever sharper."""
        c2, chi2 = INLIER_CHI2, self._chi2(self.values)
        mu = c2 / max(2.0 * float(chi2.max()) - c2, c2)
        for _ in range(_MAX_SHARPENINGS):
            # eq. (14): 1 below the lower limit, 0 beyond the upper one
            weights = np.sqrt(c2 * mu * (mu + 1.0) / np.maximum(chi2, _TOLERANCE)) - mu
            weights = np.where(chi2 >= (mu + 1.0) / mu * c2, 0.0, np.minimum(weights, 1.0))
            is_sharp = bool(np.isin(weights, (0.0, 1.0)).all())
            self._factors = self._weighted(weights)
            if is_sharp:
                break
            self._descend(_STEPS_EACH)
            chi2, mu = self._chi2(self.values), mu * _SHARPENING
        self._factors = self._weighted(np.round(weights))
        counted = zip(self._doubted, np.round(weights), strict=True)
        self.refused = [link for link, weight in counted if weight == 0.0]

    def trajectory(
        self, covariances: FloatArray | None = None, *, of: gtsam.Values | None = None
    ) -> Trajectory:
        """Return the poses, the best so far, or others, by their stamps."""
        order = np.argsort(self._stamps_ns)
        T_world_frame = as_transforms(self.values if of is None else of)
        return Trajectory(
            stamps_ns=self._stamps_ns[order],
            T_world_frame=T_world_frame[order],
            covariances=None if covariances is None else covariances[order],
        )

    def as_json(self) -> dict[str, object]:
        """Return the errors of the starts and of the optimum, for `summary.json`."""
        return {
            "start": self.start,
            "errors_of_starts": self.starts,
            "error": self.error,
            "iterations": self.n_iterations,
            "refused_edges": len(self.refused),
        }

    def poses(self) -> FloatArray:
        """Return T_world_frame of the poses by their numbers, shape (n, 4, 4), the best so far."""
        return as_transforms(self.values)

    def covariances(self) -> FloatArray:
        """Return the marginal covariances of the poses, shape (n, 6, 6).

        GTSAM refuses some graphs of stiff parts that are loosely joined, as by coasting frames;
        they are solved here.

        Raises
        ------
        SmoothingError
            If a pose is not determined by the edges that count.
        """
        found = []
        marginals: Callable[[int], FloatArray]
        try:
            try:
                marginals = gtsam.Marginals(self._factors, self.values).marginalCovariance
            except RuntimeError:
                marginals = sparse_marginals(self._factors.linearize(self.values))
            for key in self.numbers:
                found.append(definite(marginals(key)))
                if len(found) % _REPORTED == 0:
                    self._on_step(f"covariance {len(found)} of {len(self.numbers)}")
        except RuntimeError as error:
            raise SmoothingError(f"no covariances: {first_line(error)}") from error
        return np.array(found)

    def effects(self) -> FloatArray:
        """Return how errors that the edges share move the poses, (n, 6, k), by least squares.

        k is 1, and all is zero, where no edge tells of any. None of the edges is doubted.

        Raises
        ------
        SmoothingError
            If a pose is not determined by the edges.
        """
        told = [edge.effects for edge in self._edges if edge.effects is not None]
        if not told:
            return np.zeros((len(self.numbers), 6, 1))
        try:
            J, solve = _solver(self._kept.linearize(self.values))
        except RuntimeError as error:
            raise SmoothingError(f"no covariances: {first_line(error)}") from error
        pulls = np.zeros((J.shape[0], told[0].shape[1]))
        first = J.shape[0] - 6 * len(self._edges)
        for row, edge in zip(range(first, J.shape[0], 6), self._edges, strict=True):
            if edge.effects is not None:
                root = np.linalg.cholesky(np.linalg.inv(edge.covariance)).T
                pulls[row : row + 6] = root @ edge.effects
        return np.asarray(solve(J.T @ pulls)).reshape(len(self.numbers), 6, -1)


def _solver(
    graph: gtsam.GaussianFactorGraph,
) -> tuple[csc_array, Callable[[FloatArray], FloatArray]]:
    """Return the Jacobian, by keys in order, and what solves its normal equations.

    Raises
    ------
    RuntimeError
        If the poses are not determined.
    """
    rows, columns, values = graph.sparseJacobian_()
    places = np.array([rows, columns], dtype=int) - 1
    # Zeros are left out, so the column of the residuals may seem to be missing.
    shape = places[0].max() + 1, 6 * len(graph.keyVector()) + 1
    J = csc_array((values, tuple(places)), shape=shape)[:, :-1]
    solved = splu((J.T @ J).tocsc())
    pivots = np.abs(solved.U.diagonal())
    if pivots.min() < _LEAST_PIVOT * pivots.max():
        raise RuntimeError("a pose is not determined")
    return J, solved.solve


def sparse_marginals(graph: gtsam.GaussianFactorGraph) -> Callable[[int], FloatArray]:
    """Return what computes the marginal covariance of a pose by its key.

    Raises
    ------
    RuntimeError
        If the poses are not determined.
    """
    ranks = {key: rank for rank, key in enumerate(sorted(graph.keyVector()))}
    J, solve = _solver(graph)

    def marginal(key: int) -> FloatArray:
        block = 6 * ranks[key] + np.arange(6)
        unit = np.zeros((J.shape[1], 6))
        unit[block] = np.eye(6)
        return np.asarray(solve(unit)[block])

    return marginal


def as_transforms(values: gtsam.Values) -> FloatArray:
    """Return poses in the order of their keys, shape (n, 4, 4)."""
    rows = np.asarray(gtsam.utilities.extractPose3(values))
    return se3.make_transform(rows[:, :9].reshape(-1, 3, 3), rows[:, 9:])
