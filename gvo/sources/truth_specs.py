"""How poses inside of a bag are named: `tf:PARENT:CHILD`, or a topic."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias

from gvo.bounded_text import exists
from gvo.errors import TrajectoryError
from gvo.sources.tf_paths import bare

_KINDS = "a file of poses, tf:PARENT:CHILD, or a topic (/NAME, or topic:NAME)"


@dataclass(frozen=True, slots=True, kw_only=True)
class TfTruth:
    """The poses of one frame of `/tf` in another.

    Parameters
    ----------
    parent, child : str
        T_parent_child is the pose.
    """

    parent: str
    child: str


@dataclass(frozen=True, slots=True, kw_only=True)
class TopicTruth:
    """The poses or positions of one topic.

    Parameters
    ----------
    name : str
    """

    name: str


@dataclass(frozen=True, slots=True, kw_only=True)
class FileTruth:
    """The poses of a file or of another recording.

    Parameters
    ----------
    path : Path
    """

    path: Path


BagTruthSpec: TypeAlias = TfTruth | TopicTruth
TruthSpec: TypeAlias = BagTruthSpec | FileTruth


def parse_truth(text: str) -> TruthSpec:
    """Read what `--ground-truth` names.

    Parameters
    ----------
    text : str
        A path, which wins where it exists; `tf:PARENT:CHILD`; `/TOPIC` or `topic:TOPIC`.

    Raises
    ------
    TrajectoryError
        Where it is none of them.

    Examples
    --------
    >>> parse_truth("tf:map:base_link")
    TfTruth(parent='map', child='base_link')
    >>> parse_truth("/vicon/drone")
    TopicTruth(name='/vicon/drone')
    """
    if exists(Path(text)):
        return FileTruth(path=Path(text))
    spec = parse_bag_truth(text) if text.startswith(("tf:", "topic:", "/")) else None
    if spec is None:
        raise TrajectoryError(f"{text}: there is no such file; expected {_KINDS}")
    return spec


def parse_bag_truth(text: str) -> BagTruthSpec:
    """Read what names poses inside of a bag: `tf:PARENT:CHILD`, `topic:NAME` or a topic.

    Raises
    ------
    TrajectoryError
        Where there is a part too few or too many.
    """
    kind, _, rest = text.partition(":")
    if kind == "tf" and rest:
        names = [bare(name) for name in rest.split(":")]
        if len(names) != 2 or not all(names) or names[0] == names[1]:
            raise TrajectoryError(f"{text}: expected two frames, as in tf:map:base_link")
        return TfTruth(parent=names[0], child=names[1])
    name = rest if kind == "topic" else text
    if not name.strip("/"):
        raise TrajectoryError(f"{text!r} names no topic; expected tf:PARENT:CHILD or a topic")
    return TopicTruth(name=name)
