"""A real browser for the tests of pages: Debian's chromium without a window, driven by selenium.

What leaves the machine is seen twice: in the browser's own log of requests, and by a proxy that
the browser must use for every host but its own. The proxy also sees what workers ask for, and lets
nothing through.
"""

import json
import shutil
import socketserver
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar
from urllib.parse import urlsplit

import cv2
import numpy as np
import numpy.typing as npt
import pytest

if TYPE_CHECKING:
    from selenium.webdriver import Chrome
    from selenium.webdriver.remote.webelement import WebElement

Picture = npt.NDArray[np.uint8]
Value = TypeVar("Value")

FLAGS = (
    "--headless=new",
    "--no-sandbox",
    "--disable-dev-shm-usage",
    # WebGL on a machine without a graphics card.
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist",
    # A browser that says nothing of its own accord.
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-default-apps",
    "--disable-sync",
    "--disable-quic",
    "--disable-features=AutofillServerCommunication,OptimizationHints,MediaRouter,Translate",
    "--gaia-url=http://127.0.0.1:9/",
    "--no-first-run",
    "--no-default-browser-check",
    "--window-size=1400,900",
    "--force-device-scale-factor=1",
)
INSTALL = "apt-get install -y --no-install-recommends chromium chromium-driver"
# Asked by chromium itself after a minute, whatever it shows; a page that asked would be in the log.
BROWSERS_OWN = ("update.googleapis.com", "gvt1.com")
LOCAL_SCHEMES = {"file", "data", "blob", "about", "chrome", "chrome-extension", "devtools"}
LOCAL_HOSTS = {"127.0.0.1", "localhost", "::1"}

_BOX_IN_VIEW = """
arguments[0].scrollIntoView({block: 'nearest', inline: 'nearest'});
const box = arguments[0].getBoundingClientRect();
return [box.left, box.top, box.right, box.bottom];
"""


class Browser:
    """One chromium, and what it asked for and complained about since a page was opened."""

    def __init__(self, driver: "Chrome", refused: list[str], downloads: Path) -> None:
        self.driver = driver
        self.downloads = downloads
        self._refused = refused
        self._requests: list[str] = []
        self._complaints: list[str] = []

    def open(self, url: str) -> None:
        """Open a page and forget what was logged before."""
        self.driver.get("about:blank")
        self._read_logs()
        self._requests.clear()
        self._complaints.clear()
        self._refused.clear()
        self.driver.get(url)

    def open_file(self, path: Path) -> None:
        self.open(path.resolve().as_uri())

    def requests(self) -> list[str]:
        """List every address asked for since the page was opened."""
        self._read_logs()
        return list(self._requests)

    def console_errors(self) -> list[str]:
        """List the errors in the console since the page was opened."""
        self._read_logs()
        return list(self._complaints)

    def _read_logs(self) -> None:
        for entry in self.driver.get_log("performance"):  # type: ignore[no-untyped-call]
            message = json.loads(entry["message"])["message"]
            if message["method"] == "Network.requestWillBeSent":
                self._requests.append(message["params"]["request"]["url"])
            elif message["method"] == "Network.webSocketCreated":
                self._requests.append(message["params"]["url"])
        for entry in self.driver.get_log("browser"):  # type: ignore[no-untyped-call]
            if entry["level"] == "SEVERE":
                self._complaints.append(entry["message"])

    def requests_leaving(self) -> list[str]:
        """List the addresses asked for that are not on this machine."""
        refused = [
            request for request in self._refused if not any(own in request for own in BROWSERS_OWN)
        ]
        return [url for url in self.requests() if leaves_the_machine(url)] + refused

    def wait(
        self, condition: Callable[[], Value], *, message: str = "", seconds: float = 30.0
    ) -> Value:
        from selenium.common.exceptions import StaleElementReferenceException
        from selenium.webdriver.support.ui import WebDriverWait

        waiting = WebDriverWait(
            self.driver,
            seconds,
            poll_frequency=0.05,
            ignored_exceptions=(StaleElementReferenceException,),
        )
        return waiting.until(lambda _: condition(), message)

    def all(self, selector: str) -> list["WebElement"]:
        """Return the elements of a CSS selector."""
        return self.driver.find_elements("css selector", selector)

    def text(self) -> str:
        return str(self.driver.execute_script("return document.body.innerText"))

    def run(self, script: str, *arguments: object) -> object:
        """Run JavaScript in the page and return its answer."""
        return self.driver.execute_script(script, *arguments)

    def picture(self, element: "WebElement | None" = None) -> Picture:
        """Return what is seen of an element, or of the window, uint8, shape (h, w, 3), BGR.

        It is cut out of the window: selenium's own picture of an element scrolls all around it.
        """
        box = None if element is None else self.run(_BOX_IN_VIEW, element)
        seen = np.frombuffer(self.driver.get_screenshot_as_png(), np.uint8)
        decoded = cv2.imdecode(seen, cv2.IMREAD_COLOR)
        assert decoded is not None
        if box is not None:
            assert isinstance(box, list)
            left, top, right, below = (max(0, round(edge)) for edge in box)
            decoded = decoded[top:below, left:right]
        return decoded.astype(np.uint8)

    def drag(self, element: "WebElement", right: int, down: int) -> None:
        """Press on the middle of an element, move, and let go."""
        from selenium.webdriver import ActionChains

        ActionChains(self.driver, duration=50).click_and_hold(element).move_by_offset(
            right, down
        ).release().perform()

    @contextmanager
    def in_print(self) -> Iterator[None]:
        """Show the page as the printer would."""
        self.driver.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": "print"})
        try:
            yield
        finally:
            self.driver.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": ""})


