"""The report in a real browser: from disk, alone, all to be seen, nothing on one another."""

from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from gvo.io.run_folder.reader import read_run
from gvo.io.synthetic import SyntheticRecording
from gvo.viz.report import write_run_report
from tests.conftest import run_of
from tests.viz.browser import Browser
from tests.viz.browser_checks import changed_share, cut_texts, n_colours, overlapping_texts

if TYPE_CHECKING:
    from selenium.webdriver.remote.webelement import WebElement

pytestmark = pytest.mark.browser

SECTIONS = 11
"""Sections with a plot, at least: the paths, errors, drift, covariance, counts, times, edges."""

_SHOWN = """
return [...document.querySelectorAll('section[id]')].map(section => {
  const seen = [...section.querySelectorAll('.panel > svg, canvas, p.absent')]
    .map(e => e.getBoundingClientRect()).filter(b => b.width > 150 && b.height > 15);
  return [section.id, seen.length];
});
"""

_TEXT_SIZES = """
return [...document.querySelectorAll('.panel > svg text')]
  .filter(e => e.getBoundingClientRect().height > 0)
  .map(e => [parseFloat(getComputedStyle(e).fontSize), e.getScreenCTM()])
  .map(([size, M]) => size * Math.hypot(M.c, M.d));
"""


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("short")
    source = SyntheticRecording("handheld", "rgbd", n_frames=20, scale=0.5)
    run_of(source, out)
    write_run_report(out / "report.html", read_run(out))
    return out / "report.html"


def _shown(browser: Browser) -> dict[str, int]:
    found = browser.run(_SHOWN)
    assert isinstance(found, list)
    return {str(name): int(count) for name, count in found}


def _drawings(browser: Browser) -> "list[WebElement]":
    return [svg for svg in browser.all(".panel > svg") if svg.is_displayed()]


def test_the_report_stands_alone_and_shows_every_plot(browser: Browser, report: Path) -> None:
    browser.open_file(report)
    others = [url for url in browser.requests() if not url.startswith(("data:", "blob:"))]
    assert others == [report.as_uri()]
    assert browser.requests_leaving() == []
    assert browser.console_errors() == []
    shown = _shown(browser)
    assert len(shown) >= SECTIONS
    assert min(shown.values()) >= 1, f"not to be seen: {shown}"


def test_on_a_narrow_screen_plots_can_be_read(browser: Browser, report: Path) -> None:
    browser.open_file(report)
    narrow = {"width": 420, "height": 900, "deviceScaleFactor": 1, "mobile": False}
    browser.driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", narrow)
    try:
        assert browser.run("return document.documentElement.scrollWidth <= innerWidth")
        sizes = browser.run(_TEXT_SIZES)
    finally:
        browser.driver.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})
    assert isinstance(sizes, list)
    assert len(sizes) > 50
    assert min(sizes) > 6.4


@pytest.mark.acceptance
def test_no_text_of_a_plot_lies_on_another_or_is_cut_off(browser: Browser, report: Path) -> None:
    browser.open_file(report)
    drawings = _drawings(browser)
    # The paths in space are a canvas; a run of a second says nothing of its covariances.
    assert len(drawings) >= SECTIONS - 2
    for svg in drawings:
        name = svg.get_attribute("aria-label")
        assert overlapping_texts(browser, svg) == [], name
        assert cut_texts(browser, svg) == [], name


@pytest.mark.acceptance
def test_the_paths_in_space_turn_when_dragged(browser: Browser, report: Path) -> None:
    browser.open_file(report)
    canvas = browser.all("canvas")[0]
    before = browser.picture(canvas)
    assert n_colours(before) > 4, "the canvas is blank"
    browser.drag(canvas, 120, 40)
    assert changed_share(before, browser.picture(canvas)) > 0.002
    assert browser.console_errors() == []


@pytest.mark.acceptance
def test_print_shows_all_that_the_page_shows(browser: Browser, report: Path) -> None:
    browser.open_file(report)
    on_screen = _shown(browser)
    with browser.in_print():
        assert _shown(browser) == on_screen
        for svg in _drawings(browser):
            assert overlapping_texts(browser, svg) == [], svg.get_attribute("aria-label")
