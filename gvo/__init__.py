"""Visual odometry for calibrated stereo and RGB-D cameras, with a sliding-window back-end.

The public names are loaded when they are first used, so that the command line answers at once.
"""

from importlib import import_module
from typing import TYPE_CHECKING

from gvo._version import __version__

if TYPE_CHECKING:
    from gvo.backend.window import SlidingWindow
    from gvo.config import Config, WindowConfig, load_configuration
    from gvo.diagnostics.check.recording import check_recording
    from gvo.errors import GvoError
    from gvo.frontend.protocol import Frontend
    from gvo.geometry.camera import PinholeCamera, StereoCamera
    from gvo.io.convert.convert import convert
    from gvo.io.edges.opening import open_edges
    from gvo.io.excerpt import Excerpt
    from gvo.io.frames import Rig, frames
    from gvo.io.opening import RecordingOptions, open_recording
    from gvo.io.poses.inputs import read_ground_truth
    from gvo.io.synthetic.recording import SyntheticRecording
    from gvo.odometry.loops import LoopDetector
    from gvo.odometry.odometry import Odometry
    from gvo.runs.outputs.options import RunOutputs
    from gvo.runs.run import RunResult, run_recording
    from gvo.runs.smooth import optimize, smooth_edges
    from gvo.trajectory.evaluation import Evaluation, evaluate, format_evaluations
    from gvo.trajectory.formats import read_trajectory
    from gvo.trajectory.trajectory import Trajectory
    from gvo.types import (
        Edge,
        Estimate,
        Failure,
        FaultyFrame,
        FrameResult,
        GraphEdge,
        Loop,
        MotionPrior,
        Optimum,
        PosePrior,
        PositionPrior,
        Rejected,
        RelativePose,
        RgbdFrame,
        Status,
        StereoFrame,
    )
    from gvo.viz.plots import plot_trajectories

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
    "gvo.io.poses.inputs": ("read_ground_truth",),
    "gvo.runs.outputs.options": ("RunOutputs",),
    "gvo.runs.run": ("RunResult", "run_recording"),
    "gvo.runs.smooth": ("optimize", "smooth_edges"),
    "gvo.io.edges.opening": ("open_edges",),
    "gvo.io.excerpt": ("Excerpt",),
    "gvo.io.frames": ("Rig", "frames"),
    "gvo.io.opening": ("RecordingOptions", "open_recording"),
    "gvo.io.synthetic.recording": ("SyntheticRecording",),
    "gvo.trajectory.evaluation": ("Evaluation", "evaluate", "format_evaluations"),
    "gvo.trajectory.formats": ("read_trajectory",),
    "gvo.trajectory.trajectory": ("Trajectory",),
    "gvo.types": (
        "Edge",
        "Estimate",
        "Failure",
        "FaultyFrame",
        "FrameResult",
        "GraphEdge",
        "Loop",
        "MotionPrior",
        "Optimum",
        "PosePrior",
        "PositionPrior",
        "Rejected",
        "RelativePose",
        "RgbdFrame",
        "Status",
        "StereoFrame",
    ),
}
_MODULE_OF = {name: module for module, names in _MODULES.items() for name in names}

__all__ = [
    "Config",
    "Edge",
    "Estimate",
    "Evaluation",
    "Excerpt",
    "Failure",
    "FaultyFrame",
    "FrameResult",
    "Frontend",
    "GraphEdge",
    "GvoError",
    "Loop",
    "LoopDetector",
    "MotionPrior",
    "Odometry",
    "Optimum",
    "PinholeCamera",
    "PosePrior",
    "PositionPrior",
    "RecordingOptions",
    "Rejected",
    "RelativePose",
    "RgbdFrame",
    "Rig",
    "RunOutputs",
    "RunResult",
    "SlidingWindow",
    "Status",
    "StereoCamera",
    "StereoFrame",
    "SyntheticRecording",
    "Trajectory",
    "WindowConfig",
    "__version__",
    "check_recording",
    "convert",
    "evaluate",
    "format_evaluations",
    "frames",
    "load_configuration",
    "open_edges",
    "open_recording",
    "optimize",
    "plot_trajectories",
    "read_ground_truth",
    "read_trajectory",
    "run_recording",
    "smooth_edges",
]


def __getattr__(name: str) -> object:
    """Load a public name from its module."""
    if name not in _MODULE_OF:
        raise AttributeError(f"module 'gvo' has no attribute {name!r}")
    return getattr(import_module(_MODULE_OF[name]), name)


def __dir__() -> list[str]:
    """List the public names."""
    return sorted(__all__)
