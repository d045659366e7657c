"""What is learnt of constants of the camera: disparity and row offsets, and readout time."""

from __future__ import annotations

import math

from gvo.config import Config
from gvo.types import ConstantError, RelativePose

# Largest inflation of the sigmas of a registration by tracks: errors of near ones correlate.
KLT_SIGMA_FACTOR = 2.4
# Prior standard deviation of the constant error of disparities.
OFFSET_SIGMA_PX = 0.1
# Names of what registrations tell.
DISPARITY, READOUT = "disparity_px", "readout_s"
# Errors of registrations are correlated (the same walls, the same lens): their sigmas are too small
# by these factors.
_DISPARITY_FACTOR = 3.0
_READOUT_FACTOR = 5.0
# An offset of the disparities that is not taken off, as registrations do not tell it from errors
# that all of them share.
_FEIGNED_PX = 0.05
# Sigmas of the row offset measured in one frame, and of its prior, pixels.
_ROW_SIGMA_PX = 0.1
_ROW_PRIOR_PX = 0.3
# Sigma of the prior of the readout time, seconds: rolling shutters take 5 to 33 ms. Below the lower
# one a readout that may be zero is taken for zero.
_READOUT_PRIOR_S = 0.03
_LEAST_READOUT_S = 0.005
# Drift per frame: temperature, vibration.
_DRIFT_PX = 5e-4
_DRIFT_S = 1e-5
# Innovations are clipped to so many sigmas.
_MAX_SURPRISE = 3.0
# Misfits that a variance factor is averaged over; the largest, per degree of freedom; and the share
# of the variance that errors are taken to have which registrations of the same motion share.
_N_MISFITS = 30
_MAX_MISFIT = 2.0
_SHARED = 0.25


class ConstantFilter:
    """A scalar Kalman filter of a value that hardly changes.

    Parameters
    ----------
    prior_sigma : float
        Standard deviation of the prior, in the unit of the value; 0: it is known.
    drift : float
        Standard deviation of its change per frame.
    value : float
        Mean of the prior.

    Attributes
    ----------
    value, sigma : float
        The present estimate, and its standard deviation.
    """

    def __init__(self, prior_sigma: float, drift: float, value: float = 0.0) -> None:
        self._prior_sigma, self._drift = prior_sigma, drift
        self.value, self.sigma = value, prior_sigma

    def advance(self) -> None:
        """Let the value drift for a frame."""
        self.sigma = min(math.hypot(self.sigma, self._drift), self._prior_sigma)

    def update(self, error: float, sigma: float) -> None:
        """Add a measurement of what is left of the value, and its standard deviation."""
        limit = _MAX_SURPRISE * math.hypot(self.sigma, sigma)
        gain = self.sigma**2 / (self.sigma**2 + sigma**2)
        self.value += gain * min(max(error, -limit), limit)
        self.sigma *= math.sqrt(1.0 - gain)


