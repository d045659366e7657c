"""Parts of recordings."""

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from gvo.errors import RecordingError
from gvo.io.excerpt import Excerpt, take_excerpt
from gvo.io.recording import StampedImage
from gvo.io.sync import Pair, pair_images
from gvo.types import FaultyFrame

_SECOND = 1_000_000_000
_FIRST_NS = 1_700_000_000 * _SECOND


def _refuse() -> NDArray[Any]:
    raise AssertionError("an image was decoded")


def _image(stream: int, stamp_ns: int) -> StampedImage:
    return StampedImage(stream=stream, stamp_ns=stamp_ns, load=_refuse)


def _item(stamp_ns: int, *, is_pair: bool = True) -> Pair | FaultyFrame:
    if is_pair:
        return _image(0, stamp_ns), _image(1, stamp_ns)
    return FaultyFrame(stamp_ns=stamp_ns, reason="no depth", is_unpaired=True)


def _stamp_ns(item: Pair | FaultyFrame) -> int:
    return item.stamp_ns if isinstance(item, FaultyFrame) else item[0].stamp_ns


_recordings = st.lists(st.tuples(st.integers(1, 300), st.booleans()), min_size=1, max_size=40).map(
    lambda steps: [
        _item(_FIRST_NS + 10_000_000 * int(since), is_pair=is_pair)
        for since, (_, is_pair) in zip(
            np.cumsum([0, *(step for step, _ in steps)]), steps, strict=False
        )
    ]
)


@given(items=_recordings, cut=st.integers(1, 100), every=st.integers(1, 5))
def test_an_excerpt_is_as_defined(items: list[Pair | FaultyFrame], cut: int, every: int) -> None:
    excerpt = Excerpt(start_s=cut / 10, duration_s=cut / 7, every=every)
    since = [_stamp_ns(item) - _FIRST_NS for item in items]
    inside = [
        item
        for item, stamp in zip(items, since, strict=True)
        if round(cut / 10 * 1e9) <= stamp < round(cut / 10 * 1e9) + round(cut / 7 * 1e9)
    ]
    if not inside:
        with pytest.raises(RecordingError):
            list(take_excerpt(items, excerpt))
        return
    taken = list(take_excerpt(items, excerpt))
    pairs = [item for item in inside if not isinstance(item, FaultyFrame)]
    assert [item for item in taken if not isinstance(item, FaultyFrame)] == pairs[::every]
    assert taken == [item for item in inside if item in taken]
    if every == 1:
        assert taken == inside


def test_a_faulty_frame_is_given_where_a_frame_is_due() -> None:
    kinds = [True, False, True, False, True, False]
    items = [_item(n, is_pair=is_pair) for n, is_pair in enumerate(kinds)]
    taken = take_excerpt(items, Excerpt(every=2))
    assert [_stamp_ns(item) for item in taken] == [0, 3, 4]


@pytest.mark.parametrize("lag", [0, 40])
def test_reading_ends_when_both_streams_are_past_the_end(lag: int) -> None:
    """Depth comes `lag` images late."""
    n_read = 0

    def images() -> Iterator[StampedImage]:
        nonlocal n_read
        for n in range(10_000):
            n_read += 1
            yield _image(0, n * _SECOND)
            if n >= lag:
                yield _image(1, (n - lag) * _SECOND)

    pairs = pair_images(images(), limit_ns=20_000_000, partner="depth")
    assert len(list(take_excerpt(pairs, Excerpt(start_s=20, duration_s=10)))) == 10
    assert n_read == 31 + lag


@pytest.mark.parametrize(
    "options",
    [
        {"start_s": -1.0},
        {"start_s": float("inf")},
        {"duration_s": 0.0},
        {"duration_s": float("nan")},
        {"every": 0},
    ],
)
def test_numbers_out_of_range_are_refused(options: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=f"{next(iter(options))} must be"):
        Excerpt(**options)
