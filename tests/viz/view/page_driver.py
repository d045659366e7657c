"""The page of `gvo view` as a person uses it: what is written on it, buttons, controls."""

from typing import TYPE_CHECKING

from tests.viz.browser import Browser, Picture

if TYPE_CHECKING:
    from selenium.webdriver.remote.webelement import WebElement

_TITLES = "div, span, p, h1, h2, h3, h4, button"
_INTO_VIEW = "arguments[0].scrollIntoView({block: 'center', inline: 'nearest'})"
_WITH_TEXT = """
const [tags, text] = arguments;
return [...document.querySelectorAll(tags)].filter(e => e.textContent.trim() === text
  && e.getClientRects().length > 0);
"""


class ViewPage:
    """The page of a recording or of a run in a browser."""

    def __init__(self, browser: Browser, url: str) -> None:
        self.browser = browser
        browser.open(url)
        browser.wait(
            lambda: self._with_text("button", "play"), message="the page has no button play"
        )
        browser.wait(lambda: self.cell("frame"), message="the page shows no numbers")

    def _with_text(self, tags: str, text: str) -> list["WebElement"]:
        found = self.browser.run(_WITH_TEXT, tags, text)
        assert isinstance(found, list)
        return found

    def cell(self, name: str) -> str:
        """Return what the page says of a frame; empty where it says nothing."""
        found = self.browser.run(
            'const e = document.querySelector(`[data-gvo="${arguments[0]}"]`);'
            "return e ? e.textContent : '';",
            name,
        )
        return str(found).strip()

    def number(self, name: str) -> int:
        """Return the first number of a cell; -1 where it has none yet."""
        first = self.cell(name).split(" ")[0]
        return int(first) if first.isdigit() else -1

    def press(self, text: str) -> None:
        self._click("button", text)

    def unfold(self, *titles: str) -> None:
        """Open folders, the outer one first."""
        for title in titles:
            self._click(_TITLES, title)

    def _click(self, tags: str, text: str) -> None:
        """Click the innermost element with a text, as soon as it stands still."""
        from selenium.common.exceptions import ElementClickInterceptedException as Covered
        from selenium.common.exceptions import ElementNotInteractableException as Moving

        last: object = None

        def click() -> bool:
            nonlocal last
            found = self._with_text(tags, text)
            if not found:
                return False
            self.browser.run(_INTO_VIEW, found[-1])
            before, last = last, found[-1].rect
            if before != last:  # a folder that opens moves what is below
                return False
            try:
                found[-1].click()
            except (Moving, Covered):
                return False
            return True

        self.browser.wait(click, message=f"nothing to click with the text {text}")

    def control(self, label: str) -> "WebElement":
        found = self.browser.wait(
            lambda: self._with_text("label", label), message=f"no control {label}"
        )[0]
        self.browser.run(_INTO_VIEW, found)
        return self.browser.driver.find_element("id", str(found.get_attribute("for")))

    def field(self, label: str) -> "WebElement":
        """Return the field of a control that holds a number, a slider's or one of its own."""
        control = self.control(label)
        if control.tag_name == "input":
            return control
        return control.find_element("xpath", "following-sibling::*//input")

    def type_number(self, label: str, value: str) -> None:
        """Put a number into the field of a control, in one go as if it were pasted."""
        from selenium.webdriver import Keys

        self.field(label).send_keys(Keys.CONTROL, "a")
        self.browser.driver.execute_cdp_cmd("Input.insertText", {"text": value})

    def canvas(self) -> "WebElement":
        return max(self.browser.all("canvas"), key=lambda canvas: canvas.size["width"])

    def scene(self) -> Picture:
        """Return what is seen of the scene below the message that the graphics are software."""
        seen = self.browser.picture(self.canvas())
        return seen[len(seen) // 4 :]

    def wait_for_frame(self, index: int) -> None:
        self.browser.wait(
            lambda: self.number("frame") == index,
            message=f"frame {index} was not shown, but {self.cell('frame')}",
        )
