"""Errors that mean a wrong world: a file, a topic, a configuration, a calibration."""


class GvoError(Exception):
    """A fault of the input that the user can mend.

    The message is one line: what, where, expected and got, what to do.
    """


class RecordingError(GvoError):
    """A recording is missing, unreadable, or does not hold what is needed."""


class CalibrationError(GvoError):
    """A calibration is missing or does not describe a usable camera."""


class ConfigurationError(GvoError):
    """A configuration file or setting is unknown, malformed or out of range."""


class SmoothingError(GvoError):
    """The window could not take a pose; it stands as it was before."""


class TrajectoryError(GvoError):
    """A trajectory file is missing, malformed or cannot be associated."""
