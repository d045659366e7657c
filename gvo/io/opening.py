"""Recognise what kind of recording a path holds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeAlias

from gvo._text import access_fault
from gvo.config import Config
from gvo.errors import RecordingError, named_faults
from gvo.io.bag.reader import STORAGE_SUFFIXES, is_storage
from gvo.io.bag.source import BagSource
from gvo.io.bag.topics import NO_IMU, TopicChoice
from gvo.io.calibration.files import CalibrationPaths, split_imu
from gvo.io.calibration.forms import ImuFacts
from gvo.io.datasets.euroc import EurocSource
from gvo.io.datasets.kitti import KittiSource
from gvo.io.datasets.tum import TumSource
from gvo.io.images import read_mask
from gvo.io.recording import RecordingInfo, Source
from gvo.io.rig_file import with_rig

BAG_SUFFIXES = (".bag", *STORAGE_SUFFIXES)
_KINDS = (
    "a recording is a .bag, .mcap or .db3 file, a ROS 2 bag folder (metadata.yaml), or a folder "
    "of KITTI odometry (calib.txt), EuRoC (mav0 or cam0) or TUM RGB-D (rgb.txt)"
)
# By such a name in it a folder is known to be one recording.
FOLDER_MARKERS = ("metadata.yaml", "calib.txt", "times.txt", "mav0", "cam0", "rgb.txt")
_PACKED = (".gz", ".bz2", ".xz", ".zst", ".zstd", ".lz4", ".zip", ".tar", ".tgz", ".7z")
_Opened: TypeAlias = BagSource | KittiSource | EurocSource | TumSource
_TOPICS = ("left", "right", "color", "depth", "camera_info", "imu")


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordingOptions(TopicChoice):
    """What the user says about a recording.

    Parameters
    ----------
    left, right : str, optional
        Topics of a stereo pair in a bag.
    color, depth : str, optional
        Topics of an RGB-D camera in a bag.
    imu : str, optional
        Topic of the IMU in a bag, or of its gyro; "none": it is not used.
    camera_info : tuple of str
        Topics of `CameraInfo` in a bag: of left, then right; or of colour, then depth.
    calibration : Path or sequence of Path
        Files that replace the recording's own calibration: one or two, or a folder; and one of
        the IMU.
    mask : tuple of Path
        Images in which 0 marks pixels that are not used, of the size of those recorded: one for
        both cameras, or left and right; of RGB-D, one for colour.
    rig : Path, optional
        The `rig.yaml` of an earlier run with the same camera, which odometry starts from.
    """

    calibration: CalibrationPaths = None
    mask: tuple[Path, ...] = ()
    rig: str | Path | None = None


def open_recording(
    path: str | Path | Sequence[str | Path],
    *,
    config: Config | None = None,
    options: RecordingOptions | None = None,
) -> Source:
    """Open a recording of any kind.

    Parameters
    ----------
    path : str or Path, or a sequence of them
        File or folder; several bags are one recording.
    config : Config, optional
        Of which `depth.scale` and `images` matter here.
    options : RecordingOptions, optional
        What to choose, and the calibration.

    Raises
    ------
    ValueError
        If no path is given.
    RecordingError
        When a path is missing or holds no recording, or does not hold what is needed; when a mask
        does not fit.
    CalibrationError
        When the camera is not calibrated.
    """
    paths = [Path(path)] if isinstance(path, str | Path) else [Path(one) for one in path]
    if not paths:
        raise ValueError("expected at least one path of a recording")
    config = config or Config()
    options = options or RecordingOptions()
    with named_faults(RecordingError, paths[0]):
        calibration, imu = asked_imu(options)
        source = _open(paths, config, replace(options, calibration=calibration), imu)
    source.info = as_asked(source.info, config, options, imu)
    return source


def as_asked(
    info: RecordingInfo, config: Config, options: RecordingOptions, imu: ImuFacts | None = None
) -> RecordingInfo:
    """Return what is known of a recording, with the masks and the rig that are asked for.

    Where facts of an IMU are for nothing it says so.
    """
    info = with_rig(_with_masks(info, config, options), options.rig)
    if imu and info.imu is None:
        info.decisions.append("imu: none, what is said of one by --calibration is not used")
    return info


def asked_imu(options: RecordingOptions) -> tuple[tuple[Path, ...], ImuFacts | None]:
    """Return the files of cameras, and what others say of the IMU; None where none is wanted."""
    calibration, facts = split_imu(options.calibration)
    return calibration, None if options.imu == NO_IMU else facts


def _with_masks(info: RecordingInfo, config: Config, options: RecordingOptions) -> RecordingInfo:
    """Return what is known of a recording with the masks that are asked for."""
    paths = options.mask or tuple(map(Path, config.images.mask))
    cameras = info.calibrations
    if not paths:
        return info
    if len(paths) > len(cameras):
        raise RecordingError(
            f"{paths[-1]}: a {info.sensor} recording takes {len(cameras)} --mask, got {len(paths)}"
        )
    files = paths * (len(cameras) // len(paths))
    pairs = zip(files, cameras, strict=True)
    masks = [read_mask(path, camera.width, camera.height) for path, camera in pairs]
    return replace(info, masks=tuple(masks))


def _open(
    paths: Sequence[Path], config: Config, options: RecordingOptions, imu: ImuFacts | None
) -> _Opened:
    for one in paths:
        if fault := access_fault(one):
            raise RecordingError(f"{one}: {fault}; {_KINDS}")
        if not (one.is_file() or one.is_dir()):
            raise RecordingError(f"{one}: is a pipe, a socket or a device; {_KINDS}")
    if all(is_bag(one) for one in paths):
        calibration = options.calibration
        return BagSource(paths, topics=options, calibration=calibration, config=config, imu=imu)
    if len(paths) > 1:
        other = next(one for one in paths if not is_bag(one))
        raise RecordingError(f"{other}: not a bag; only bags can be combined into one recording")
    return _open_folder(paths[0], config, options, imu)


def is_bag(path: Path) -> bool:
    """Tell whether a path that exists is a bag of ROS, by its name or by what it holds."""
    if path.is_file():
        return path.suffix == ".bag" or is_storage(path)
    if not path.is_dir():
        return False  # a pipe or a device
    return (path / "metadata.yaml").is_file() or any(map(is_storage, path.iterdir()))


def refuse_topics(options: TopicChoice, where: str | Path) -> None:
    """Refuse a choice of topics where there are none."""
    for name in _TOPICS:
        chosen = getattr(options, name)
        if chosen and (name, chosen) != ("imu", NO_IMU):
            flag = f"--{name.replace('_', '-')}"
            raise RecordingError(
                f"{where}: {flag} chooses a topic of a bag or of ROS, here is none"
            )


def _open_folder(
    path: Path, config: Config, options: RecordingOptions, imu: ImuFacts | None
) -> _Opened:
    refuse_topics(options, path)
    if _is_kitti(path):
        return KittiSource(path, calibration=options.calibration, config=config)
    if (path / "mav0").is_dir() or (path / "cam0").is_dir():
        return EurocSource(path, calibration=options.calibration, config=config, imu=imu)
    if (path / "rgb.txt").is_file():
        return TumSource(path, calibration=options.calibration, config=config)
    raise RecordingError(f"{path}: {_what_is_missing(path) or 'not a recording'}; {_KINDS}")


def _what_is_missing(path: Path) -> str:
    """Say what keeps a path from being a recording, where it looks like one."""
    if path.suffix in _PACKED:
        return "packed files are not read; unpack it first"
    lists = [each.name for each in path.glob("*assoc*.txt")]
    if not (lists or all((path / name).is_dir() for name in ("rgb", "depth"))):
        return ""
    words = "rgb.txt and depth.txt are missing, each with rows of a stamp and a file"
    return f"{words}; write them from the columns of {lists[0]}" if lists else words


def _is_kitti(path: Path) -> bool:
    has_images = any((path / name).is_dir() for name in ("image_0", "image_2"))
    return (path / "calib.txt").is_file() or (has_images and (path / "times.txt").is_file())
