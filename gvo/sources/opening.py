"""Recognise what kind of recording a path holds."""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path

from gvo.config import Config
from gvo.errors import RecordingError
from gvo.sources.bag import BagSource
from gvo.sources.euroc import EurocSource
from gvo.sources.kitti import KittiSource
from gvo.sources.recording import Source
from gvo.sources.topics import TopicChoice
from gvo.sources.tum import TumSource

BAG_SUFFIXES = (".bag", ".mcap", ".db3")
_KINDS = (
    "a recording is a .bag, .mcap or .db3 file, a ROS 2 bag folder (metadata.yaml), or a folder "
    "of KITTI odometry (calib.txt), EuRoC (mav0 or cam0) or TUM RGB-D (rgb.txt)"
)


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordingOptions:
    """What the user says about a recording.

    Parameters
    ----------
    calibration : Path, optional
        YAML file that replaces the recording's own calibration.
    left, right : str, optional
        Topics of a stereo pair in a bag.
    color, depth : str, optional
        Topics of an RGB-D camera in a bag.
    """

    calibration: Path | None = None
    left: str | None = None
    right: str | None = None
    color: str | None = None
    depth: str | None = None


def open_recording(
    path: str | Path, *, config: Config | None = None, options: RecordingOptions | None = None
) -> Source:
    """Open a recording of any kind.

    Parameters
    ----------
    path : str or Path
        File or folder.
    config : Config, optional
        Of which `depth.scale` matters here.
    options : RecordingOptions, optional
        What to choose, and the calibration.

    Raises
    ------
    RecordingError
        When the path is missing or holds no recording, or does not hold what is needed.
    CalibrationError
        When the camera is not calibrated.
    """
    path = Path(path)
    config = config or Config()
    options = options or RecordingOptions()
    if not path.exists():
        raise RecordingError(f"{path}: does not exist; {_KINDS}")
    scale = config.depth.scale
    if _is_bag(path):
        topics = TopicChoice(
            left=options.left, right=options.right, color=options.color, depth=options.depth
        )
        return BagSource(path, topics=topics, calibration=options.calibration, depth_scale=scale)
    _refuse_topics(path, options)
    if _is_kitti(path):
        return KittiSource(path, calibration=options.calibration)
    if (path / "mav0").is_dir() or (path / "cam0").is_dir():
        return EurocSource(path, calibration=options.calibration)
    if (path / "rgb.txt").is_file():
        return TumSource(path, calibration=options.calibration, depth_scale=scale)
    raise RecordingError(f"{path}: is no recording; {_KINDS}")


def _is_bag(path: Path) -> bool:
    if path.is_file():
        return path.suffix in BAG_SUFFIXES
    return (path / "metadata.yaml").is_file() or any(
        child.suffix in (".mcap", ".db3") for child in path.iterdir()
    )


def _is_kitti(path: Path) -> bool:
    has_images = any((path / name).is_dir() for name in ("image_0", "image_2"))
    return (path / "calib.txt").is_file() or (has_images and (path / "times.txt").is_file())


def _refuse_topics(path: Path, options: RecordingOptions) -> None:
    names = [field.name for field in fields(options) if field.name != "calibration"]
    given = [name for name in names if getattr(options, name) is not None]
    if given:
        raise RecordingError(f"{path}: --{given[0]} names a topic of a bag, this is no bag")
