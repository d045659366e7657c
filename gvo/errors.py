"""Errors that mean a wrong world: a file, a topic, a configuration, a calibration."""

from gvo._text import cut

_MAX_MESSAGE = 4000  # characters


class GvoError(Exception):
    """A fault of the input that the user can mend.

    The message is one line: what, where, expected and got, what to do. Names that come from a
    file are shown as one line, too: what cannot be seen in them is escaped, an endless one cut.
    """

    def __str__(self) -> str:
        """Return the message."""
        return cut(super().__str__(), _MAX_MESSAGE)


class RecordingError(GvoError):
    """A recording is missing, unreadable, or does not hold what is needed."""


class OutputError(RecordingError):
    """A file of a run could not be written on: no space, no permission, gone.

    Attributes
    ----------
    is_partly : bool
        Poses were written before; they stand.
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
    """The window could not take a pose; it stands as it was before."""


class TrajectoryError(GvoError):
    """A trajectory file is missing, malformed or cannot be associated."""
