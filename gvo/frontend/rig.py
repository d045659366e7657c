"""Registration by a camera whose constants are learnt: lens, rows, and when pixels are exposed.

What a calibration leaves changes smoothly over the image: points near and far, and at either side
of the view, disagree about the motion. A rolling shutter exposes the rows of an image one after the
other, which bends the world of a camera that moves; a right image that is exposed later bends its
depth. Links to keyframes tell of all three; what they tell is held by `gvo.frontend.offsets`.

References
----------
J. Hedborg, P.-E. Forssen, M. Felsberg, E. Ringaby, "Rolling shutter bundle adjustment", CVPR 2012,
doi:10.1109/CVPR.2012.6247831.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from gvo.config import Config
from gvo.frontend.calibration import CONSIDERED
from gvo.frontend.offsets import RigOffsets
from gvo.frontend.registration import check_rows, estimate_roughly, register_correspondences
from gvo.frontend.zoom import HARDEST_MPS2, LONGEST_S, find_zoom
from gvo.geometry import se3
from gvo.geometry.camera import StereoCamera
from gvo.geometry.correspondences import Correspondences
from gvo.geometry.ransac import find_inliers
from gvo.geometry.refinement import Adjustment, adjust, eliminate_pose
from gvo.geometry.residuals import StereoResiduals
from gvo.geometry.rig import DELAY, LENS, READOUT
from gvo.kernels import shutter
from gvo.types import (
    Failure,
    FloatArray,
    IntArray,
    MotionPrior,
    RelativePose,
)

# What registrations are told to doubt besides.
_VELOCITIES = tuple(f"velocity{axis}" for axis in range(6))
# Change of the newest frame's velocity, relative to the last step, where that before is unknown;
# the smallest sigma along an axis, rad/s and m/s; and that of its shift, relative to how much this
# changed: most of that is noise of the steps.
_FIRST_CHANGE = 0.2
_LEAST_CHANGE = 0.01
_SHIFT_SHARE = 0.3
# Gauss-Newton steps of a velocity that is measured.
_N_ITERATIONS = 3
# A velocity that is not known bends nothing.
_AT_REST = np.zeros(6)
# Stamps nearer to each other than this, in seconds, tell no velocity.
_MIN_ELAPSED_S = 1e-4


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MeasuredVelocity:
    """What the rows of the newest frame tell of its velocity, beside the step that leads to it.

    Parameters
    ----------
    extrapolated : ndarray of float64, shape (6,)
        The velocity as it was before: a twist per second (rad/s, m/s), right of the pose.
    sigmas : ndarray of float64, shape (6,)
        Of that, rad/s and m/s.
    found : Adjustment
        The step, and by how much the velocity differs from that, in these sigmas.
    """

    extrapolated: FloatArray
    sigmas: FloatArray
    found: Adjustment

    @property
    def velocity(self) -> FloatArray:
        """The velocity as measured, shape (6,)."""
        return self.extrapolated + self.sigmas * self.found.values


@dataclass(slots=True, kw_only=True, eq=False)
class FrameMotion:
    """How a frame moved while it was exposed, by the steps before and after it.

    Beside them counts what the rows of the newest frame tell. No pose of the window enters.

    Attributes
    ----------
    step : ndarray of float64, shape (6,), or None
        Twist per second (rad/s, m/s) of the step that leads to the frame; None: unknown.
    velocity : ndarray of float64, shape (6,), or None
        Twist per second at the stamp, right of the pose; None: unknown.
    sigmas : ndarray of float64, shape (6,), or None
        Of the velocity as extrapolated; None where it is known. The newest frame's may go on
        changing, or not, and turn aside: along each axis by as much as it just changed. In a first
        step, of which no change is known, by a fifth.
    told : MeasuredVelocity or None
        What the rows of the frame told of its velocity when it was the newest.
    start : FrameMotion or None
        That of the first frame of all, of which the change of the next step tells more.
    """

    step: FloatArray | None = None
    velocity: FloatArray | None = None
    sigmas: FloatArray | None = None
    told: MeasuredVelocity | None = None
    start: FrameMotion | None = None

    def measure(self, told: MeasuredVelocity) -> None:
        """Add what the rows of the newest frame tell to its velocity."""
        self.velocity, self.told = told.velocity, told

    @property
    def measured(self) -> MeasuredVelocity | None:
        """What the rows told, as long as the frame is the newest."""
        return None if self.sigmas is None else self.told

    def error(self) -> FloatArray:
        """Return by how much the pose of a frame was off when it was the newest, a twist (6,).

        Its velocity is known better since the next step. The pose that its own step led to is the
        one that all other frames are chained to.
        """
        told = self.told
        if told is None or self.velocity is None:
            return np.zeros(6)
        return ((self.velocity - told.velocity) / told.sigmas) @ told.found.effects


class Moving(Protocol):
    """Observations of a frame that know how it moved."""

    @property
    def stamp_ns(self) -> int:
        """Stamp of the frame, nanoseconds."""

    @property
    def motion(self) -> FrameMotion:
        """What the steps tell; it is filled in as they come."""


def note_step(reference: Moving, current: Moving, T_reference_current: FloatArray | None) -> None:
    """Take over the step between two frames, or that it is unknown.

    The reference moves with the mean of the steps before and after; the current frame with its step
    and half of its change, which is in doubt, and so did the first frame of all. What an earlier
    step between the two left behind plays no role.
    """
    elapsed_s = 1e-9 * (current.stamp_ns - reference.stamp_ns)
    if abs(elapsed_s) < _MIN_ELAPSED_S:
        return
    first, second = reference.motion, current.motion
    before, second.told = first.step, None
    if T_reference_current is None:
        second.step = second.velocity = second.sigmas = first.sigmas = None
        first.velocity = before if first.told is None or before is None else first.told.velocity
        return
    second.step = step = se3.log(T_reference_current) / elapsed_s
    if before is None:
        first.velocity = second.velocity = step
        second.sigmas = _along_each_axis(_FIRST_CHANGE * math.sqrt(3.0) * step)
        second.start = first
        return
    if first.start is not None:
        first.start.velocity = before - 0.5 * (step - before)
    first.velocity, first.sigmas = 0.5 * (before + step), None
    second.velocity = step + 0.5 * (step - before)
    second.sigmas = _along_each_axis(step - before)


def _along_each_axis(change: FloatArray) -> FloatArray:
    """Return the sigmas of a velocity (6,) that changes as much as this along any axis."""
    turn, shift = (np.linalg.norm(part) / math.sqrt(3.0) for part in (change[:3], change[3:]))
    return np.maximum([turn] * 3 + [_SHIFT_SHARE * shift] * 3, _LEAST_CHANGE)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Measurements:
    """What two frames show of the same n points.

    Parameters
    ----------
    frames : tuple of two observations
        Reference and current.
    uvd : tuple of two ndarrays of float64, shape (n, 3)
        Pixels and disparities as measured.
    sigmas : tuple of two ndarrays of float64, shape (n, 3)
    matches : ndarray of int64, shape (n, 2)
    sigma_factor : float
        Inflation of the registration's sigmas, before the doubt about constants is added.
    """

    frames: tuple[Moving, Moving]
    uvd: tuple[FloatArray, FloatArray]
    sigmas: tuple[FloatArray, FloatArray]
    matches: IntArray
    sigma_factor: float

    @property
    def stamps_ns(self) -> tuple[int, int]:
        """Stamps of reference and current."""
        return self.frames[0].stamp_ns, self.frames[1].stamp_ns


class CalibratedCamera:
    """Takes what is known of a camera's errors off measurements, and registers these.

    Parameters
    ----------
    camera : StereoCamera
    offsets : RigOffsets
    """

    def __init__(self, camera: StereoCamera, offsets: RigOffsets) -> None:
        self._camera, self._offsets = camera, offsets
        # Those of the last registration that was found, and is not accepted yet.
        self._found: Measurements | None = None

    def correct(self, observations: Moving, uvd: FloatArray) -> FloatArray:
        """Return measured (u, v, disparity), shape (n, 3), as a camera without errors has them."""
        velocity, offsets = observations.motion.velocity, self._offsets
        exposure, settled = offsets.exposure, np.empty_like(uvd)
        if velocity is None:
            velocity, exposure = _AT_REST, np.zeros(2)
        camera = self._camera.parameters
        shutter.settle_rows(uvd, offsets.lens, velocity, exposure, camera, settled)
        return settled

    def bends(self, reference: Moving, current: Moving) -> tuple[FloatArray, ...]:
        """Return what bends measurements: lens, velocities (2, 6) of two frames, exposure."""
        velocities = [each.motion.velocity for each in (reference, current)]
        known = np.array([_AT_REST if each is None else each for each in velocities])
        return self._offsets.lens, known, self._offsets.exposure

    def register(
        self, measured: Measurements, config: Config, *, prior: MotionPrior | None, is_step: bool
    ) -> RelativePose | Failure:
        """Register what two frames measure.

        Parameters
        ----------
        measured : Measurements
        config : Config
        prior : MotionPrior or None
            As of `register_correspondences`.
        is_step : bool
            The result tells the velocities of both frames. Where these move what rows show, it is
            estimated twice: roughly, with those predicted, then with its own, and what the rows of
            the current frame tell.

        Returns
        -------
        RelativePose or Failure
        """
        frames = measured.frames
        T_start = self.begin(measured, config, prior=prior, is_step=is_step)
        result = self._register(measured, config, prior, T_start)
        if isinstance(result, Failure) and T_start is not None:
            # What was found roughly may be the other one of two motions, or none.
            note_step(*frames, None if prior is None else prior.T_predicted)
            result = self._register(measured, config, prior, None)
        step, elapsed_s = frames[0].motion.step, 1e-9 * (frames[1].stamp_ns - frames[0].stamp_ns)
        if is_step and step is not None and 0.0 < elapsed_s < LONGEST_S and not self._offsets.zoom:
            found_m = np.inf if isinstance(result, Failure) else result.T_reference_current[:3, 3]
            # A step fails, or changes the velocity as no motion does.
            if np.linalg.norm(found_m - elapsed_s * step[3:]) > HARDEST_MPS2 * elapsed_s**2:
                self._look_for_zoom(measured, se3.exp(elapsed_s * step))
        if isinstance(result, Failure):
            return result
        if is_step and frames[1].motion.measured is None:
            note_step(*frames, result.T_reference_current)
        self._found = measured
        return check_rows(result, self._camera)

    def _look_for_zoom(self, measured: Measurements, T: FloatArray) -> None:
        ratio = find_zoom(self._corrected(measured), T, self._camera)
        if ratio is not None:
            self._offsets.zoom = {"zoom": round(ratio, 4), "zoom_ns": measured.stamps_ns[1]}

    def begin(
        self, measured: Measurements, config: Config, *, prior: MotionPrior | None, is_step: bool
    ) -> FloatArray | None:
        """Take over the velocities of a step, estimated roughly; return its T_reference_current.

        None where the exposure needs no velocities; where that fails, the step is tried again as a
        whole, to tell why.
        """
        frames = measured.frames
        # A first step has no velocity yet to start from.
        if not (is_step and frames[0].motion.velocity is not None):
            return None
        if not (self._offsets.possible_readout_s or self._offsets.delay_s):
            return None
        corrected, stamps_ns = self._corrected(measured), measured.stamps_ns
        T = estimate_roughly(corrected, self._camera, config, stamps_ns=stamps_ns, prior=prior)
        if isinstance(T, Failure):
            return None
        note_step(*frames, T)
        told = self._measure_velocity(measured, T, config)
        if told is None:
            return T
        note_step(*frames, told.found.T_reference_current)
        frames[1].motion.measure(told)
        return told.found.T_reference_current

    def accept(self, result: RelativePose, config: Config, *, is_step: bool) -> None:
        """Learn from a registration that passed all checks; from the others nothing is learnt."""
        measured, self._found = self._found, None
        if measured is None:
            return
        if is_step:
            self._learn(measured.frames[0])
        elif self._offsets.names:
            self._offsets.waiting.append((measured, result))

    def _register(
        self,
        measured: Measurements,
        config: Config,
        prior: MotionPrior | None,
        T_start: FloatArray | None,
    ) -> RelativePose | Failure:
        result = register_correspondences(
            *(self.prepare(measured, T_start), measured.matches, self._camera, config),
            stamps_ns=measured.stamps_ns,
            prior=prior,
            T_start=T_start,
        )
        if isinstance(result, Failure):
            return result
        T_correction = se3.exp(measured.frames[0].motion.error())
        # In sigmas of what is known of each constant, as the sensitivities are.
        effects = {name: np.zeros(6) for name in (READOUT, *_VELOCITIES)} | {**result.effects}
        shared = np.column_stack([effects.pop(name) for name in CONSIDERED])
        by_learnt, by_axis = np.split(np.array([*effects.values()]), [1])
        known = np.eye(len(by_axis))
        told = measured.frames[1].motion.measured
        if told is not None:
            known = told.found.covariance
            by_axis = by_axis if T_start is None else told.found.effects
        by_velocity = by_axis.T @ known @ by_axis
        by_velocity = 0.5 * (by_velocity + by_velocity.T)  # symmetric in spite of rounding
        return replace(
            result,
            T_reference_current=T_correction @ result.T_reference_current,
            covariance=measured.sigma_factor**2 * result.covariance
            + by_learnt.T @ by_learnt
            + by_velocity,
            passing_covariance=by_velocity,
            shared=shared @ self._offsets.calibration.root,
            pixels_reference=measured.uvd[0][:, :2],
            pixels_current=measured.uvd[1][:, :2],
        )

    def _measure_velocity(
        self, measured: Measurements, T: FloatArray, config: Config
    ) -> MeasuredVelocity | None:
        """Estimate the velocity of the current frame together with the step, by all inliers.

        A camera in the hand changes its velocity by as much as it has, from frame to frame: what
        is extrapolated leaves rows some tenths of a pixel from where they belong. Without this the
        smoothed ATE of freiburg1_xyz grows from 3.3 to 4.0 mm, that of freiburg1_rpy from 4.5 to
        5.6 mm.
        """
        readout_s, motion = self._offsets.readout_s, measured.frames[1].motion
        velocity, sigmas = motion.velocity, motion.sigmas
        if velocity is None or sigmas is None or readout_s == 0.0:
            return None
        corrected = self._corrected(measured)
        sensitivities = self._by_velocity(corrected, sigmas, readout_s)
        prepared = replace(corrected, sensitivities=sensitivities)
        inliers = find_inliers(T[np.newaxis], prepared, self._camera, config.ransac)[0]
        if np.count_nonzero(inliers) < config.ransac.min_inliers:
            return None
        residuals, factor = StereoResiduals.of(T, prepared, self._camera), measured.sigma_factor
        found = adjust(T, residuals, inliers, n_iterations=_N_ITERATIONS, sigma_factor=factor)
        if found is None:
            return None
        return MeasuredVelocity(extrapolated=velocity, sigmas=sigmas, found=found)

    def _by_velocity(
        self, corrected: Correspondences, sigmas: FloatArray, readout_s: float
    ) -> dict[str, FloatArray]:
        """Return the derivatives of corrected measurements by errors of the current velocity."""
        both = np.zeros((2, 6, len(corrected), 3))
        shutter.write_velocity_errors(
            *(corrected.current_points, corrected.current_uvd, sigmas, readout_s),
            *(self._camera.parameters, both[1]),
        )
        return dict(zip(_VELOCITIES, np.swapaxes(both, 0, 1), strict=True))

    def _corrected(self, measured: Measurements) -> Correspondences:
        reference, current = (
            self.correct(*each) for each in zip(measured.frames, measured.uvd, strict=True)
        )
        return Correspondences.of_pixels((reference, current), measured.sigmas, self._camera)

    def prepare(self, measured: Measurements, T_start: FloatArray | None) -> Correspondences:
        """Return what was measured, corrected, with its derivatives by what is in doubt."""
        # A step that was adjusted with it knows already what the velocity does to it.
        told = measured.frames[1].motion.measured
        is_adjusted = told is not None and T_start is not None
        corrected = self._corrected(measured)
        sensitivities, readout_sigma_s = self._by_calibration(measured), self._offsets.readout[1]
        if readout_sigma_s > 0.0:
            sensitivities[READOUT] = readout_sigma_s * self._by_exposure(measured)[READOUT]
        sigmas = measured.frames[1].motion.sigmas
        # What a readout that is not known yet may do counts, too.
        readout_s = self._offsets.possible_readout_s
        if sigmas is not None and readout_s != 0.0 and not is_adjusted:
            sensitivities |= self._by_velocity(corrected, sigmas, readout_s)
        return replace(corrected, sensitivities=sensitivities)

    def _by_exposure(self, measured: Measurements) -> dict[str, FloatArray]:
        """Return the derivatives of measurements by the readout time, and by the delay."""
        lens, velocities, _ = self.bends(*measured.frames)
        errors, camera = np.empty((2, 2, len(measured.matches), 3)), self._camera.parameters
        for uvd, velocity, out in zip(measured.uvd, velocities, errors, strict=True):
            shutter.write_exposure_errors(uvd, lens, velocity, camera, out)
        return dict(zip((READOUT, DELAY), np.swapaxes(errors, 0, 1), strict=True))

    def _by_calibration(self, measured: Measurements) -> dict[str, FloatArray]:
        """Return the derivatives of measurements by errors of a calibration, by a pixel of each."""
        both = np.stack([self._offsets.considered_fields(uvd) for uvd in measured.uvd], axis=1)
        return dict(zip(CONSIDERED, both, strict=True))

    def _learn(self, frame: Moving) -> None:
        """Take what the links of a frame tell of the camera, now that the step after it is known.

        Keyframes tell it best, seen by a camera that moved another way. A velocity that is
        extrapolated would not do: changes of velocity that are noise look like a shorter readout.
        """
        links, self._offsets.waiting = self._offsets.waiting, []
        names = self._offsets.names
        for measured, result in links:
            if measured.frames[1] is not frame:
                continue
            found = self._by_exposure(measured)
            if self._offsets.learns_lens:
                fields = np.stack([self._offsets.lens_fields(uvd) for uvd in measured.uvd], axis=1)
                found |= zip(LENS, fields, strict=True)
            else:
                found |= self._by_calibration(measured)
            sensitivities = {name: found[name] for name in names}
            prepared = replace(self._corrected(measured), sensitivities=sensitivities)
            T = result.T_reference_current
            residuals = StereoResiduals.of(T, prepared, self._camera)
            told = eliminate_pose(T, residuals, result.inliers)
            if told is not None:
                self._offsets.note(told)
