"""Images that a camera or its driver gives again, with another stamp."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np

from gvo.errors import GvoError
from gvo.types import FaultyFrame, Frame, ImageArray, StereoFrame

_ROW_STEP = 64


def refuse_repeats(
    items: Iterable[Frame | FaultyFrame], names: tuple[str, str]
) -> Iterator[Frame | FaultyFrame]:
    """Make frames faulty whose image is, pixel by pixel, that of the frame before.

    No sensor gives the same noise twice: such an image is old. Taken for a new one, it says for
    sure that the camera stood still. Two in a row make a camera that hangs; a single one, which
    many drivers give now and then, is let through. Depth images are not compared: some sensors
    give depth at a lower rate than colour. Nor are images of one value, in which nothing is seen
    anyway.

    Parameters
    ----------
    items : iterable of StereoFrame, RgbdFrame or FaultyFrame
    names : tuple of two str
        Of the streams.

    Yields
    ------
    StereoFrame, RgbdFrame or FaultyFrame
        All of them, in their order.

    Raises
    ------
    GvoError
        What reading the items raises, after those read before.
    """
    last: Frame | None = None
    waiting: list[Frame | FaultyFrame] = []  # from the first repeat on
    is_hanging = False
    try:
        for item in items:
            if isinstance(item, FaultyFrame):
                waiting.append(item)
                if not _holds_frame(waiting):
                    yield waiting.pop()
                continue
            repeated = _repeated(last, item, names)
            waiting.append(item)
            if repeated and not is_hanging and not _holds_frame(waiting[:-1]):
                continue
            is_hanging = bool(repeated)
            for frame in waiting:
                yield _refused(frame, repeated) if repeated else frame
            waiting.clear()
            last = last if repeated else item
    except GvoError:
        yield from waiting
        raise
    yield from waiting


def _holds_frame(items: Iterable[Frame | FaultyFrame]) -> bool:
    return any(not isinstance(item, FaultyFrame) for item in items)


def _refused(item: Frame | FaultyFrame, name: str) -> FaultyFrame:
    if isinstance(item, FaultyFrame):
        return item
    reason = (
        f"the {name} image is that of the frame before, pixel by pixel: the camera hangs (one "
        "without noise that stands still: --set sync.repeated_images=keep)"
    )
    return FaultyFrame(stamp_ns=item.stamp_ns, reason=reason)


def _repeated(last: Frame | None, frame: Frame, names: tuple[str, str]) -> str:
    """Name the first stream that shows the same as before; empty where none does."""
    if last is None:
        return ""
    for name, before, now in zip(names, _images(last), _images(frame), strict=False):
        if _is_same(before, now):
            return name
    return ""


def _images(frame: Frame) -> tuple[ImageArray, ...]:
    return (frame.left, frame.right) if isinstance(frame, StereoFrame) else (frame.image,)


def _is_same(first: ImageArray, second: ImageArray) -> bool:
    # a few rows mostly tell
    if not np.array_equal(first[::_ROW_STEP], second[::_ROW_STEP]):
        return False
    return np.array_equal(first, second) and bool(np.any(first != first[0, 0]))
