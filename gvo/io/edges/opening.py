"""Recognise what kind of edges a path holds."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from gvo._text import access_fault, plain_number, text_lines
from gvo.errors import ConfigurationError, TrajectoryError
from gvo.io.bag.poses import read_streams
from gvo.io.edges.events import EdgeSource, InputFaults
from gvo.io.edges.pose_graph import PoseGraphSource
from gvo.io.edges.pose_streams import FusedChains, PoseStream, StepSigma, read_stream
from gvo.io.opening import BAG_SUFFIXES

_KINDS = (
    "expected a pose graph of g2o, poses (TUM, KITTI, EuRoC and others, see docs/frames.md), or a "
    "bag with topics of poses"
)


def open_edges(
    paths: Sequence[str | Path], *, topics: Sequence[str] = (), sigmas: Sequence[StepSigma] = ()
) -> EdgeSource:
    """Open a pose graph, or one or more odometries of one moving frame.

    Parameters
    ----------
    paths : sequence of str or Path
        One file of g2o; or files of poses and bags, the poses of the first being smoothed.
    topics : sequence of str
        Of the bags; where empty, the only topic of poses of each.
    sigmas : sequence of StepSigma
        For each stream in the order of the inputs, or one for all; the default's where empty. For
        a pose graph one, of the edges whose information matrix is none.

    Returns
    -------
    EdgeSource

    Raises
    ------
    TrajectoryError, RecordingError
        When an input is missing, malformed or holds no poses.
    ConfigurationError
        When the inputs, topics or sigmas do not fit each other.
    """
    inputs = [Path(path) for path in paths]
    for path in inputs:
        if fault := access_fault(path):
            raise TrajectoryError(f"{path}: {fault}; {_KINDS}")
    bags = [path for path in inputs if path.is_dir() or path.suffix in BAG_SUFFIXES]
    if topics and not bags:
        raise ConfigurationError(
            f"--topic {topics[0]}: names a topic of a bag, {inputs[0]} is none"
        )
    graphs = [path for path in inputs if path not in bags and _is_pose_graph(path)]
    if graphs:
        return _open_graph(inputs, graphs[0], sigmas)
    streams: list[PoseStream] = []
    faults = InputFaults()
    for path in inputs:
        streams += read_streams(path, topics, faults) if path in bags else [read_stream(path)]
    return FusedChains(streams, _spread(sigmas, streams), faults)


def parse_sigma(text: str) -> StepSigma:
    """Return the sigmas of `--sigma ROT_DEG,TRANS_M`.

    Parameters
    ----------
    text : str
        Two positive numbers.

    Raises
    ------
    ConfigurationError
        Where it is something else.
    """
    try:
        rotation_deg, translation_m = (float(plain_number(part)) for part in text.split(","))
    except ValueError:
        rotation_deg = translation_m = 0.0
    if not (0 < rotation_deg < np.inf and 0 < translation_m < np.inf):
        raise ConfigurationError(
            f"--sigma {text}: expected degrees and metres of a step, such as 0.1,0.02"
        )
    return StepSigma.fixed(float(np.radians(rotation_deg)), translation_m)


def _open_graph(paths: Sequence[Path], graph: Path, sigmas: Sequence[StepSigma]) -> PoseGraphSource:
    if len(paths) > 1:
        raise ConfigurationError(f"{graph}: a pose graph of g2o is smoothed alone; give one input")
    if len(sigmas) > 1:
        raise ConfigurationError(f"--sigma: {graph} is one input; give it once")
    return PoseGraphSource(graph, *sigmas)


def _spread(sigmas: Sequence[StepSigma], streams: Sequence[PoseStream]) -> list[StepSigma]:
    if len(sigmas) > 1 and len(sigmas) != len(streams):
        names = ", ".join(stream.name for stream in streams)
        raise ConfigurationError(
            f"--sigma is given {len(sigmas)} times for {len(streams)} inputs ({names}); give it "
            "once, or once for each in their order"
        )
    return list(sigmas) if len(sigmas) > 1 else [*(sigmas or [StepSigma()])] * len(streams)


def _is_pose_graph(path: Path) -> bool:
    """Tell by the first word of the file: that of a row of poses is a number.

    A pipe can be read once only, a pose graph is read more often.
    """
    try:
        for _, line in text_lines(path, TrajectoryError) if path.is_file() else ():
            text = line.partition("#")[0].strip()
            if text:
                return text[0].isupper()
    except TrajectoryError:
        return False
    return False
