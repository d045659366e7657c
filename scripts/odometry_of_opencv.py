"""Run OpenCV's own RGB-D odometry, `cv2.Odometry`, as the front-end of a sliding window.

It aligns two images directly, without keypoints: to the predecessor, and to keyframes that the
window keeps. It gives no covariance, so the sigmas below are a guess that you should set.
`cv2.Odometry` is part of OpenCV 5 (in 4 it was in the extra module `rgbd`).

Example: python scripts/odometry_of_opencv.py rgbd_dataset_freiburg1_xyz --out out
"""

import argparse
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

import gvo
from gvo.types import Failure, RelativePose

# Of an alignment: a floor, and a share of the turn and of the way.
ROTATION_SIGMA_RAD = 0.002
TRANSLATION_SIGMA_M = 0.002
SIGMA_SHARE = 0.1
# It starts from standing still and may end anywhere: what is farther from the prediction than
# this is taken for a failure.
MAX_ANGLE_RAD = 0.03
MAX_DISTANCE_M = 0.03


@dataclass(frozen=True)
class PreparedFrame:
    """What is kept of a frame: image pyramids, inside OpenCV."""

    stamp_ns: int
    frame: Any


class OpencvOdometry:
    """A front-end in two methods; `gvo.Odometry` does the rest."""

    def __init__(self, camera: gvo.PinholeCamera) -> None:
        settings = cv2.OdometrySettings()
        settings.setCameraMatrix(camera.K.astype(np.float32))
        self._odometry = cv2.Odometry(
            cv2.OdometryType_RGB_DEPTH,
            settings,
            cv2.OdometryAlgoType_COMMON,
        )

    def extract(self, frame: gvo.RgbdFrame) -> PreparedFrame:
        """Build the pyramids of one frame."""
        prepared = cv2.OdometryFrame(
            depth=np.array(frame.depth, dtype=np.float32), image=np.array(frame.image)
        )
        self._odometry.prepareFrame(prepared)
        return PreparedFrame(stamp_ns=frame.stamp_ns, frame=prepared)

    def register(
        self, reference: PreparedFrame, current: PreparedFrame, prior: gvo.MotionPrior | None
    ) -> RelativePose | Failure:
        """Align the current frame to a reference."""
        is_found, T_reference_current = self._odometry.compute(current.frame, reference.frame)
        if not is_found:
            return Failure(reason="cv2.Odometry finds no alignment")
        T = np.asarray(T_reference_current, dtype=np.float64)
        U, _, Vt = np.linalg.svd(T[:3, :3])  # of single precision
        T[:3, :3] = U @ Vt
        expected = np.eye(4) if prior is None else prior.T_predicted
        angle, distance = size_of(np.linalg.inv(expected) @ T)
        if not (angle < MAX_ANGLE_RAD and distance < MAX_DISTANCE_M):
            return Failure(reason=f"{angle:.2f} rad and {distance:.2f} m off the prediction")
        turn, way = size_of(T)
        sigmas = [ROTATION_SIGMA_RAD + SIGMA_SHARE * turn, TRANSLATION_SIGMA_M + SIGMA_SHARE * way]
        covariance = np.diag(np.repeat(sigmas, 3) ** 2)
        return RelativePose(T_reference_current=T, covariance=covariance)


def size_of(T: np.ndarray) -> tuple[float, float]:
    """Return the angle (rad) and the distance (m) of a motion."""
    return float(np.linalg.norm(cv2.Rodrigues(T[:3, :3])[0])), float(np.linalg.norm(T[:3, 3]))


def main() -> int:
    """Run on a recording, print the errors of all three trajectories."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("recording", type=Path, help="RGB-D recording: TUM folder or bag")
    parser.add_argument("--frames", type=int, help="stop after so many")
    arguments = parser.parse_args()
    if not hasattr(cv2, "Odometry"):
        print(f"odometry_of_opencv: error: OpenCV {cv2.__version__} has no cv2.Odometry; "
              "pip install 'opencv-python-headless>=5'", file=sys.stderr)  # fmt: skip
        return 2

    source = gvo.open_recording(arguments.recording)
    if source.info.sensor != "rgbd":
        print("odometry_of_opencv: error: expected an RGB-D recording", file=sys.stderr)
        return 2
    odometry = gvo.Odometry(source.info.camera, frontend=OpencvOdometry(source.info.camera))
    estimates: dict[str, list[gvo.Estimate]] = {"raw": [], "causal": [], "smoothed": []}
    for frame in gvo.frames(source, gvo.Config()):
        if not isinstance(frame, gvo.RgbdFrame):
            continue
        result = odometry.track(frame)
        estimates["raw"].append(result.raw)
        estimates["causal"].append(result.causal)
        estimates["smoothed"] += result.finished
        if len(estimates["raw"]) == arguments.frames:
            break
    estimates["smoothed"] += odometry.finish()
    truth = source.ground_truth()
    for name, poses in estimates.items():
        trajectory = gvo.Trajectory.of(poses)
        error = (
            ""
            if truth is None
            else f", ATE {gvo.evaluate(truth, trajectory, name=name).ate_m:.4f} m"
        )
        print(f"{name}: {len(trajectory)} poses{error}")
    return 0


if __name__ == "__main__":
    try:
        sys.exit(main())
    except gvo.GvoError as error:
        print(f"odometry_of_opencv: error: {error}", file=sys.stderr)
        sys.exit(2)
