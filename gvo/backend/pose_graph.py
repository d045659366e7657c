"""A pose graph by integer keys in iSAM2: update, marginalize, restore.

References
----------
M. Kaess et al., "iSAM2: Incremental smoothing and mapping using the Bayes tree", IJRR 31(2),
2012, doi:10.1177/0278364911430419.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, TypeAlias

import gtsam
import numpy as np

from gvo.errors import SmoothingError
from gvo.geometry.se3 import is_definite
from gvo.types import FloatArray

# Radians and metres: if an update moves a pose by more than the first, it is repeated until the
# pose moves by less than the second.
_FAR = 0.02
_STILL = 1e-4
_MAX_STEPS = 10
# A call since the last copy of the graph, replayed to restore it: the function, its arguments, and
# the key of a pose whose estimate was asked for afterwards.
_Step: TypeAlias = tuple[Callable[..., object], tuple[Any, ...], int | None]
_UPDATE, _MARGINALIZE = gtsam.ISAM2.update, gtsam.ISAM2.marginalizeLeaves
# Number of steps between copies of the graph: at least the first, and one for so many poses of the
# second, so that copying costs an update the same at any size.
_N_REPLAYED = 16
_POSES_PER_STEP = 32
_MIN_EIGENVALUE = 1e-10
_MAX_ROUNDING = 1e-6


class PoseGraph:
    """Poses by integer keys, smoothed incrementally; old ones can be marginalized.

    Parameters
    ----------
    is_whole : bool
        Nothing will be marginalized, and the graph may grow large.
    is_hardened : bool
        Slower, but works with sigmas many orders of magnitude apart.
    """

    def __init__(self, *, is_whole: bool = False, is_hardened: bool = False) -> None:
        parameters = gtsam.ISAM2Params()
        self._is_whole, self.is_hardened = is_whole, is_hardened
        # QR takes three times as long. Cholesky calls the system indeterminate once the drift's
        # variance is 4096^2 times that of an edge.
        parameters.setFactorization("QR" if is_hardened else "CHOLESKY")
        if is_whole:
            # GTSAM's defaults, which trade accuracy for time: the batch optimization at the end
            # makes up for it.
            parameters.setRelinearizeThreshold(0.1)
            parameters.relinearizeSkip = 10
        else:
            parameters.setRelinearizeThreshold(0.001)
            parameters.relinearizeSkip = 1
            parameters.findUnusedFactorSlots = True
            # Propagate every change to the oldest pose: by default small ones are ignored, which
            # loses what smoothing gains with edges accurate to a tenth of a millimetre.
            parameters.setOptimizationParams(gtsam.ISAM2GaussNewtonParams(0.0))
        self._isam = gtsam.ISAM2(parameters)
        self._n_poses = 0
        self._saved: gtsam.ISAM2 | None = None
        self._done: list[_Step] = []
        self._is_guarded = False

    def hardened(self) -> PoseGraph:
        """Return a graph of the same factors that takes worse conditioned ones too."""
        return self._remade(self.values(), is_hardened=True)

    def moved(self, values: gtsam.Values) -> PoseGraph:
        """Return a graph of the same factors, linearized at other values."""
        return self._remade(values, is_hardened=self.is_hardened)

    def _remade(self, values: gtsam.Values, *, is_hardened: bool) -> PoseGraph:
        graph = PoseGraph(is_whole=self._is_whole, is_hardened=is_hardened)
        with graph.restored_on_error():
            graph.update(self.factors(), values)
        return graph

    @contextmanager
    def restored_on_error(self) -> Iterator[None]:
        """Restore the graph if an update inside the context fails or is interrupted.

        The time of a copy grows with the graph, so there is none before each update: the steps
        since the last copy are replayed.

        Raises
        ------
        SmoothingError
            In place of GTSAM's exceptions.
        """
        n_replayed = max(_N_REPLAYED, self._n_poses // _POSES_PER_STEP)
        if self._saved is None or len(self._done) >= n_replayed:
            self._saved, self._done = gtsam.ISAM2(self._isam), []
        before = self._saved, len(self._done), self._n_poses
        self._is_guarded = True
        try:
            yield
        except BaseException as error:
            self._restore(*before)
            if isinstance(error, RuntimeError | IndexError):
                raise SmoothingError(f"GTSAM: {first_line(error)}") from error
            raise
        finally:
            self._is_guarded = False

    def _restore(self, saved: gtsam.ISAM2, n_done: int, n_poses: int) -> None:
        del self._done[n_done:]
        isam = gtsam.ISAM2(saved)
        for function, arguments, key in self._done:
            function(isam, *arguments)
            if key is not None:
                isam.calculateEstimatePose3(key)
        self._isam, self._n_poses = isam, n_poses

    def _note(self, step: _Step) -> None:
        """Record a step for replay; outside of `restored_on_error` nothing is restored."""
        if self._is_guarded:
            self._done.append(step)
        else:
            self._saved = None

    def update(
        self,
        factors: gtsam.NonlinearFactorGraph,
        values: gtsam.Values,
        *,
        alive: Collection[int] = (),
        leaving: Sequence[int] = (),
    ) -> None:
        """Add factors and poses; make leaving poses ready to be marginalized.

        Parameters
        ----------
        factors : gtsam.NonlinearFactorGraph
        values : gtsam.Values
            Start values of new poses, which the factors tie.
        alive : collection of int
            All keys in the graph; needed if some are leaving.
        leaving : sequence of int
            Keys to eliminate first, each in a group of its own, so that they become leaves of
            the Bayes tree: only these can be marginalized.
        """
        constraints = self._constraints(factors, alive, leaving) if leaving else ()
        self._isam.update(factors, values, *constraints)
        self._n_poses += values.size()
        # Asking a whole graph for estimates propagates small changes.
        key = next(iter(factors.keyVector()), None) if self._is_whole else None
        self._note((_UPDATE, (factors, values, *constraints), key))

    def _constraints(
        self, factors: gtsam.NonlinearFactorGraph, alive: Collection[int], leaving: Sequence[int]
    ) -> tuple[Any, ...]:
        """Return the arguments that make leaving poses leaves of the Bayes tree."""
        n_leaving = len(leaving)
        groups = dict.fromkeys(alive, n_leaving)
        # The poses that the factors constrain come last: their covariances are cheap then, and
        # the next pose usually has edges to the same ones.
        groups |= dict.fromkeys(factors.keyVector(), n_leaving + 1)
        groups |= {key: group for group, key in enumerate(leaving)}
        constrained, reeliminate = gtsam.KeyGroupMap(), gtsam.KeyList()
        for key, group in groups.items():
            constrained.insert2(key, group)
        for key in alive:
            reeliminate.push_back(key)
        return [], constrained, None, reeliminate, False

    def iterate(
        self,
        before: Mapping[int, gtsam.Pose3],
        starts: Mapping[int, gtsam.Pose3],
        *,
        alive: Collection[int] = (),
        leaving: Sequence[int] = (),
    ) -> bool:
        """Repeat the last update until poses converge, if it moved them far.

        One step of Gauss-Newton is exact only for motions by a fraction of a radian; closing a
        loop takes a few. A whole graph is left to the batch optimization at its end.

        Parameters
        ----------
        before : mapping of int to gtsam.Pose3
            Poses before the update, of the keys concerned.
        starts : mapping of int to gtsam.Pose3
            Start values of new poses.
        alive, leaving
            As for the update.

        Returns
        -------
        bool
            Whether the poses may have moved far.
        """
        if self._is_whole:
            return True
        poses = {**before, **starts}
        if _converged(poses, self.poses3(poses), _FAR):
            return False
        self._settle(poses, alive, leaving)
        return True

    def _settle(self, keys: Iterable[int], alive: Collection[int], leaving: Sequence[int]) -> None:
        """Repeat the last update until poses converge."""
        after = self.poses3(keys)
        for _ in range(_MAX_STEPS):
            nothing, before = (gtsam.NonlinearFactorGraph(), gtsam.Values()), after
            self.update(*nothing, alive=alive, leaving=leaving)
            after = self.poses3(keys)
            if _converged(before, after, _STILL):
                break

    def marginalize(self, keys: Sequence[int]) -> None:
        """Marginalize poses that the last update made leaves."""
        for key in keys:
            leaf = gtsam.KeyList()
            leaf.push_back(key)
            self._isam.marginalizeLeaves(leaf)
            self._n_poses -= 1
            self._note((_MARGINALIZE, (leaf,), None))

    def pose3(self, key: int) -> gtsam.Pose3:
        """Return T_world_frame as GTSAM holds it."""
        return self._isam.calculateEstimatePose3(key)

    def poses3(self, keys: Iterable[int]) -> dict[int, gtsam.Pose3]:
        """Return T_world_frame of each."""
        return {key: self.pose3(key) for key in keys}

    def pose(self, key: int) -> FloatArray:
        """Return T_world_frame, shape (4, 4)."""
        return np.asarray(self.pose3(key).matrix())

    def covariance(self, key: int) -> FloatArray:
        """Return the marginal covariance of a pose, shape (6, 6), symmetric positive definite."""
        return definite(self._isam.marginalCovariance(key))

    def joint_covariance(self, first: int, second: int) -> FloatArray:
        """Return the joint covariance of two poses, shape (12, 12), in the order asked for."""
        return np.asarray(self._isam.jointMarginalCovariance([first, second]).fullMatrix())

    def positions(self) -> FloatArray:
        """Return the positions of all poses in the world, shape (n, 3), metres."""
        return np.asarray(gtsam.utilities.extractPose3(self.values())[:, 9:])

    def factors(self) -> gtsam.NonlinearFactorGraph:
        """Return all factors, marginals among them."""
        return self._isam.getFactorsUnsafe()

    def values(self) -> gtsam.Values:
        """Return all poses."""
        return self._isam.calculateEstimate()


def _converged(
    before: Mapping[int, gtsam.Pose3], after: Mapping[int, gtsam.Pose3], limit: float
) -> bool:
    """Tell whether each element of the twists between poses before and after is below a limit."""
    # If no element of the transforms differs by more than 0.4 of the limit, no twist exceeds it:
    # an angle is at most 3 / sqrt(2), a distance sqrt(3) times the largest difference.
    if all(before[key].equals(after[key], 0.4 * limit) for key in before):
        return True
    moves = [before[key].localCoordinates(after[key]).tolist() for key in before]
    return bool(max(max(map(abs, move)) for move in moves) < limit)


def first_line(error: BaseException) -> str:
    """Return the first line of an error message, or the name of its type."""
    return (str(error).strip() or type(error).__name__).splitlines()[0]


def definite(covariance: FloatArray) -> FloatArray:
    """Return the covariance, symmetric positive definite in spite of rounding.

    With sigmas many orders of magnitude apart, rounding may leave the smallest eigenvalue of the
    correlations at or below zero.
    """
    symmetric = _symmetric(covariance)
    return symmetric if is_definite(symmetric) else _repaired(symmetric)


def _symmetric(covariance: FloatArray) -> FloatArray:
    symmetric = 0.5 * (covariance + covariance.T)
    if not math.isfinite(np.add.reduce(symmetric, axis=None)):
        raise SmoothingError("GTSAM: a covariance is not finite")
    return np.asarray(symmetric)


def _repaired(symmetric: FloatArray) -> FloatArray:
    """Clip the eigenvalues of the correlations that rounding made too small."""
    variances = np.diag(symmetric)
    if variances.min() <= 0.0:
        raise SmoothingError("GTSAM: a variance is not positive")
    scale = np.outer(np.sqrt(variances), np.sqrt(variances))
    eigenvalues, vectors = np.linalg.eigh(symmetric / scale)
    if eigenvalues[0] < -_MAX_ROUNDING:
        raise SmoothingError("GTSAM: a covariance is not positive definite")
    clipped = np.maximum(eigenvalues, _MIN_EIGENVALUE)
    repaired = (vectors * clipped) @ vectors.T * scale
    return np.asarray(0.5 * (repaired + repaired.T))
