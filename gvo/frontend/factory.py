"""The front-end that the configuration names, and what a change of it means."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from gvo.config import Config
from gvo.frontend.descriptor import DescriptorFrontend
from gvo.frontend.klt import KltFrontend, KltObservations
from gvo.frontend.offsets import RigOffsets
from gvo.geometry.camera import PinholeCamera, StereoCamera
from gvo.types import Frame

# Sections that a front-end reads.
_SECTIONS = (
    "camera",
    "frontend",
    "klt",
    "features",
    "stereo",
    "depth",
    "temporal",
    "ransac",
    "registration",
    "runtime",
)


def make_frontend(
    camera: StereoCamera | PinholeCamera,
    config: Config | None = None,
    *,
    rig_offsets: RigOffsets | None = None,
) -> DescriptorFrontend | KltFrontend:
    """Return the front-end of `frontend.kind`.

    Parameters
    ----------
    camera : StereoCamera or PinholeCamera
        Of the rectified stereo pair, or of the colour image of an RGB-D sensor.
    config : Config, optional
    rig_offsets : RigOffsets, optional
        What was learnt of the camera before.
    """
    config = config or Config()
    make = KltFrontend if config.frontend.kind == "klt" else DescriptorFrontend
    return make(camera, config, rig_offsets=rig_offsets)


@dataclass(frozen=True, slots=True, kw_only=True)
class FrontendChange:
    """What another configuration changes of a front-end and its observations.

    Parameters
    ----------
    is_any : bool
        Anything.
    is_of_extraction : bool
        What is extracted of a frame.
    is_of_kind : bool
        Old observations cannot be registered with new ones.
    is_of_rig : bool
        What was learnt of the camera no longer holds.
    """

    is_any: bool
    is_of_extraction: bool
    is_of_kind: bool
    is_of_rig: bool


def find_change(former: Config, config: Config, *, is_stereo: bool) -> FrontendChange:
    """Compare two configurations; stereo has no section `depth`, others no `stereo`."""
    return FrontendChange(
        is_any=any(getattr(former, name) != getattr(config, name) for name in _SECTIONS),
        is_of_extraction=_extraction(former, is_stereo) != _extraction(config, is_stereo),
        is_of_kind=_kind(former, is_stereo) != _kind(config, is_stereo),
        is_of_rig=former.camera != config.camera or (is_stereo and former.stereo != config.stereo),
    )


def frame_of(observations: object) -> Frame | None:
    """Return the frame of observations that hold it, else None."""
    return observations.frame if isinstance(observations, KltObservations) else None


def _extraction(config: Config, is_stereo: bool) -> tuple[Any, ...]:
    """Return the sections that decide what is extracted."""
    is_klt = config.frontend.kind == "klt"
    points = config.klt if is_klt else config.features
    return config.frontend, points, config.stereo if is_stereo else config.depth


def _kind(config: Config, is_stereo: bool) -> tuple[Any, ...]:
    """Return what must be equal for two frames to be registered."""
    if config.frontend.kind == "klt":
        return ("klt",)
    features = config.features
    described = features.kind, features.n_octaves, features.scale_factor, features.upright
    return "descriptor", *described
