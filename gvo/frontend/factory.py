"""The front-end that the configuration names."""

from __future__ import annotations

from gvo.config import Config
from gvo.frontend.descriptor import DescriptorFrontend
from gvo.frontend.klt import KltFrontend
from gvo.geometry.camera import PinholeCamera, StereoCamera


def make_frontend(
    camera: StereoCamera | PinholeCamera, config: Config | None = None
) -> DescriptorFrontend | KltFrontend:
    """Return the front-end of `frontend.kind`.

    Parameters
    ----------
    camera : StereoCamera or PinholeCamera
        Of the rectified stereo pair, or of the colour image of an RGB-D sensor.
    config : Config, optional
    """
    config = config or Config()
    if config.frontend.kind == "klt":
        return KltFrontend(camera, config)
    return DescriptorFrontend(camera, config)
