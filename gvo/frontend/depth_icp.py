"""Projective point-to-plane ICP of two depth images, and how far colour and depth agree.

Points of the reference, with their normals, are projected into the current depth image; what is
measured there should lie on their planes. Directions of motion that the planes leave open are left
as they were at the start, and their variance is that of ignorance.

The matches of a registration take their depths from pixels of the colour image. If depth belongs
elsewhere, all of them are wrong in the same way, and their covariance does not tell. The depth
images among themselves do not have this error.

References
----------
Y. Chen, G. Medioni, "Object modelling by registration of multiple range images", Image and Vision
Computing 10(3), 1992, doi:10.1016/0262-8856(92)90066-C (point to plane).
G. Blais, M. D. Levine, "Registering multiview range data to create 3D computer objects", IEEE TPAMI
17(8), 1995, doi:10.1109/34.400574 (matches by projection).
J. Zhang, M. Kaess, S. Singh, "On degeneracy of optimization-based state estimation problems",
ICRA 2016, doi:10.1109/ICRA.2016.7487211 (directions left open).
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from gvo.config import DepthConfig
from gvo.frontend.rgbd import grid_points
from gvo.geometry import se3
from gvo.geometry.camera import StereoCamera
from gvo.kernels import depth as kernels
from gvo.types import DepthArray, Failure, FloatArray, RelativePose, RgbdFrame

# Columns of the reduced depth image, of means over four pixels each.
_N_COLUMNS = 160
# Of each round, the largest residuals in sigmas, and one in how many points is enough.
_ROUNDS = (*((4.0, 4),) * 2, *((2.5, 4),) * 3, (2.5, 1))
_MIN_POINTS = 200
# Of what the best direction is told, this share may come from the noise of the normals.
_MIN_SHARE = 2e-3
# Neighbouring residuals have common errors: the information of one in so many counts.
_N_CORRELATED = 2.0
_MIN_SCALE = 0.1
# Sigma of a direction left open, relative to that of one told just enough.
_OPEN_SIGMAS = 100.0
# A colour and a depth image taken at one time; else the motion in between is another.
_MAX_DIFFERENCE_NS = 2_000_000


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DepthMap:
    """A reduced depth image.

    Parameters
    ----------
    inverse_depths : ndarray of float32, shape (h, w)
        Means of four pixels, 1/m; NaN where unknown or discontinuous.
    camera : ndarray of float64, shape (4,)
        fx, fy, cx, cy of the reduced image, pixels.
    points, normals : ndarray of float64, shape (n, 3)
        Points on smooth surfaces in the `cam` frame, metres, and unit normals.
    """

    inverse_depths: NDArray[np.float32]
    camera: FloatArray
    points: FloatArray
    normals: FloatArray

    @classmethod
    def of(cls, depth: DepthArray, camera: StereoCamera, config: DepthConfig) -> DepthMap:
        """Reduce a depth image of float32, shape (height, width), metres."""
        step = max(round(depth.shape[1] / (2 * _N_COLUMNS)), 1)
        height, width = (-(-n // step) // 2 for n in depth.shape)
        inverse = np.empty((height, width), dtype=np.float32)
        limits = config.min_depth_m, config.max_depth_m
        kernels.reduce_depth(np.ascontiguousarray(depth), step, *limits, inverse)
        reduced = 0.5 / step * camera.parameters[:4] - [0.0, 0.0, 0.25, 0.25]
        points, normals = np.empty((2, height * width // kernels.STRIDE + 1, 3))
        n = kernels.fit_surfaces(inverse, reduced, points, normals)
        return cls(inverse_depths=inverse, camera=reduced, points=points[:n], normals=normals[:n])


def align_depth_maps(
    reference: DepthMap, current: DepthMap, T_reference_current: FloatArray
) -> RelativePose | Failure:
    """Estimate the motion between two depth images, from a start value.

    Parameters
    ----------
    reference, current : DepthMap
    T_reference_current : ndarray of float64, shape (4, 4)
        Start value, right to a few degrees and centimetres.

    Returns
    -------
    RelativePose or Failure
        Directions of motion that the planes leave open are those of the start value, with a large
        variance.
    """
    T, H, g, squares = np.array(T_reference_current), np.empty((6, 6)), np.empty(6), np.empty(1)
    surfaces = reference.points, reference.normals, current.inverse_depths, current.camera
    for gate, every in _ROUNDS:
        n = kernels.linearize_planes(T, *surfaces, gate, every, H, g, squares)
        if n * every < _MIN_POINTS:
            return Failure(reason=f"{n} points of two depth images fit each other")
        inverse, open_inverse = _invert(H, reference)
        T = T @ se3.exp(inverse @ g)
    scale = max(math.sqrt(squares[0] / n), _MIN_SCALE)
    covariance = _N_CORRELATED * scale**2 * (inverse + open_inverse)
    return RelativePose(
        T_reference_current=se3.normalize(T), covariance=0.5 * (covariance + covariance.T)
    )


def _invert(H: FloatArray, reference: DepthMap) -> tuple[FloatArray, FloatArray]:
    """Return the inverse in the directions that are told, and the variance of the others.

    Rotations count as much as the translations of a point at the mean distance.
    """
    units = np.r_[np.full(3, 1.0 / max(float(np.mean(reference.points[:, 2])), 1e-3)), np.ones(3)]
    values, vectors = np.linalg.eigh(units[:, np.newaxis] * H * units)
    vectors = units[:, np.newaxis] * vectors
    floor = _MIN_SHARE * values[-1]
    is_open = values < 2.0 * floor
    # What the noise of the normals seems to tell is no information.
    gains = np.where(is_open, 0.0, 1.0 / np.maximum(values - floor, floor))
    losses = np.where(is_open, _OPEN_SIGMAS**2 / floor, 0.0)
    return (vectors * gains) @ vectors.T, (vectors * losses) @ vectors.T


class DepthImage:
    """The depth image of a frame, and what is prepared of it when it is needed.

    Parameters
    ----------
    frame : RgbdFrame
    camera : StereoCamera
        That the depth is registered to.
    config : DepthConfig
    """

    def __init__(self, frame: RgbdFrame, camera: StereoCamera, config: DepthConfig) -> None:
        self._frame, self._camera, self._config = frame, camera, config

    @cached_property
    def grid(self) -> FloatArray:
        """A grid of its points, see `grid_points`."""
        return grid_points(self._frame.depth, self._camera, self._config)

    @cached_property
    def reduced(self) -> DepthMap:
        """The reduced image that is aligned."""
        return DepthMap.of(self._frame.depth, self._camera, self._config)

    def align(self, current: DepthImage, T_reference_current: FloatArray) -> RelativePose | Failure:
        """Estimate the motion to a current frame by depth alone; as `align_depth_maps`.

        Fails where a depth image was not taken together with its colour image, or was repeated.
        """
        if not (_is_simultaneous(self._frame) and _is_simultaneous(current._frame)):
            return Failure(reason="colour and depth were not taken together")
        first, second = self.reduced, current.reduced
        if np.array_equal(first.inverse_depths, second.inverse_depths, equal_nan=True):
            return Failure(reason="the depth image is repeated")
        return align_depth_maps(first, second, T_reference_current)


def _is_simultaneous(frame: RgbdFrame) -> bool:
    depth_ns = frame.depth_stamp_ns
    return depth_ns is None or abs(depth_ns - frame.stamp_ns) <= _MAX_DIFFERENCE_NS


# Disagreements that are remembered, and those needed to judge.
_N_REMEMBERED, _N_NEEDED = 40, 10
# Frames from one sample to the next: as long as depth is believed or not judged yet, and where
# colour agrees.
_EVERY, _EVERY_AGREEING = 3, 21
# Median squared disagreement, relative to that of normal errors, above which depth is believed.
_CONTRADICTS = 16.0
# Of chi-square of 6 degrees of freedom.
_MEDIAN = 5.348


class DepthTrust:
    """Judges whether colour and depth contradict each other, and how wrong depth may be.

    Motions measured twice, by colour and by depth, differ by as much as the two covariances say.
    If they differ by more over the last frames, one of the two is wrong in a way of its own: then
    those of depth are worth a measurement, with their covariance scaled to the difference, as if
    both were to blame by as many of their sigmas.
    """

    def __init__(self) -> None:
        self._n_unmeasured = 0
        self._squares: deque[float] = deque(maxlen=_N_REMEMBERED)

    @property
    def variance_factor(self) -> float:
        """By how much covariances of motions are too small, by colour and by depth; 1: not."""
        if len(self._squares) < _N_NEEDED:
            return 1.0
        disagreement = float(np.median(self._squares)) / _MEDIAN
        return disagreement if disagreement > _CONTRADICTS else 1.0

    @property
    def is_on(self) -> bool:
        """Whether depth is worth edges of its own."""
        return self.variance_factor > 1.0

    def is_due(self) -> bool:
        """Tell, once for each frame, whether its depth is to be aligned."""
        self._n_unmeasured += 1
        agrees = len(self._squares) >= _N_NEEDED and not self.is_on
        if self._n_unmeasured < (_EVERY_AGREEING if agrees else _EVERY):
            return False
        self._n_unmeasured = 0
        return True

    def note(self, colour: RelativePose, depth: RelativePose) -> None:
        """Take a motion from a keyframe that was measured by both."""
        difference = se3.log(se3.invert(colour.T_reference_current) @ depth.T_reference_current)
        square = se3.mahalanobis(difference, colour.covariance + depth.covariance)
        self._squares.append(float(square))
