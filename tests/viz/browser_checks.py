"""What is measured of a page in a browser: texts on one another, pictures that are blank."""

from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from tests.viz.browser import Browser, Picture

if TYPE_CHECKING:
    from selenium.webdriver.remote.webelement import WebElement

Corners = npt.NDArray[np.float64]

# The four corners of each visible text of an SVG on the page: of a slanted text in its own frame,
# for an upright box around it would be too large.
_TEXT_CORNERS = """
const isSeen = t => t.textContent.trim() && getComputedStyle(t).visibility !== 'hidden'
  && t.getClientRects().length > 0;
return [...arguments[0].querySelectorAll('text')].filter(isSeen).map(t => {
  const box = t.getBBox(), frame = t.getScreenCTM();
  const corner = (x, y) => {
    const p = new DOMPoint(x, y).matrixTransform(frame);
    return [p.x + scrollX, p.y + scrollY];
  };
  const right = box.x + box.width, below = box.y + box.height;
  return [t.textContent.trim(), [corner(box.x, box.y), corner(right, box.y),
    corner(right, below), corner(box.x, below)]];
});
"""


def texts_of(browser: Browser, svg: "WebElement") -> list[tuple[str, Corners]]:
    """Return the visible texts of an SVG and their corners on the page, px, shape (4, 2).

    A text's box is as high as its line, the letters are not: a tenth is taken off above and below.
    """
    found = browser.run(_TEXT_CORNERS, svg)
    assert isinstance(found, list)
    return [
        (
            "".join(text.split()) if "\n" in text else text,
            _lower(np.array(corners, dtype=np.float64)),
        )
        for text, corners in found
    ]


def overlapping_texts(
    browser: Browser, svg: "WebElement", *, tolerance_px: float = 1.0
) -> list[str]:
    """Name the pairs of texts of an SVG that lie on one another by more than a tolerance."""
    texts = texts_of(browser, svg)
    return [
        f"{first!r} and {second!r}"
        for at, (first, corners) in enumerate(texts)
        for second, others in texts[at + 1 :]
        if overlap(corners, others) > tolerance_px
    ]


def cut_texts(browser: Browser, svg: "WebElement", *, tolerance_px: float = 1.0) -> list[str]:
    """Name the texts of an SVG that reach out of it by more than a tolerance."""
    box = browser.run(
        "const b = arguments[0].getBoundingClientRect();"
        "return [b.left + scrollX, b.top + scrollY, b.right + scrollX, b.bottom + scrollY];",
        svg,
    )
    left_top, right_below = np.array(box, dtype=np.float64).reshape(2, 2)
    return [
        text
        for text, corners in texts_of(browser, svg)
        if np.any(corners < left_top - tolerance_px) or np.any(corners > right_below + tolerance_px)
    ]


def _lower(corners: Corners) -> Corners:
    down = corners[3] - corners[0]
    return corners + 0.1 * np.array([down, down, -down, -down])


def overlap(first: Corners, second: Corners) -> float:
    """Return how deep two rectangles lie in one another, px; negative where they are apart.

    The depth is the smallest push along a side of either that parts them (separating axes).
    """
    depths = []
    for box in (first, second):
        for side in (box[1] - box[0], box[3] - box[0]):
            length = float(np.hypot(*side))
            if length == 0.0:
                return -np.inf
            a, b = first @ side / length, second @ side / length
            depths.append(min(a.max() - b.min(), b.max() - a.min()))
    return float(min(depths))


def n_colours(picture: Picture) -> int:
    levels = (picture // 16).reshape(-1, 3).astype(np.int64)
    return len(np.unique(levels @ np.array([1, 16, 256])))


def changed_share(before: Picture, after: Picture) -> float:
    """Return the share of pixels that are not the same in two pictures of one size."""
    return float(np.any(before != after, axis=2).mean())
