"""Pictures of a frame that the page shows beside the overlay."""

from __future__ import annotations

import cv2
import numpy as np

from gvo.geometry.camera import PinholeCamera
from gvo.types import ImageArray
from gvo.viz.overlay import draw_matches

MAX_WIDTH_PX = 480


def draw_fault(camera: PinholeCamera, reason: str) -> ImageArray:
    """Return a dark picture that tells why there is no frame, BGR."""
    none = np.zeros((0, 2))
    dark = np.full((camera.height, camera.width), 40, dtype=np.uint8)
    return draw_matches(
        dark, none, none, np.zeros(0, dtype=np.bool_), lines=[f"no frame: {reason}"]
    )


def small_picture(image: ImageArray) -> ImageArray:
    """Return a grey or BGR image as BGR, at most 480 pixels wide."""
    height, width = image.shape[:2]
    if width > MAX_WIDTH_PX:
        size = MAX_WIDTH_PX, max(round(height * MAX_WIDTH_PX / width), 1)
        image = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
    if image.ndim == 2:
        image = np.asarray(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR), dtype=np.uint8)
    return image
