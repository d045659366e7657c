"""`gvo view` in a real browser: it plays, a parameter changes the next frame, nothing leaks."""

from collections.abc import Iterator

import pytest

from gvo.config import Config, load_configuration
from gvo.io.synthetic import SyntheticRecording
from gvo.viz.view import serve
from gvo.viz.view.player import Player
from tests.viz.browser import Browser
from tests.viz.browser_checks import changed_share, n_colours
from tests.viz.view.page_driver import ViewPage

pytestmark = [pytest.mark.acceptance, pytest.mark.browser]

N_FRAMES = 20


def _long_recording(config: Config) -> SyntheticRecording:
    """Return so many frames that a pause comes before the end; they are rendered as asked for."""
    return SyntheticRecording("driving", "stereo", n_frames=100 * N_FRAMES, scale=0.5)


@pytest.fixture
def player() -> Iterator[Player]:
    with Player(_long_recording, Config()) as running:
        yield running


@pytest.fixture
def page(browser: Browser, player: Player) -> Iterator[ViewPage]:
    with serve(player, port=0) as view:
        yield ViewPage(browser, view.url)
        assert browser.requests_leaving() == []
        assert browser.console_errors() == []


def test_it_plays_pauses_and_steps(page: ViewPage, player: Player) -> None:
    page.wait_for_frame(0)  # shown without being asked for
    first = page.scene()
    page.press("play")
    page.browser.wait(lambda: page.number("frame") >= 5, message="it does not play")
    page.press("pause")
    assert player.wait(10.0)
    at = player.newest.n_done - 1
    page.wait_for_frame(at)
    assert 5 <= at < player.n_frames - 1
    assert not player.is_playing
    later = page.scene()
    assert n_colours(later) > 20
    assert changed_share(first, later) > 0.01

    page.press("step")
    page.wait_for_frame(at + 1)
    assert player.newest.n_done == at + 2


def test_a_parameter_changes_the_next_frame_and_is_saved(page: ViewPage, player: Player) -> None:
    page.wait_for_frame(0)  # shown without being asked for
    before = page.number("keypoints")
    assert before > 100, "too few keypoints to halve them"

    page.unfold("Parameters", "klt")
    page.type_number("n_corners", str(before // 2))
    page.press("step")
    page.wait_for_frame(1)
    assert player.config.klt.n_corners == before // 2
    assert 0 < page.number("keypoints") <= 0.6 * before
    assert page.cell("message") == ""

    page.type_number("n_corners", "1")  # below its range
    page.browser.wait(lambda: "n_corners" in page.cell("message"), message="1 is not refused")
    assert player.config.klt.n_corners == before // 2
    shown = str(before // 2)
    page.browser.wait(
        lambda: page.field("n_corners").get_attribute("value") == shown,
        message="the value that holds is not shown again",
    )

    page.type_number("n_corners", "120")
    page.press("save as YAML")
    path = page.browser.downloads / "gvo.yaml"
    page.browser.wait(path.exists, message="nothing was saved")
    saved = load_configuration(path)
    assert saved.klt.n_corners == 120
    assert saved == player.config

    page.type_number("first frame", "5")
    page.press("restart")
    page.browser.wait(lambda: player.newest.first_index == 5, message="it does not start again")
    page.wait_for_frame(5)