class VarianceFactor:
    """What the inflation of registrations' covariances should have been, by those that agree.

    A link to a keyframe and the steps since then measure the same motion. Where they differ by less
    than stated, errors of neighbouring tracks correlate less than `sigma_factor` assumes. Errors
    that both share, they do not show: a part of the assumption always stays.

    Parameters
    ----------
    sigma_factor : float
        Inflation of the registrations' sigmas; no more than that is taken back.

    Attributes
    ----------
    value : float
        By which the stated covariances are to be multiplied, at most one.

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
        self._mean += (min(misfit, _MAX_MISFIT) - self._mean) / _N_MISFITS
        value = _SHARED + (1.0 - _SHARED) * self._mean
        self.value = min(max(value, self._least), 1.0)


class RigOffsets:
    """What is learnt of a camera while it runs: disparity and row offsets, readout time.

    Measurements take effect with `advance`, so that all registrations of one frame use the same
    values.

    Parameters
    ----------
    config : Config
        `stereo.estimate_offset`, else the offsets stay at zero; `camera.readout_ms`, known or to
        be learnt.
    is_stereo : bool
        Other sensors have no offsets.

    Attributes
    ----------
    disparity, row : ConstantFilter
        By how much disparities and rows of the right image are too large, pixels.
    readout : ConstantFilter
        Time from the first to the last row, seconds.
    learnt : dict of str to ConstantFilter
        Those of them that registrations tell, by name.
    disparity_px : float
        The offset that is taken off disparities, pixels: what was learnt beyond a twentieth of a
        pixel. So much is feigned by lenses and by patches that hold more than one surface.
    readout_s : float
        The readout time that is reckoned with, seconds: zero where it may be zero. A global
        shutter is not to be bent by what is left of the noise.
    possible_readout_s : float
        How long the readout may be, seconds: zero where it is known to take no time.
    chain_factor, window_factor : VarianceFactor
        Of the covariances of registrations where they are chained, and where they are smoothed:
        by loops of links and steps, and by the edges of one frame in the window.
    """

    def __init__(self, config: Config, *, is_stereo: bool = True) -> None:
        readout_ms = config.camera.readout_ms
        self.disparity = ConstantFilter(OFFSET_SIGMA_PX, _DRIFT_PX)
        self.row = ConstantFilter(_ROW_PRIOR_PX, _DRIFT_PX)
        self.readout = (
            ConstantFilter(_READOUT_PRIOR_S, _DRIFT_S)
            if readout_ms is None
            else ConstantFilter(0.0, 0.0, 1e-3 * readout_ms)
        )
        self.learnt = {
            name: constant
            for name, constant, is_learnt in (
                (DISPARITY, self.disparity, is_stereo and config.stereo.estimate_offset),
                (READOUT, self.readout, readout_ms is None),
            )
            if is_learnt
        }
        self._sigma_factor = math.nan
        self.reconfigure(config)
        self._is_stereo = is_stereo
        self._disparity_error: ConstantError | None = None
        self._readout_errors: list[ConstantError] = []
        self._row_px: float | None = None
        self._settle()

    def _settle(self) -> None:
        """Say what registrations take off, from now on."""
        learnt_px, longest_s = self.disparity.value, abs(self.readout.value) + self.readout.sigma
        self.disparity_px = math.copysign(max(abs(learnt_px) - _FEIGNED_PX, 0.0), learnt_px)
        is_rolling = abs(self.readout.value) > self.readout.sigma
        self.readout_s = self.readout.value if is_rolling else 0.0
        is_possible = is_rolling or longest_s > _LEAST_READOUT_S
        self.possible_readout_s = (
            math.hypot(self.readout_s, self.readout.sigma) if is_possible else 0.0
        )

    def reconfigure(self, config: Config) -> None:
        """Forget the variance factors where another front-end states other covariances."""
        # Matches of descriptors share a bias, and loops of them do: nothing is taken back there.
        sigma_factor = KLT_SIGMA_FACTOR if config.frontend.kind == "klt" else 1.0
        if sigma_factor != self._sigma_factor:
            self._sigma_factor = sigma_factor
            self.chain_factor, self.window_factor = map(VarianceFactor, [sigma_factor] * 2)

    def note_disparity(self, error: ConstantError | None) -> None:
        """Take what a step tells of the disparities, after the present value was subtracted."""
        self._disparity_error = error

    def note_readout(self, error: ConstantError, result: RelativePose) -> None:
        """Take what a registration tells of the readout, after the present value was subtracted."""
        # Matches that a wrong readout time contradicts are outliers, the others confirm it.
        self._readout_errors.append(error.widened((result.n_matches / result.n_inliers) ** 2))

    def note_rows(self, row_px: float | None) -> None:
        """Take what a step's reference tells: row in the right image minus row in the left."""
        if DISPARITY in self.learnt:
            self._row_px = row_px

    def advance(self) -> None:
        """Apply the measurements taken since the last frame."""
        for constant in (self.disparity, self.row, self.readout):
            constant.advance()
        if self._disparity_error is not None:
            error = self._disparity_error
            left_px = self.disparity_px + error.value - self.disparity.value
            self.disparity.update(left_px, _DISPARITY_FACTOR * error.sigma)
        if self._row_px is not None:
            self.row.update(self._row_px - self.row.value, _ROW_SIGMA_PX)
        for error in self._readout_errors:
            left_s = self.readout_s + error.value - self.readout.value
            self.readout.update(left_s, _READOUT_FACTOR * error.sigma)
        self._disparity_error, self._row_px, self._readout_errors = None, None, []
        self._settle()

    def as_json(self) -> dict[str, float]:
        """Return values and sigmas as plain numbers; a sigma of 0: it was given."""
        offsets = {
            "disparity_px": round(self.disparity.value, 4),
            "disparity_sigma_px": round(self.disparity.sigma, 4),
            "row_px": round(self.row.value, 4),
        }
        return (offsets if self._is_stereo else {}) | {
            "readout_ms": round(1e3 * self.readout.value, 2),
            "readout_sigma_ms": round(1e3 * self.readout.sigma, 2),
        }