def leaves_the_machine(url: str) -> bool:
    """Tell whether an address is neither of this machine nor inside the page."""
    parts = urlsplit(url)
    return parts.scheme not in LOCAL_SCHEMES and parts.hostname not in LOCAL_HOSTS


def programs() -> tuple[str, str]:
    """Return where chromium and its driver are; skip without them."""
    try:
        import selenium  # noqa: F401
    except ModuleNotFoundError:
        pytest.skip("no selenium: pip install 'gvo[test-all]'")
    chromium, driver = shutil.which("chromium"), shutil.which("chromedriver")
    if chromium is None or driver is None:
        pytest.skip(f"no chromium or no chromedriver: {INSTALL}")
    return chromium, driver


@contextmanager
def refusing_proxy() -> Iterator[tuple[int, list[str]]]:
    """Serve a proxy that lets nothing through; give its port and the requests it refused."""
    refused: list[str] = []

    class Handler(socketserver.StreamRequestHandler):
        def handle(self) -> None:
            refused.append(self.rfile.readline().decode("latin-1").strip())
            self.wfile.write(b"HTTP/1.1 403 Forbidden\r\nContent-Length: 0\r\n\r\n")

    class Server(socketserver.ThreadingTCPServer):
        daemon_threads = True

    with Server(("127.0.0.1", 0), Handler) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        try:
            yield server.server_address[1], refused
        finally:
            server.shutdown()
            thread.join()


@contextmanager
def chromium(folder: Path) -> Iterator[Browser]:
    """Run one chromium with its profile and its downloads in a folder of its own."""
    program, driver_program = programs()
    from selenium.webdriver import Chrome, ChromeOptions
    from selenium.webdriver.chrome.service import Service

    downloads = folder / "downloads"
    downloads.mkdir()
    options = ChromeOptions()
    options.binary_location = program
    options.set_capability("goog:loggingPrefs", {"performance": "ALL", "browser": "ALL"})
    options.add_experimental_option("perfLoggingPrefs", {"enablePage": False})
    options.add_experimental_option("prefs", {"download.default_directory": str(downloads)})
    with refusing_proxy() as (port, refused):
        profile = f"--user-data-dir={folder / 'profile'}"
        for flag in (*FLAGS, profile, f"--proxy-server=http://127.0.0.1:{port}"):
            options.add_argument(flag)
        with pytest.MonkeyPatch.context() as patch:
            patch.setenv("no_proxy", "localhost")  # the driver is here, whatever proxy is set
            # A path to the driver keeps selenium from looking for one on the net.
            driver = Chrome(options=options, service=Service(executable_path=driver_program))
        try:
            yield Browser(driver, refused, downloads)
        finally:
            driver.quit()
