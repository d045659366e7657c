"""The tree of frames that a recording's `/tf` and `/tf_static` hold, without ROS."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from typing import Any

from gvo.errors import RecordingError
from gvo.io.bag.reader import OLD_TF_TYPE, TF_TYPE, MessageReader
from gvo.io.poses.tf_buffer import TfBuffer
from gvo.io.poses.tf_paths import ancestors, bare

__all__ = ["TF_TYPES", "TfBuffer", "read_tf"]

TF_TYPES = (TF_TYPE, OLD_TF_TYPE)
"""Message types that hold transforms between named frames."""

# About 14 MB: up to here all transforms are kept, beyond it what was asked for.
_N_KEPT_WHOLE = 200_000


def read_tf(reader: MessageReader, *, frames: Collection[str] | None = None) -> TfBuffer:
    """Read the transforms of a recording.

    All topics of type `tf2_msgs/TFMessage` or `tf/tfMessage` are read. Those of topics whose name
    ends in `tf_static` are static.

    Parameters
    ----------
    reader : MessageReader
    frames : collection of str, optional
        The frames that will be looked up. Of a long recording only what lies above them in the
        tree is kept, so that the memory stays small.

    Returns
    -------
    TfBuffer
        Messages that hold no transforms are counted there as refused.

    Raises
    ------
    RecordingError
        When the bag cannot be read on.
    """
    kept: set[str] | None = None
    while True:
        buffer = TfBuffer()
        if kept is not None:
            buffer.keep(kept)
        for message, is_static in _transforms(reader, buffer):
            buffer.add_message(message, is_static=is_static)
            if frames is not None and kept is None and len(buffer) > _N_KEPT_WHOLE:
                kept = _above(buffer, frames)
                buffer.keep(kept)
        if kept is None or frames is None or _above(buffer, frames) <= kept:
            return buffer
        # The tree grew upwards after transforms were left out: once more, with all it needs.
        kept = _above(buffer, frames)


def _above(buffer: TfBuffer, frames: Collection[str]) -> set[str]:
    return ancestors(buffer.edges, map(bare, frames))


def _transforms(reader: MessageReader, buffer: TfBuffer) -> Iterator[tuple[Any, bool]]:
    """Yield the transforms of all topics, and whether they are static."""
    names = [topic.name for topic in reader.topics if topic.type in TF_TYPES]
    for message in reader.messages(names) if names else ():
        if message.topic.type not in TF_TYPES:
            continue
        is_static = message.topic.name.rstrip("/").endswith("tf_static")
        try:
            transforms = message.decode().transforms
        except RecordingError as error:
            buffer.refuse(str(error))
            continue
        for transform in transforms:
            yield transform, is_static
