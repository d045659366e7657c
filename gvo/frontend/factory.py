"""The front-end that the configuration names, and its successor where that changes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from gvo.config import Config
from gvo.frontend.descriptor import DescriptorFrontend
from gvo.frontend.klt import KltFrontend, KltObservations
from gvo.frontend.stereo.offsets import RigOffsets
from gvo.geometry.camera import PinholeCamera, StereoCamera
from gvo.types import Frame

# What a front-end of `make_frontend` reads; `features` and `temporal` also where corners are
# tracked: where tracks lead to nothing, descriptors are matched.
_SECTIONS = (
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
        What was learnt of the rig before.
    """
    config = config or Config()
    make = KltFrontend if config.frontend.kind == "klt" else DescriptorFrontend
    frontend = make(camera, config)
    if rig_offsets is not None:
        frontend.rig_offsets = rig_offsets
    return frontend


@dataclass(frozen=True, slots=True, kw_only=True)
class FrontendChange:
    """What another configuration means for a front-end and what it keeps of frames.

    Parameters
    ----------
    is_any : bool
        A front-end works differently with it.
    is_of_extraction : bool
        Other things are kept of a frame.
    is_of_kind : bool
        What was kept cannot be registered with what will be.
    is_of_rig : bool
        What was learnt of the rig no longer holds.
    """

    is_any: bool
    is_of_extraction: bool
    is_of_kind: bool
    is_of_rig: bool


def find_change(former: Config, config: Config, *, is_stereo: bool) -> FrontendChange:
    """Tell what a front-end of `make_frontend` makes of another configuration.

    Parameters
    ----------
    former, config : Config
    is_stereo : bool
        Of a stereo camera the section `depth` plays no role, of others the section `stereo`.
    """
    return FrontendChange(
        is_any=any(getattr(former, name) != getattr(config, name) for name in _SECTIONS),
        is_of_extraction=_extraction(former, is_stereo) != _extraction(config, is_stereo),
        is_of_kind=_kind(former, is_stereo) != _kind(config, is_stereo),
        is_of_rig=former.stereo != config.stereo,
    )


def frame_of(observations: object) -> Frame | None:
    """Return the frame that observations hold; None where they do not."""
    return observations.frame if isinstance(observations, KltObservations) else None


def _extraction(config: Config, is_stereo: bool) -> tuple[Any, ...]:
    """Return the sections that decide what is kept of a frame."""
    is_klt = config.frontend.kind == "klt"
    points = config.klt if is_klt else config.features
    return config.frontend, points, config.stereo if is_stereo else config.depth


def _kind(config: Config, is_stereo: bool) -> tuple[Any, ...]:
    """Return what must be equal for two frames' observations to be compared."""
    baseline_m = None if is_stereo else config.depth.virtual_baseline_m
    if config.frontend.kind == "klt":
        return "klt", baseline_m
    features = config.features
    described = features.kind, features.n_octaves, features.scale_factor, features.upright
    return "descriptor", baseline_m, *described
