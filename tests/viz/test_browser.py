"""The browser of the tests sees what it is there to see: each check on a page that fails it."""

import re
from pathlib import Path

import numpy as np
import pytest

from tests.viz import browser as browsers
from tests.viz.browser import Browser, leaves_the_machine
from tests.viz.browser_checks import (
    changed_share,
    cut_texts,
    drawn_share,
    n_colours,
    overlapping_texts,
)

pytestmark = [pytest.mark.acceptance, pytest.mark.browser]

LEAKING = """<img src="https://picture.example/a.png">
<style>@import url("https://style.example/a.css");</style>
<script>new Worker(URL.createObjectURL(new Blob([
"fetch('https://worker.example/a').catch(() => 0); new WebSocket('wss://socket.example/a')"
])))</script>"""

TEXTS = """<body style="margin: 0; height: 3000px"><div style="height: 900px"></div>
<svg id="good" width="300" height="100" font-size="12">
  <text x="10" y="20">0.5</text><text x="10" y="34">1.0</text><text x="60" y="20">z [m]</text>
  <text transform="translate(100, 90) rotate(-45)">slanted one</text>
  <text transform="translate(120, 90) rotate(-45)">slanted two</text>
  <text x="10" y="20" visibility="hidden">never seen</text></svg>
<svg id="bad" width="300" height="100" font-size="12">
  <text x="10" y="20">0.5</text><text x="22" y="22">1.0</text>
  <text x="280" y="60">reaches out</text>
</svg></body>"""


def test_every_way_out_of_the_machine_is_seen(browser: Browser, tmp_path: Path) -> None:
    page = tmp_path / "leaking.html"
    page.write_text(LEAKING)
    browser.open_file(page)
    hosts = {f"{name}.example" for name in ("picture", "style", "worker", "socket")}

    def seen() -> set[str]:
        return set(re.findall(r"[a-z]+\.example", " ".join(browser.requests_leaving())))

    browser.wait(lambda: seen() == hosts, message="not every request was seen")


def test_a_page_without_links_asks_for_itself_alone(browser: Browser, tmp_path: Path) -> None:
    page = tmp_path / "quiet.html"
    page.write_text("<link rel='icon' href='data:,'><input id='a'><p>quiet</p>")
    browser.open_file(page)
    browser.all("#a")[0].send_keys("word")
    assert [url for url in browser.requests() if not url.startswith("data:")] == [page.as_uri()]
    assert browser.requests_leaving() == []
    assert browser.console_errors() == []


def test_errors_of_the_page_and_missing_pictures_are_seen(browser: Browser, tmp_path: Path) -> None:
    page = tmp_path / "faulty.html"
    page.write_text("<img src='missing.png'><script>throw new Error('planted')</script>")
    browser.open_file(page)
    errors = " ".join(browser.console_errors())
    assert "missing.png" in errors
    assert "planted" in errors


@pytest.mark.parametrize(
    ("url", "is_outside"),
    [
        ("http://127.0.0.1:8080/", False),
        ("ws://localhost:8080/", False),
        ("data:image/png;base64,AA==", False),
        ("blob:http://127.0.0.1:8080/1-2", False),
        ("file:///home/report.html", False),
        ("https://127.0.0.1.example/", True),
        ("//cdn.example/plot.js", True),
        ("wss://example.org", True),
    ],
)
def test_only_addresses_of_this_machine_stay_on_it(url: str, is_outside: bool) -> None:
    assert leaves_the_machine(url) is is_outside


def test_overlapping_texts_are_named_slanted_ones_are_not(browser: Browser, tmp_path: Path) -> None:
    page = tmp_path / "texts.html"
    page.write_text(TEXTS)
    browser.open_file(page)
    assert overlapping_texts(browser, browser.all("#good")[0]) == []
    assert cut_texts(browser, browser.all("#good")[0]) == []
    assert overlapping_texts(browser, browser.all("#bad")[0]) == ["'0.5' and '1.0'"]
    assert cut_texts(browser, browser.all("#bad")[0]) == ["reaches out"]


def test_a_blank_canvas_is_told_from_a_drawn_one(browser: Browser, tmp_path: Path) -> None:
    page = tmp_path / "canvas.html"
    page.write_text(
        "<canvas id='blank' width='100' height='100'></canvas>"
        "<canvas id='drawn' width='100' height='100'></canvas><script>"
        "const g = document.getElementById('drawn').getContext('webgl');"
        "g.enable(g.SCISSOR_TEST); g.scissor(0, 0, 50, 50); g.clearColor(1, 0, 0, 1);"
        "g.clear(g.COLOR_BUFFER_BIT);</script>"
    )
    browser.open_file(page)
    blank = browser.picture(browser.all("#blank")[0])
    drawn = browser.picture(browser.all("#drawn")[0])
    assert n_colours(blank) == 1
    assert n_colours(drawn) == 2
    assert drawn_share(blank) == 0.0
    np.testing.assert_allclose(drawn_share(drawn), 0.25, atol=0.01)
    np.testing.assert_allclose(changed_share(blank, drawn), 0.25, atol=0.01)


def test_without_chromium_they_are_skipped(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(pytest.skip.Exception, match=r"no chromium.*apt-get install"):
        browsers.programs()
