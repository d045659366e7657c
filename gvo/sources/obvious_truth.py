"""Ground truth that a bag holds without being told: by the names of frames and topics."""

from __future__ import annotations

import re
from collections.abc import Sequence

from gvo.sources.bag_reader import BagReader
from gvo.sources.ground_truth import TRUTH_FRAMES, TRUTH_TYPES, BagTruth, read_bag_truth
from gvo.sources.tf import TfBuffer, read_tf
from gvo.sources.topics import Topic
from gvo.sources.truth_specs import TopicTruth
from gvo.types import Failure

# Systems that measure from outside, and what people call their poses. Odometry is none of them.
_WORDS = (
    "ground[_-]?truth",
    "true_?(pose|odom|odometry|state)",
    "gt",
    "vicon",
    "mocap",
    "qualisys",
    "optitrack",
    "leica",
    "vrpn",
)
# a word by itself, or together with others by anything but letters
_IS_TRUTH = re.compile(rf"(?<![a-z])({'|'.join(_WORDS)})(?![a-z])")


def is_named_truth(topic: str) -> bool:
    """Tell whether a topic's name says that it holds true poses.

    Examples
    --------
    >>> [is_named_truth(name) for name in ("/vrpn_client_node/drone/pose", "/gt_pose", "/odom")]
    [True, True, False]
    """
    return _IS_TRUTH.search(topic.lower()) is not None


def find_obvious_truth(
    reader: BagReader, buffer: TfBuffer | None = None, *, where: str
) -> BagTruth | Failure:
    """Find the ground truth that names itself: `world` -> `ground_truth` in tf, or one topic.

    Parameters
    ----------
    reader : BagReader
    buffer : TfBuffer, optional
        Of the bag; read from it where omitted.
    where : str
        The bag, for messages.

    Returns
    -------
    BagTruth or Failure
        The failure says that there is none, or among which topics to choose, and how.

    Raises
    ------
    RecordingError
        When the bag cannot be read on, or what names itself truth holds no pose.
    """
    frames = (TRUTH_FRAMES.parent, TRUTH_FRAMES.child)
    buffer = read_tf(reader, frames=frames) if buffer is None else buffer
    if len(buffer.edge_stamps_ns(*frames)):
        return read_bag_truth(reader, TRUTH_FRAMES, where=where, buffer=buffer)
    candidates = truth_topics(reader.topics)
    if not candidates:
        return Failure(reason="no frame and no topic is named as ground truth")
    if len(candidates) > 1:
        names = ", ".join(f"{topic.name} ({topic.type})" for topic in candidates)
        return Failure(
            reason=f"{len(candidates)} topics are named as ground truth: {names}; choose by "
            f"--ground-truth topic:{candidates[0].name}"
        )
    return read_bag_truth(reader, TopicTruth(name=candidates[0].name), where=where)


def truth_topics(topics: Sequence[Topic]) -> list[Topic]:
    """Return the topics of poses or positions whose names say that they hold the truth."""
    return [
        topic
        for topic in topics
        if topic.type in TRUTH_TYPES and topic.n_messages and is_named_truth(topic.name)
    ]
