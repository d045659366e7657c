"""`check_recording`: all checks on one recording."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from gvo.backend.imu_alignment import Turns
from gvo.config import Config
from gvo.diagnostics.check.depth import check_depth
from gvo.diagnostics.check.findings import CheckResult, Finding
from gvo.diagnostics.check.frame_tree import check_frame_tree
from gvo.diagnostics.check.images import check_images, check_usable
from gvo.diagnostics.check.imu import check_imu
from gvo.diagnostics.check.limits import judged, measured
from gvo.diagnostics.check.sampling import Survey, survey
from gvo.diagnostics.check.shutter import check_shutter, look_closely
from gvo.diagnostics.check.stereo import check_stereo
from gvo.diagnostics.check.timing import check_timing
from gvo.errors import CalibrationError
from gvo.geometry.camera import PinholeCamera, StereoCamera
from gvo.io.bag.source import CAMERA_CHANGED, describe_camera_changes
from gvo.io.poses.tf import TfBuffer
from gvo.io.recording import OTHER_SIZE, RecordingInfo, Source
from gvo.types import Failure

# Frames that are decoded, each with its successor: a check takes seconds, whatever the length.
_N_SAMPLES = 12


def check_recording(
    source: Source,
    config: Config | None = None,
    *,
    n_samples: int = _N_SAMPLES,
    learn_readout: bool = True,
    transforms: TfBuffer | None = None,
    base_frame: str = "base_link",
) -> CheckResult:
    """Check a recording for what makes odometry fail or err.

    All stamps are read, and a few frames are decoded as for odometry. Memory holds these frames,
    two numbers per image, and the samples of an IMU.

    Parameters
    ----------
    source : Source
        The recording.
    config : Config, optional
        As for odometry.
    n_samples : int
        Number of decoded frames, each with the next one.
    learn_readout : bool
        Run odometry over parts of the recording, to tell a rolling shutter, and whether an IMU
        turns as the camera does.
    transforms : TfBuffer, optional
        Transforms of the same bag; if None, the tree of frames is not checked.
    base_frame : str
        The robot's own frame in that tree.

    Returns
    -------
    CheckResult
        Damage and missing parts are findings, not exceptions.

    Examples
    --------
    >>> import gvo
    >>> recording = gvo.SyntheticRecording("handheld", "stereo", n_frames=8, scale=0.5)
    >>> check_recording(recording, n_samples=4).is_healthy
    True
    """
    config = config or Config()
    found = survey(source, config, n_samples=n_samples)
    info, stamps_ns = source.info, found.stamps_ns[0]
    camera = _find_camera(info)
    findings = [
        *_describe(info, found),
        *_describe_camera(camera, info.doubt),
        *check_timing(found, info, config),
        check_usable(found.samples),
        *check_images(found.samples, config),
    ]
    if info.sensor == "rgbd":
        findings += check_depth(found.samples, config)
    elif not isinstance(camera, Failure):
        findings += check_stereo(found.samples, camera, config)
    looked = None
    if learn_readout and not isinstance(camera, Failure):
        looked = look_closely(source, found, config)
        findings += check_shutter(looked, config)
    if info.imu is not None:
        findings += check_imu(info.imu, stamps_ns, Turns.of(looked.steps if looked else ()))
    changes = describe_camera_changes(source)
    if changes is not None:
        findings.append(
            judged(
                "changed CameraInfo",
                changes or "0 messages differ from the first",
                is_ok=not changes,
                threshold="0",
                fix=CAMERA_CHANGED,
            )
        )
    if transforms is not None:
        findings += check_frame_tree(transforms, info.frame_id, stamps_ns, base_frame=base_frame)
    return CheckResult(recording=info.name, findings=tuple(findings))


def _describe(info: RecordingInfo, found: Survey) -> Iterator[Finding]:
    """Yield the content of the recording and what odometry will use of it."""
    first, stamps_ns = info.calibrations[0], found.stamps_ns[0]
    duration_s = float(np.ptp(stamps_ns)) / 1e9 if len(stamps_ns) else 0.0
    counts = " + ".join(str(len(each)) for each in found.stamps_ns)
    size = f"{first.width}x{first.height}"
    value = f"{info.sensor}, {counts} images of {size}, {duration_s:.1f} s"
    yield Finding(name="recording", value=value)
    for number, decision in enumerate(info.decisions, start=1):
        yield Finding(name=f"source {number}", value=decision)
    yield judged(
        "reading",
        found.damage or "complete",
        is_ok=not found.damage,
        threshold="complete",
        otherwise="fault",
        fix="what was read is usable; repair a copy of the file or record anew",
    )


def _find_camera(info: RecordingInfo) -> PinholeCamera | Failure:
    try:
        return info.camera
    except CalibrationError as error:
        return Failure(reason=str(error))


def _describe_camera(camera: PinholeCamera | Failure, doubt: str) -> Iterator[Finding]:
    if isinstance(camera, Failure):
        yield Finding(
            name="calibration",
            value=camera.reason,
            threshold="one camera, or a pair of one size and focal length",
            verdict="fault",
            fix="give the right one by --calibration FILE",
        )
        return
    if doubt:
        threshold = "principal point near the centre"
        yield judged(
            "K", doubt, is_ok=False, threshold=threshold, otherwise="fault", fix=OTHER_SIZE
        )
    view_deg = np.degrees(2.0 * np.arctan(0.5 * camera.width / camera.fx))
    yield Finding(name="focal length", value=f"{camera.fx:.1f} px, view of {view_deg:.0f} deg")
    if isinstance(camera, StereoCamera):
        yield measured("baseline", camera.baseline)
