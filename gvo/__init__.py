"""Visual odometry for calibrated stereo and RGB-D cameras, with a sliding-window back-end.

The public names are loaded when they are first used, so that the command line answers at once.
"""

import os
from importlib import import_module
from typing import TYPE_CHECKING

from gvo._version import __version__ as __version__

if TYPE_CHECKING:
    from gvo.backend.window import SlidingWindow as SlidingWindow
    from gvo.config import Config as Config
    from gvo.config import WindowConfig as WindowConfig
    from gvo.config import load_configuration as load_configuration
    from gvo.diagnostics.check.recording import check_recording as check_recording
    from gvo.errors import GvoError as GvoError
    from gvo.frontend.protocol import Frontend as Frontend
    from gvo.geometry.camera import PinholeCamera as PinholeCamera
    from gvo.geometry.camera import StereoCamera as StereoCamera
    from gvo.io.convert.convert import convert as convert
    from gvo.io.edges.opening import open_edges as open_edges
    from gvo.io.excerpt import Excerpt as Excerpt
    from gvo.io.frames import Rig as Rig
    from gvo.io.frames import frames as frames
    from gvo.io.opening import RecordingOptions as RecordingOptions
    from gvo.io.opening import open_recording as open_recording
    from gvo.io.poses.inputs import evaluate as evaluate
    from gvo.io.poses.inputs import read_ground_truth as read_ground_truth
    from gvo.io.synthetic import SyntheticRecording as SyntheticRecording
    from gvo.odometry.loops import LoopDetector as LoopDetector
    from gvo.odometry.odometry import Odometry as Odometry
    from gvo.runs.outputs.options import RunOutputs as RunOutputs
    from gvo.runs.result import RunResult as RunResult
    from gvo.runs.run import run_recording as run_recording
    from gvo.runs.smooth import optimize as optimize
    from gvo.runs.smooth import smooth_edges as smooth_edges
    from gvo.trajectory.evaluation import Evaluation as Evaluation
    from gvo.trajectory.evaluation import format_evaluations as format_evaluations
    from gvo.trajectory.formats import read_trajectory as read_trajectory
    from gvo.trajectory.trajectory import Trajectory as Trajectory
    from gvo.types import Edge as Edge
    from gvo.types import Estimate as Estimate
    from gvo.types import Failure as Failure
    from gvo.types import FaultyFrame as FaultyFrame
    from gvo.types import FrameResult as FrameResult
    from gvo.types import GraphEdge as GraphEdge
    from gvo.types import Loop as Loop
    from gvo.types import MotionPrior as MotionPrior
    from gvo.types import Optimum as Optimum
    from gvo.types import PosePrior as PosePrior
    from gvo.types import PositionPrior as PositionPrior
    from gvo.types import Rejected as Rejected
    from gvo.types import RelativePose as RelativePose
    from gvo.types import RgbdFrame as RgbdFrame
    from gvo.types import Status as Status
    from gvo.types import StereoFrame as StereoFrame
    from gvo.viz.plots import plot_trajectories as plot_trajectories

# OpenCV reads it as it is imported: a damaged header must not make it allocate gigabytes.
os.environ.setdefault("OPENCV_IO_MAX_IMAGE_PIXELS", "100000000")

_MODULES = {
    "gvo.backend.window": ("SlidingWindow",),
    "gvo.config": ("Config", "WindowConfig", "load_configuration"),
    "gvo.diagnostics.check.recording": ("check_recording",),
    "gvo.errors": ("GvoError",),
    "gvo.frontend.protocol": ("Frontend",),
    "gvo.geometry.camera": ("PinholeCamera", "StereoCamera"),
    "gvo.odometry.loops": ("LoopDetector",),
    "gvo.odometry.odometry": ("Odometry",),
    "gvo.io.convert.convert": ("convert",),
    "gvo.viz.plots": ("plot_trajectories",),
    "gvo.io.poses.inputs": ("evaluate", "read_ground_truth"),
    "gvo.runs.outputs.options": ("RunOutputs",),
    "gvo.runs.result": ("RunResult",),
    "gvo.runs.run": ("run_recording",),
    "gvo.runs.smooth": ("optimize", "smooth_edges"),
    "gvo.io.edges.opening": ("open_edges",),
    "gvo.io.excerpt": ("Excerpt",),
    "gvo.io.frames": ("Rig", "frames"),
    "gvo.io.opening": ("RecordingOptions", "open_recording"),
    "gvo.io.synthetic": ("SyntheticRecording",),
    "gvo.trajectory.evaluation": ("Evaluation", "format_evaluations"),
    "gvo.trajectory.formats": ("read_trajectory",),
    "gvo.trajectory.trajectory": ("Trajectory",),
    "gvo.types": (
        *("Edge", "Estimate", "Failure", "FaultyFrame", "FrameResult", "GraphEdge", "Loop"),
        *("MotionPrior", "Optimum", "PosePrior", "PositionPrior", "Rejected", "RelativePose"),
        *("RgbdFrame", "Status", "StereoFrame"),
    ),
}
_MODULE_OF = {name: module for module, names in _MODULES.items() for name in names}

__all__ = sorted(["__version__", *_MODULE_OF])


def __getattr__(name: str) -> object:
    """Load a public name from its module."""
    if name not in _MODULE_OF:
        raise AttributeError(f"module 'gvo' has no attribute {name!r}")
    return getattr(import_module(_MODULE_OF[name]), name)


def __dir__() -> list[str]:
    """List the public names."""
    return sorted(__all__)
