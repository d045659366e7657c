"""Plot of what a run learnt of its rig: errors of disparities and pixels over the image."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.figure import Figure

from gvo.config import Config
from gvo.errors import CalibrationError
from gvo.geometry.camera import StereoCamera
from gvo.geometry.rig import LENS
from gvo.io.rig_file import camera_of
from gvo.types import FloatArray
from gvo.viz.figures import HALF, WIDE, Plot, image_height, new_figure
from gvo.viz.report.plots import TITLES

_N_CELLS, _N_ARROWS = 60, 12
# The longest arrow, relative to the distance between two of them.
_LONGEST = 0.8


def rig_plots(rig: object) -> list[Plot]:
    """Return the plot of the errors of a stereo camera as `summary.json` has them, if it has."""
    try:
        camera = camera_of(rig)
    except CalibrationError:
        return []
    if not isinstance(camera, StereoCamera) or camera.rig is None:
        return []
    if not {*LENS} <= {*camera.rig.constants}:
        return []
    from gvo.frontend.offsets import RigOffsets  # loads compiled loops

    held = Config.model_validate({"stereo": {"estimate_offset": False}})
    offsets = RigOffsets(camera, held)
    cells, arrows = (_places(camera, n) for n in (_N_CELLS, _N_ARROWS))
    disparity_px = (cells - offsets.take_off(cells))[:, 2]
    moved = offsets.pixel_errors(arrows)
    figure = _figure(camera, disparity_px, arrows, moved)
    sizes = {"disparity": np.abs(disparity_px).max(), "pixel": np.linalg.norm(moved, axis=1).max()}
    return [Plot(slug="rig", title=TITLES["rig"], figure=figure, facts=sizes)]


def _places(camera: StereoCamera, n: int) -> FloatArray:
    """Return (u, v, 0) of the middles of n columns of square cells, row after row."""
    size = camera.width / n
    n_rows = max(round(camera.height / size), 1)
    u, v = np.meshgrid(
        size * (np.arange(n) + 0.5), (np.arange(n_rows) + 0.5) * camera.height / n_rows
    )
    return np.column_stack([u.ravel(), v.ravel(), np.zeros(u.size)])


def _figure(
    camera: StereoCamera, disparity_px: FloatArray, arrows: FloatArray, moved: FloatArray
) -> Figure:
    shape = camera.height, camera.width
    figure = new_figure(image_height(shape, share=HALF / WIDE) + 1.4, HALF)
    axes: Any = figure.subplots()
    reach = float(np.abs(disparity_px).max()) or 1.0
    image = axes.imshow(
        disparity_px.reshape(-1, _N_CELLS),
        extent=(0, camera.width, camera.height, 0),
        cmap="RdBu_r",
        clim=(-reach, reach),
        interpolation="bilinear",
    )
    figure.colorbar(image, ax=axes, label="disparity too large by [px]", location="bottom")
    longest = float(np.linalg.norm(moved, axis=1).max()) or 1.0
    scale = longest * _N_ARROWS / (_LONGEST * camera.width)
    looks: dict[str, Any] = {"angles": "xy", "scale_units": "xy", "scale": scale, "width": 0.004}
    drawn = axes.quiver(*arrows[:, :2].T, *moved.T, **looks)
    axes.quiverkey(drawn, 0.8, 1.06, longest, f"{longest:.2g} px", labelpos="E")
    axes.set(xlabel="u [px]", ylabel="v [px]")
    axes.grid(visible=False)
    return figure
