"""A finished run is played by its stamps."""

from collections.abc import Iterator

import numpy as np
import pytest

from gvo.viz.view.finished import RunPlayer

STAMPS = np.array([0, 100, 200, 500, 600], dtype=np.int64) * 1_000_000


@pytest.fixture
def shown() -> list[int]:
    """Frames in the order in which they were shown."""
    return []


@pytest.fixture
def player(shown: list[int]) -> Iterator[RunPlayer]:
    """At the first frame, its own clock too slow to matter."""
    opened = RunPlayer(STAMPS, shown.append, period_s=3600.0)
    yield opened
    opened.close()


def test_frames_follow_by_their_stamps(player: RunPlayer, shown: list[int]) -> None:
    player.play()
    for _ in range(12):
        player.advance(0.05)
    assert list(dict.fromkeys(shown)) == [1, 2, 3, 4]
    assert not player.is_playing


def test_a_gap_lasts_as_long_as_it_did(player: RunPlayer) -> None:
    player.seek(2)
    player.play()
    player.advance(0.29)
    assert player.index == 2
    player.advance(0.011)
    assert player.index == 3


def test_twice_as_fast_takes_half_the_time(player: RunPlayer) -> None:
    player.set_speed(2.0)
    player.play()
    player.advance(0.11)
    assert player.index == 2


def test_the_fastest_shows_every_frame(player: RunPlayer, shown: list[int]) -> None:
    player.set_speed(None)
    player.play()
    for _ in range(4):
        player.advance(1e-6)
    assert shown == [1, 2, 3, 4]


def test_playing_at_the_end_begins_again(player: RunPlayer, shown: list[int]) -> None:
    player.seek(4)
    player.play()
    assert shown == [4, 0]
    assert player.is_playing


def test_a_step_pauses(player: RunPlayer) -> None:
    player.play()
    player.step()
    assert (player.index, player.is_playing) == (1, False)
    player.advance(10.0)
    assert player.index == 1


@pytest.mark.parametrize(("index", "reached"), [(-3, 0), (99, 4), (2, 2)])
def test_seeking_stays_within_the_run(player: RunPlayer, index: int, reached: int) -> None:
    player.seek(index)
    assert player.index == reached
