"""What conversions of recordings share."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from gvo.errors import RecordingError


@dataclass(frozen=True, slots=True, kw_only=True)
class Conversion:
    """What a conversion wrote.

    Parameters
    ----------
    path : Path
        The new bag or folder.
    n_images : int
        Images written, of both streams.
    n_poses : int
        Poses of the ground truth written.
    skipped : tuple of str
        One line for each thing that was left out.
    """

    path: Path
    n_images: int
    n_poses: int
    skipped: tuple[str, ...]


def check_new(path: Path) -> None:
    """Refuse a target that exists, or whose folder does not.

    Parameters
    ----------
    path : Path
        To be made.

    Raises
    ------
    RecordingError
        With what to do.
    """
    if path.exists():
        raise RecordingError(f"{path}: exists already; give another path or remove it")
    if not path.parent.is_dir():
        raise RecordingError(f"{path}: cannot be written: {path.parent} is no folder")
