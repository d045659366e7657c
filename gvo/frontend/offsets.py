"""What is learnt of constants of a camera while it runs: its lens, its rows, its exposure."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from gvo.config import Config
from gvo.frontend.calibration import CONSIDERED, CalibrationErrors
from gvo.frontend.carried import CarriedView
from gvo.geometry.camera import StereoCamera
from gvo.geometry.refinement import Constants
from gvo.geometry.rig import DELAY, LENS, READOUT, ROWS, LearntRig
from gvo.kernels import lens as kernels
from gvo.types import FloatArray, IntArray

# Largest inflation of the sigmas of a registration by tracks: errors of near ones correlate.
KLT_SIGMA_FACTOR = 2.4
# By how many pixels what is seen anywhere in the image may be off: sigmas for each constant of the
# disparities, of the lens, and of the rows.
_DISPARITY_PRIOR_PX = 0.5
_LENS_PRIOR_PX = 1.0
_ROW_PRIOR_PX = 1.0
# Mean and sigma of the readout time of RGB-D cameras, whose shutters roll, and of stereo cameras,
# whose shutters hardly do, seconds.
_READOUT_RGBD_S = 0.02, 0.01
_READOUT_STEREO_S = 0.0, 0.01
# Of the delay of right images, and what is less counts as none: cameras that are triggered together
# differ by microseconds.
_DELAY_S = 0.0, 0.02
_LEAST_DELAY_S = 0.001
# A readout that may be longer than this, in seconds, is reckoned with.
_LEAST_READOUT_S = 0.005
# A readout is reckoned with once images have told of it: its sigma is so much smaller.
_TOLD = 0.8
# Errors of registrations are correlated (the same walls, the same lens): their sigmas are too small
# by this factor.
_FACTOR = 3.0
# What is not significant, in sigmas, is not taken off; nor errors, in pixels, root mean square over
# the image, that registrations do not tell from errors which all of them share.
_GATE = 4.0
_FEIGNED_PX = 0.05
# Frames over which what was learnt is forgotten: temperature, vibration.
_N_LASTING = 3000
# Share of what earlier runs told that counts: the same images must not count twice.
_KEPT = 0.25
# Sigma of the row of one corner, and beyond which it tells less, pixels; steps of that.
_ROW_SIGMA_PX = 0.5
_ROW_KERNEL_PX = 0.15
_N_ROW_STEPS = 3
# Corners whose rows are looked at in a frame, at least and at most.
_MIN_ROWS, _MAX_ROWS = 50, 120
# Misfits that a variance factor is averaged over; by how much one may be larger than their mean, or
# than ten, per degree of freedom; and the share of the variance that errors are taken to have which
# registrations of the same motion share.
_N_MISFITS = 30
_MAX_MISFIT = 10.0
_SHARED = 0.25


class ConstantFilter:
    """An information filter of constants, all of them together.

    Parameters
    ----------
    presumed : mapping of str to (float, float)
        Mean and standard deviation of each of the k constants.
    rig : LearntRig, optional
        What earlier runs learnt: means, where it has them, and some of its information.

    Attributes
    ----------
    mean : ndarray of float64, shape (k,)
        What was learnt.
    covariance : ndarray of float64, shape (k, k)
        Of that.
    sigmas : ndarray of float64, shape (k,)
        Those presumed.
    """

    def __init__(
        self, presumed: Mapping[str, tuple[float, float]], rig: LearntRig | None = None
    ) -> None:
        self.names = (*presumed,)
        self._known: dict[tuple[str, ...], tuple[IntArray, tuple[IntArray, ...]]] = {}
        self.mean, sigmas = np.reshape([*presumed.values()], (-1, 2)).T
        self._prior = self._presumed = np.diag(sigmas**-2)
        self._prior_vector = self._presumed_vector = self._prior @ self.mean
        self.sigmas = sigmas
        if rig is not None:
            values, information = rig.of(self.names)
            self._prior = self._presumed + _KEPT * information
            self._prior_vector = self._prior_vector + _KEPT * information @ values
        self._told, self._vector = np.zeros_like(self._prior), np.zeros_like(self.mean)
        self.advance()

    @property
    def told(self) -> FloatArray:
        """The information of images, shape (k, k), those of earlier runs with their share."""
        return self._prior + self._told - self._presumed

    @property
    def told_vector(self) -> FloatArray:
        """That information times the constants, shape (k,)."""
        return np.asarray(self._prior_vector - self._presumed_vector + self._vector)

    @property
    def learnt(self) -> dict[str, tuple[float, float]]:
        """Mean and standard deviation by name."""
        sigmas = np.sqrt(np.diag(self.covariance)).tolist()
        return dict(zip(self.names, zip(self.mean.tolist(), sigmas, strict=True), strict=True))

    def information(self, names: tuple[str, ...]) -> FloatArray:
        """Return the information (k, k) of some constants that share none with the others."""
        return np.asarray((self._prior + self._told)[self._places(names)[1]])

    def of(
        self, names: tuple[str, ...], *, absent: tuple[str, ...] = ()
    ) -> tuple[FloatArray, FloatArray]:
        """Return the means (k,) and the covariance (k, k) of some constants, others being zero."""
        (places, block), (zeros, _) = self._places(names), self._places(absent)
        if not absent:
            return self.mean[places], self.covariance[block]
        shared = self.covariance[np.ix_(places, zeros)]
        gain = shared @ np.linalg.inv(self.covariance[np.ix_(zeros, zeros)])
        return self.mean[places] - gain @ self.mean[zeros], self.covariance[block] - gain @ shared.T

    def one(self, name: str) -> tuple[float, float]:
        """Return mean and standard deviation of a constant."""
        (mean,), ((variance,),) = self.of((name,))
        return float(mean), math.sqrt(variance)

    def _places(self, names: tuple[str, ...]) -> tuple[IntArray, tuple[IntArray, ...]]:
        """Return where some constants are, and their block of a matrix."""
        if names not in self._known:
            places = np.array([self.names.index(name) for name in names], dtype=np.int64)
            self._known[names] = places, np.ix_(places, places)
        return self._known[names]

    def note(
        self,
        names: tuple[str, ...],
        information: FloatArray,
        score: FloatArray,
        used: FloatArray,
    ) -> None:
        """Take normal equations of what is left of some constants, after some were used."""
        places, block = self._places(names)
        self._told[block] += information / _FACTOR**2
        self._vector[places] += (information @ used + score) / _FACTOR**2

    def advance(self) -> None:
        """Solve for all that was noted, and forget a little of it."""
        self.covariance = np.asarray(np.linalg.inv(self._prior + self._told))
        self.mean = np.asarray(self.covariance @ (self._prior_vector + self._vector))
        self._told *= 1.0 - 1.0 / _N_LASTING
        self._vector *= 1.0 - 1.0 / _N_LASTING


class VarianceFactor:
    """By how much registrations' covariances are wrong, by how far those of one motion differ.

    A link to a keyframe and the steps since then measure the same motion. Where they differ by less
    than stated, errors of neighbouring tracks correlate less than `sigma_factor` assumes; by more,
    they correlate more. Errors that both share, they do not show: a part of what is stated always
    stays.

    Parameters
    ----------
    sigma_factor : float
        Inflation of the registrations' sigmas; no more than that is taken back.

    Attributes
    ----------
    value : float
        By which the stated covariances are to be multiplied.

    References
    ----------
    W. Förstner, "Ein Verfahren zur Schätzung von Varianz- und Kovarianzkomponenten", Allgemeine
    Vermessungs-Nachrichten 86, 1979 (the variance factor by misclosures).
    """

    def __init__(self, sigma_factor: float) -> None:
        self.value = 1.0
        self._least = min(sigma_factor**-2, 1.0)
        self._mean = 1.0

    def note(self, misfit: float) -> None:
        """Take by how much registrations differ: squared, in stated sigmas, per degree of freedom.

        What is not finite is unknown.
        """
        if not math.isfinite(misfit):
            return
        misfit = min(misfit, _MAX_MISFIT * max(self._mean, 1.0))
        self._mean += (misfit - self._mean) / _N_MISFITS
        self.value = max(_SHARED + (1.0 - _SHARED) * self._mean, self._least)


class RigOffsets:
    """What is learnt of a camera while it runs: its lens, its rows, its exposure.

    Measurements take effect with `advance`, so that all registrations of one frame use the same
    values.

    Parameters
    ----------
    camera : StereoCamera
        With what was learnt of it before, if anything.
    config : Config
        `stereo.estimate_offset`, else all that was learnt before stays as it is;
        `camera.readout_ms`, known or to be learnt.
    is_stereo : bool
        Of other sensors, whose depth is not that of their lens, the readout time alone is learnt.

    Attributes
    ----------
    lens : ndarray of float64, shape (11,)
        The constants `LENS` that are taken off pixels and disparities: what was learnt beyond a
        twentieth of a pixel. So much is feigned by patches that hold more than one surface.
    rows : ndarray of float64, shape (6,)
        The constants `ROWS` that are taken off rows of the right image.
    names : tuple of str
        The constants that registrations tell, in this order.
    delay_s : float
        By how much later the right image is exposed, seconds, as it is reckoned with.
    readout_s : float
        The readout time that is reckoned with, seconds: zero where it may be zero. A global
        shutter is not to be bent by what is left of the noise.
    readout : tuple of two float
        The readout time as learnt or given, seconds, and its standard deviation.
    possible_readout_s : float
        How long the readout may be, seconds: zero where it is known to take no time.
    waiting : list
        Links of the newest frame, which tell of the camera once the step after it is known.
    carried : CarriedView
        What rides with the camera, and is not used.
    calibration : CalibrationErrors
        Errors that all registrations share.
    zoom : dict of str to float
        The first stamp that has another focal length, `zoom_ns`, and its ratio, `zoom`.
    learns_lens : bool
        The lens is learnt, and corrected.
    chain_factor, window_factor : VarianceFactor
        Of the covariances of registrations where they are chained, and where they are smoothed:
        by loops of links and steps, and by the edges of one frame in the window.
    """

    def __init__(self, camera: StereoCamera, config: Config, *, is_stereo: bool = True) -> None:
        self._is_stereo, self._camera, self._rig = is_stereo, camera, camera.rig
        self.learns_lens = is_stereo and config.stereo.estimate_offset
        # What was learnt before is held where nothing is to be learnt.
        self._held = camera.rig if is_stereo and not self.learns_lens else None
        u, v = np.meshgrid(np.linspace(0, camera.width, 17), np.linspace(0, camera.height, 9))
        self._places = np.column_stack([u.ravel(), v.ravel(), np.zeros(u.size)])
        self.carried = CarriedView(camera)
        self._grid = self.lens_fields(self._places)
        # Means over the image of the products of two fields.
        self._products = np.einsum("jni,kni->jk", self._grid, self._grid) / len(self._places)
        self._readout_ms = config.camera.readout_ms
        self.lens, self.rows = np.zeros(len(LENS)), np.zeros(len(ROWS))
        self.delay_s, self.readout = 0.0, (1e-3 * (self._readout_ms or 0.0), 0.0)
        presumed = self._presume()
        self._filter = ConstantFilter(presumed, self._rig)
        self.names = tuple(name for name in presumed if name not in ROWS)
        # What is not learnt to be corrected tells how good the calibration is all the same.
        self._judged = self._filter
        if not self.learns_lens:
            self._judged = ConstantFilter(dict.fromkeys(CONSIDERED[:-1], (0.0, 1.0)))
            self.names += self._judged.names
        self.calibration = CalibrationErrors(
            camera, self._judged.names, in_pixels=not self.learns_lens
        )
        self._presumed_s = presumed.get(READOUT, (0.0, 0.0))[1]
        # What was significant is so with a share of its information.
        self._gate = _GATE * math.sqrt(1.0 if self._rig is None else _KEPT)
        self._n_frames = 0
        self.waiting: list[Any] = []
        self.zoom: dict[str, float] = {}
        if self._held is not None:
            self.lens, self.rows, (self.delay_s,) = (
                self._held.of(names)[0] for names in (LENS, ROWS, (DELAY,))
            )
            if self._readout_ms is None:
                self.readout = self._held.constants.get(READOUT, self.readout)
        self._sigma_factor = math.nan
        self.reconfigure(config)
        self._settle()

    def _presume(self) -> dict[str, tuple[float, float]]:
        """Return mean and sigma of all that is to be learnt."""
        presumed = {}
        if self.learns_lens:
            reach = np.linalg.norm(self._grid, axis=2).max(axis=1)
            for name, reach_px in zip(LENS, reach.tolist(), strict=True):
                prior_px = _DISPARITY_PRIOR_PX if name[0] == "d" else _LENS_PRIOR_PX
                presumed[name] = 0.0, prior_px / reach_px
            reach = np.abs(self._row_fields(self._places)).max(axis=1)
            for name, reach_px in zip(ROWS, reach.tolist(), strict=True):
                presumed[name] = 0.0, _ROW_PRIOR_PX / reach_px
            presumed[DELAY] = _DELAY_S
        if self._readout_ms is None and self._held is None:
            presumed[READOUT] = _READOUT_STEREO_S if self._is_stereo else _READOUT_RGBD_S
        return presumed

    @property
    def exposure(self) -> FloatArray:
        """The readout time and the delay of right images that are reckoned with, seconds."""
        return np.array([self.readout_s, self.delay_s])

    @property
    def learnt(self) -> LearntRig | None:
        """What was learnt, also by earlier runs; None where nothing is learnt."""
        if self._held is not None:
            return self._held
        if not self._filter.names:
            return None
        n_before = 0 if self._rig is None else self._rig.n_frames
        return LearntRig(
            constants=self._filter.learnt,
            information=self._filter.told,
            n_frames=n_before + self._n_frames,
        )

    def _settle(self) -> None:
        """Say what registrations take off, from now on."""
        if READOUT in self.names:
            self.readout = self._filter.one(READOUT)
        value, sigma = self.readout
        is_rolling = abs(value) > (self._gate if self._is_stereo else 1.0) * sigma
        is_rolling &= self._readout_ms is not None or sigma < _TOLD * self._presumed_s
        self.readout_s = value if is_rolling else 0.0
        is_possible = is_rolling or abs(value) + sigma > _LEAST_READOUT_S
        self.possible_readout_s = math.hypot(self.readout_s, sigma) if is_possible else 0.0
        if not self.learns_lens:
            return
        value, sigma = self._filter.one(DELAY)
        self.delay_s = value if abs(value) > max(self._gate * sigma, _LEAST_DELAY_S) else 0.0
        self.rows, _ = self._filter.of(ROWS)
        # Most pairs are exposed at once: where that is not sure to be otherwise, it is taken for
        # certain, and the lens is learnt the better.
        absent = () if self.delay_s else (DELAY,)
        constants, covariance = self._filter.of(LENS, absent=absent)
        size_px = math.sqrt(constants @ self._products @ constants)
        significance = math.sqrt(constants @ np.linalg.solve(covariance, constants))
        is_told = significance > self._gate and size_px > _FEIGNED_PX
        self.lens = (1.0 - _FEIGNED_PX / size_px) * constants if is_told else 0.0 * constants

    def reconfigure(self, config: Config) -> None:
        """Forget the variance factors where another front-end states other covariances."""
        # Matches of descriptors share a bias, and loops of them do: nothing is taken back there.
        sigma_factor = KLT_SIGMA_FACTOR if config.frontend.kind == "klt" else 1.0
        if sigma_factor != self._sigma_factor:
            self._sigma_factor = sigma_factor
            self.chain_factor, self.window_factor = map(VarianceFactor, [sigma_factor] * 2)

    def take_off(self, uvd: FloatArray) -> FloatArray:
        """Return measured (u, v, disparity), shape (n, 3), without the errors of the lens."""
        ideal = np.empty_like(uvd)
        kernels.take_off_all(uvd, self.lens, self._camera.parameters, ideal)
        return ideal

    def row_errors(self, pixels: FloatArray) -> FloatArray:
        """Return by how much rows of the right image are too large, pixels."""
        errors = np.empty((1, len(pixels)))
        parameters = self._camera.parameters
        kernels.write_row_errors(pixels, self.rows[np.newaxis], parameters, errors)
        return np.asarray(errors[0])

    def lens_fields(self, uvd: FloatArray) -> FloatArray:
        """Return the errors of (u, v, disparity) by a unit of each of `LENS`, shape (11, n, 3)."""
        fields = np.empty((len(LENS), len(uvd), 3))
        kernels.write_lens_fields(uvd, self._camera.parameters, fields)
        return fields

    def considered_fields(self, uvd: FloatArray) -> FloatArray:
        """Return the errors of (u, v, disparity) by a pixel of each of `CONSIDERED`, (9, n, 3)."""
        fields = np.empty((len(CONSIDERED), len(uvd), 3))
        kernels.write_considered(uvd, self._camera.parameters, fields)
        return fields

    def _row_fields(self, pixels: FloatArray) -> FloatArray:
        """Return the errors of rows by a unit of each of `ROWS`, shape (6, n)."""
        fields = np.empty((len(ROWS), len(pixels)))
        kernels.write_row_errors(pixels, np.eye(len(ROWS)), self._camera.parameters, fields)
        return fields

    def pixel_errors(self, places: FloatArray) -> FloatArray:
        """Return by how much pixels at places (n, 3) are off, (n, 2), as far as it matters.

        What a turn, another focal length or principal point explains hides in poses, or is not
        observable: k1 alone would show the focal length that it bends.
        """
        camera, errors = self._camera, places - self.take_off(places)
        x, y = (places[:, 0] - camera.cx) / camera.fx, (places[:, 1] - camera.cy) / camera.fy
        one, none = np.ones_like(x), np.zeros_like(x)
        along = np.column_stack([one, none, x, -y, 1.0 + x * x, x * y])
        across = np.column_stack([none, one, y, x, x * y, 1.0 + y * y])
        fields, wanted = np.concatenate([along, across]), errors[:, :2].T.ravel()
        left = wanted - fields @ np.linalg.lstsq(fields, wanted, rcond=None)[0]
        return np.asarray(left.reshape(2, -1).T)

    def note(self, told: Constants) -> None:
        """Take what a link tells of the constants, beside those that are taken off."""
        used = {DELAY: self.delay_s, READOUT: self.readout_s}
        used |= zip(LENS, self.lens.tolist(), strict=True)
        values = np.array([used.get(name, 0.0) for name in self.names])
        n = sum(name not in ROWS for name in self._filter.names)
        for each, part in ((self._filter, slice(n)), (self._judged, slice(n, None))):
            if names := self.names[part]:
                information, score = told.information[part, part], told.score[part]
                each.note(names, information, score, values[part])

    def note_rows(self, pixels: FloatArray, shifts_px: FloatArray) -> None:
        """Take by how much rows of the right image are larger at pixels (n, 2), as measured.

        NaN tells nothing. The constants are those of the least robust cost (Cauchy).
        """
        told = np.flatnonzero(np.isfinite(shifts_px))
        if not self.learns_lens or len(told) < _MIN_ROWS:
            return
        told = told[:: -(-len(told) // _MAX_ROWS)]
        fields = self._row_fields(pixels[told])
        left = shifts_px[told] - self.rows @ fields
        step: FloatArray = np.zeros(len(ROWS))
        known = self._filter.information(ROWS)
        for _ in range(_N_ROW_STEPS):
            weights = 1.0 / (1.0 + ((left - step @ fields) / _ROW_KERNEL_PX) ** 2)
            weighted = fields * weights / _ROW_SIGMA_PX**2
            information, score = weighted @ fields.T, weighted @ left
            step = np.asarray(np.linalg.solve(information + known, score))
        self._filter.note(ROWS, information, score, self.rows)

    def advance(self) -> None:
        """Apply what was noted since the last frame."""
        self._n_frames += 1
        self.carried.advance()
        self._filter.advance()
        self._settle()
        told, vector = self._judged.told, self._judged.told_vector
        is_corrected = bool(self.lens.any()) and self.learns_lens
        self.calibration.judge(told, vector, self._judged.sigmas, is_corrected=is_corrected)

    def as_json(self) -> dict[str, float]:
        """Return by how much what is seen anywhere is off, as taken off, and the exposure.

        Pixels less what no image tells, see `pixel_errors`. A readout with a sigma of 0 was given.
        Beside it, where there is something, how much of the view rides with the camera, and how
        many corners were not used for that; and since which stamp it is zoomed, by how much.
        """
        value, sigma = self.readout
        disparity = (self._places - self.take_off(self._places))[:, 2]
        pixels = self.pixel_errors(self._places)
        rows = self.row_errors(self._places)
        offsets = {
            "disparity_px": round(float(np.abs(disparity).max()), 4),
            "pixel_px": round(float(np.linalg.norm(pixels, axis=1).max()), 4),
            "row_px": round(float(np.abs(rows).max()), 4),
            "delay_ms": round(1e3 * self.delay_s, 2),
        }
        if self.learns_lens:
            offsets["calibration_left_px"] = round(self.calibration.left_px, 3)
        percent, n_carried = round(100.0 * self.carried.share, 1), self.carried.n_corners
        carried = {"carried_percent": percent, "carried_corners": n_carried} if n_carried else {}
        return (
            carried
            | self.zoom
            | (offsets if self._is_stereo else {})
            | {
                "calibration_px": round(self.calibration.size_px, 3),
                "readout_ms": round(1e3 * value, 2),
                "readout_sigma_ms": round(1e3 * sigma, 2),
            }
        )
