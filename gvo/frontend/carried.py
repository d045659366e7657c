"""What rides with the camera: a bonnet, a frame, an arm. It stays in the image as the world moves.

It agrees with itself better than the world does, so that the camera would seem to be at rest. What
tells it from a world at rest in which a bus passes: it is near, and the motion of all the rest,
which is more of the view and of more relief, would move it; nothing farther stays that should not.
The cells of the image where that was seen are not used from then on. Their corners are watched:
where they stay in the next steps the cells around are tried as well, where they do not they are of
the world. No cell in which corners moved with the world is suspected again: it is at rest.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import cv2
import numpy as np

from gvo.config import RansacConfig
from gvo.frontend.tracking import Templates
from gvo.geometry.camera import StereoCamera
from gvo.geometry.correspondences import Correspondences
from gvo.geometry.ransac import find_inliers, ransac_rigid
from gvo.types import BoolArray, Failure, FloatArray, ImageArray, IntArray, RelativePose

if TYPE_CHECKING:
    from gvo.frontend.rig import Measurements

_N_COLUMNS = 32
# Largest displacement of what stays, smallest of what moves, and smallest distance of what stays
# from where the motion of the rest would have it, pixels.
_REST_PX, _MOVING_PX, _APART_PX = 0.3, 0.7, 1.0
# Tracks that ride, at least, and their share of those that stay though they should not. What the
# rest must have more of: the view, times the relief, disparities of nine tenths by one.
_MIN_TRACKS, _MIN_SHARE, _MIN_WORLD = 10, 0.8, 1.5
# Steps in favour of a cell: that count, at most; by which it is sure; that one against it undoes.
_MAX_VOTES, _SURE, _UNDONE = 6, 3, 2

_NOWHERE: FloatArray = np.zeros((0, 2))


class CarriedView:
    """Cells of the image that show what rides with the camera.

    Changes take effect with `advance`, as those of `RigOffsets`.

    Parameters
    ----------
    camera : StereoCamera

    Attributes
    ----------
    n_corners : int
        Corners that were not used so far.
    """

    def __init__(self, camera: StereoCamera) -> None:
        self._camera, self._cell_px = camera, camera.width / _N_COLUMNS
        n_cells = _N_COLUMNS * (int(camera.height / self._cell_px) + 1)
        # How many steps say that a cell rides with the camera; where corners moved with the world.
        self._votes, self._is_world = np.zeros(n_cells, np.int64), np.zeros(n_cells, np.bool_)
        self._next = self._votes, self._is_world
        self._riding = _NOWHERE  # where tracks of the last step ride with the camera
        self.n_corners = 0

    @property
    def share(self) -> float:
        """The share of the view that surely rides with the camera."""
        return float(np.mean(self._votes >= _SURE))

    def advance(self) -> None:
        """Apply what was noted since the last frame."""
        self._votes, self._is_world = self._next

    def holds(self, pixels: FloatArray) -> BoolArray:
        """Tell which pixels (n, 2) are not to be used."""
        if not self._votes.any():
            return np.zeros(len(pixels), np.bool_)
        return np.asarray(self._votes[self._cells(pixels)] > 0)

    def _cells(self, pixels: FloatArray) -> IntArray:
        u, v = (pixels[:, :2] / self._cell_px).astype(np.int64).T
        return np.asarray(v * _N_COLUMNS + np.minimum(u, _N_COLUMNS - 1))

    def drop(self, measured: Measurements, config: RansacConfig) -> Measurements:
        """Return the tracks of a step without those that ride with the camera."""
        rides = self._find(measured, config)
        self._riding = _NOWHERE if rides is None else measured.uvd[0][rides]
        if rides is None:
            return measured
        self.n_corners += len(self._riding)
        uvd = measured.uvd[0][~rides], measured.uvd[1][~rides]
        sigmas = measured.sigmas[0][~rides], measured.sigmas[1][~rides]
        return replace(measured, uvd=uvd, sigmas=sigmas, matches=measured.matches[~rides])

    def _find(self, measured: Measurements, config: RansacConfig) -> BoolArray | None:
        first, second = measured.uvd
        shifts_px = np.hypot(*(second - first)[:, :2].T)
        stays, moves = np.asarray(shifts_px < _REST_PX), np.flatnonzero(shifts_px > _MOVING_PX)
        if min(int(np.count_nonzero(stays)), len(moves)) < _MIN_TRACKS:
            return None
        cells = self._cells(first)
        rides: BoolArray = stays & ~self._is_world[cells]
        if np.count_nonzero(rides) < _MIN_TRACKS:
            return None
        tracks = Correspondences.of_pixels(measured.uvd, measured.sigmas, self._camera)
        rng = np.random.default_rng([abs(stamp_ns) for stamp_ns in measured.stamps_ns])
        found = ransac_rigid(tracks.select(moves), self._camera, config, weights=None, rng=rng)
        if isinstance(found, Failure) or 2 * np.count_nonzero(found.inliers) < len(moves):
            return None
        T, world = found.T_reference_current[np.newaxis], moves[found.inliers]
        config = config.model_copy(update={"inlier_threshold_px": _APART_PX})
        stays &= ~find_inliers(T, tracks, self._camera, config)[0]
        low, middle, high = np.quantile(first[world, 2], [0.1, 0.5, 0.9])
        rides &= stays & (first[:, 2] > middle)
        if np.count_nonzero(rides) < max(_MIN_TRACKS, _MIN_SHARE * np.count_nonzero(stays)):
            return None
        n_world, n_riding = (len(np.unique(cells[each])) for each in (world, rides))
        return rides if n_world * high > _MIN_WORLD * n_riding * low else None

    def note(self, result: RelativePose) -> None:
        """Take what a step shows."""
        votes, is_world = self._next = self._votes.copy(), self._is_world.copy()
        shifts_px = np.hypot(*(result.pixels_current - result.pixels_reference).T)
        moving = result.inliers & (shifts_px > _MOVING_PX)
        is_world[self._cells(result.pixels_reference[moving])] = True
        if len(self._riding):
            told = self._cells(self._riding)
            votes[told], is_world[told] = np.maximum(votes[told], 1), False

    def watch(self, images: tuple[ImageArray, ImageArray], corners: FloatArray) -> None:
        """Count the cells whose corners stay, of a step that moves the rest; those around are next.

        Parameters
        ----------
        images : tuple of two ndarrays of uint8, shape (height, width)
            Of both frames.
        corners : ndarray of float64, shape (n, 2)
            Those of the first frame that are not used, whole pixels.
        """
        votes, is_world = self._next
        patches, indices = Templates.of(images[0], corners), np.arange(len(corners))
        warps = np.tile(np.eye(2), (len(corners), 1, 1))
        ends, is_found = patches.align(images[1], indices, corners, warps)
        stays = is_found & (np.hypot(*(ends - corners).T) < _REST_PX)
        cells = self._cells(corners)
        n_staying = np.bincount(cells, np.where(stays, 1, -1), len(votes))[cells]
        votes[cells] = np.clip(votes[cells] + np.where(n_staying < 0, -_UNDONE, 1), 0, _MAX_VOTES)
        is_world[cells] = votes[cells] == 0
        sure = (votes >= _SURE).astype(np.uint8).reshape(-1, _N_COLUMNS)
        around = cv2.dilate(sure, np.ones((3, 3), np.uint8)).ravel() > 0
        votes[around & (votes == 0) & ~is_world] = 1
