"""Errors of the input: files, topics, configurations, calibrations."""

from gvo._text import cut

_MAX_MESSAGE = 4000  # characters


class GvoError(Exception):
    """An error of the input that the user can correct.

    The message is one line: what, where, expected and got, what to do. Names from a file are
    printed on one line, with invisible characters escaped and long names cut.
    """

    def __str__(self) -> str:
        """Return the message."""
        return cut(super().__str__(), _MAX_MESSAGE)


class RecordingError(GvoError):
    """A recording is missing, unreadable or incomplete."""


class OutputError(RecordingError):
    """A file of a run could not be written: no space, no permission, deleted.

    Attributes
    ----------
    is_partly : bool
        Poses were written before, and remain.
    """

    def __init__(self, message: str, *, is_partly: bool = False) -> None:
        super().__init__(message)
        self.is_partly = is_partly


class RunBusyError(GvoError):
    """Another process is writing the run."""


class CalibrationError(GvoError):
    """A calibration is missing or does not describe a usable camera."""


class ConfigurationError(GvoError):
    """A configuration file or setting is unknown, malformed or out of range."""


class SmoothingError(GvoError):
    """The window could not add a pose; it is unchanged."""


class TrajectoryError(GvoError):
    """A trajectory file is missing, malformed or cannot be associated."""
