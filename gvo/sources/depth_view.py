"""Whether the depth of a bag is seen by the colour camera, and if not, by which."""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np

from gvo.errors import CalibrationError
from gvo.geometry.camera import Calibration, rectification_maps
from gvo.sources.bag_cameras import BagCamera
from gvo.sources.bag_extrinsics import Extrinsics, find_extrinsics
from gvo.sources.bag_reader import BagReader
from gvo.sources.calibration import make_rgbd_calibration
from gvo.sources.recording import DepthView
from gvo.types import Failure

_REGISTERED = re.compile(r"(?<!un)(aligned|registered)")
# Of the focal length and of the image size: calibrations of one camera differ by less.
_TOLERANCE = 0.02
_SAME_PLACE_M = 1e-6
_SAME_PIXEL_PX = 0.5
_REMEDY = "give a topic of depth registered to colour by --depth"


@dataclass(frozen=True, slots=True, kw_only=True)
class DepthChoice:
    """How depth gets to colour.

    Parameters
    ----------
    view : DepthView, optional
        Of depth that has to be registered; None where it is, or where that is not known.
    decisions : tuple of str
        What was found, a line each.
    """

    view: DepthView | None = None
    decisions: tuple[str, ...] = ()


def choose_depth_view(
    reader: BagReader, color: tuple[BagCamera, Calibration], depth: BagCamera
) -> DepthChoice:
    """Tell whether depth has to be registered to colour.

    It is registered already where the name of the topic says so, and where both cameras have one
    frame, one size and the same intrinsics.

    Parameters
    ----------
    reader : BagReader
        The bag; the topics of transforms are read where they are needed.
    color : tuple of BagCamera and Calibration
        The colour camera.
    depth : BagCamera
        The camera that the `CameraInfo` of the depth describes.

    Raises
    ------
    RecordingError
        When the bag cannot be read.
    """
    if _REGISTERED.search(depth.image.base.lower()):
        return DepthChoice()
    camera, color_calibration = color
    try:
        calibration = make_rgbd_calibration(depth.fields, is_rectified=depth.image.is_rectified)
    except CalibrationError as error:
        return DepthChoice(decisions=(f"depth: taken as registered to colour: {error}",))
    difference = _difference(color_calibration, calibration)
    frames = (camera.fields.frame_id, depth.fields.frame_id)
    if frames[0] and frames[0] == frames[1]:
        found: Extrinsics | Failure = Extrinsics(
            T_target_source=np.eye(4), origin=f"one frame {frames[0]}"
        )
    else:
        found = find_extrinsics(reader, camera, depth)
    if isinstance(found, Failure):
        return DepthChoice(decisions=_advice(difference, frames, found))
    if not difference and np.allclose(found.T_target_source, np.eye(4), atol=_SAME_PLACE_M):
        return DepthChoice()
    distance = float(np.linalg.norm(found.T_target_source[:3, 3]))
    line = f"depth: of a camera {distance:.4f} m from colour by {found.origin}, registered to it"
    if difference:
        line += f" ({difference})"
    view = DepthView(calibration=calibration, T_color_depth=found.T_target_source)
    return DepthChoice(view=view, decisions=(line,))


def _difference(color: Calibration, depth: Calibration) -> str:
    """Say how two cameras differ; empty where they do not."""
    if (depth.width, depth.height) != (color.width, color.height):
        return f"images of {depth.width}x{depth.height} pixels, colour {color.width}x{color.height}"
    first, second = color.pinhole(), depth.pinhole()
    for name, limit in (
        ("fx", _TOLERANCE * first.fx),
        ("fy", _TOLERANCE * first.fy),
        ("cx", _TOLERANCE * first.width),
        ("cy", _TOLERANCE * first.height),
    ):
        of_color, of_depth = float(getattr(first, name)), float(getattr(second, name))
        if abs(of_depth - of_color) > limit:
            return f"{name} {of_depth:.1f} against {of_color:.1f} px"
    if not _is_one_lens(color, depth):
        return "another lens"
    return ""


def _is_one_lens(color: Calibration, depth: Calibration) -> bool:
    """Tell whether raw images of both are rectified alike, or need not be rectified."""
    maps = [rectification_maps(camera) for camera in (color, depth)]
    if maps[1] is None or maps[0] is None:
        # Depth without a lens of its own is what drivers give that register it to raw colour.
        return maps[1] is None
    return all(np.allclose(a, b, atol=_SAME_PIXEL_PX) for a, b in zip(*maps, strict=True))


def _advice(difference: str, frames: tuple[str, str], why: Failure) -> tuple[str, ...]:
    if difference:
        return (f"depth: it is not registered to colour ({difference}; {why.reason}): {_REMEDY}",)
    if all(frames):
        return (
            f"depth: taken as registered to colour, though its frame is {frames[1]} and that of "
            f"colour {frames[0]} ({why.reason}); if it is not, {_REMEDY}",
        )
    return ()
