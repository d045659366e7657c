"""Every parameter, with its unit, range, default and meaning.

The models are frozen and refuse unknown keys. `load_configuration` reads YAML and
`section.key=value` settings; `describe_configuration` prints all of it as commented YAML.
"""

from __future__ import annotations

import difflib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from gvo._text import MAX_CHARACTERS, MAX_SHOWN, YamlError, cut, load_yaml, read_text, shortened
from gvo.errors import ConfigurationError


def _parameter(
    default: object,
    meaning: str,
    unit: str = "",
    *,
    ge: float | None = None,
    gt: float | None = None,
    le: float | None = None,
) -> Any:  # noqa: ANN401 - pydantic types its own Field so
    return Field(
        default, ge=ge, gt=gt, le=le, description=meaning, json_schema_extra={"unit": unit}
    )


Kernel = Literal["none", "huber", "cauchy", "geman_mcclure", "dcs"]


class Section(BaseModel):
    """A group of parameters: frozen, no unknown keys, no infinities."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class SyncConfig(Section):
    """Which images make one frame."""

    max_difference_ms: float = _parameter(
        20.0, "largest difference between the stamps of colour and depth", "ms", ge=0
    )
    stereo_tolerance_ms: float = _parameter(
        0.0, "largest difference between the stamps of left and right; 0: equal stamps", "ms", ge=0
    )
    stamps: Literal["header", "recording"] = _parameter(
        "header", "whose clock stamps the images of a bag: recording, where the driver stamps none"
    )
    queue_size: int = _parameter(
        100, "images of a stream that are kept while their partners may come", ge=2, le=10000
    )
    age_penalty: float = _parameter(
        0.1, "how much nearer, as a share, a later partner must be than an earlier one", ge=0
    )
    repeated_images: Literal["skip", "keep"] = _parameter(
        "skip",
        "an image that is, pixel by pixel, the one before: no frame, or one that stands still "
        "(keep: simulated cameras without noise)",
    )


class ImagesConfig(Section):
    """Grey and colour images of 16 bits, of which 8 are used."""

    black: int = _parameter(
        0,
        "largest value that becomes black; more where a thermal camera starts above 0",
        ge=0,
        le=65534,
    )
    white: int = _parameter(
        65535,
        "smallest value that becomes white; 4095 for a camera of 12 bits",
        ge=1,
        le=65535,
    )


class DepthConfig(Section):
    """Depth images of RGB-D cameras."""

    scale: float | None = _parameter(
        None,
        "counts per metre of integer depth; null: 5000 for TUM folders, 1000 else",
        "1/m",
        gt=0,
    )
    min_depth_m: float = _parameter(0.3, "nearest depth that counts as valid", "m", gt=0)
    max_depth_m: float = _parameter(8.0, "farthest depth that counts as valid", "m", gt=0)
    max_edge_step: float = _parameter(
        0.03, "largest spread of depth around a keypoint, relative to its depth", ge=0
    )
    edge_radius_px: int = _parameter(2, "half size of the window of that check", "px", ge=0, le=10)
    virtual_baseline_m: float = _parameter(
        0.075, "baseline of the stereo camera that the depth camera is seen as", "m", gt=0
    )
    sigma_px: float = _parameter(1.0, "noise of the virtual disparity", "px", gt=0)


class FrontendConfig(Section):
    """How two frames are registered."""

    kind: Literal["klt", "descriptor"] = _parameter(
        "klt", "corners tracked by Lucas-Kanade, or matched by descriptors"
    )


class KltConfig(Section):
    """Corners tracked by Lucas-Kanade (frontend.kind: klt)."""

    n_corners: int = _parameter(250, "corners kept per image", ge=50, le=20000)
    min_eigenvalue: float = _parameter(
        1e-4,
        "weakest corner: smaller eigenvalue of the gradients' covariance, grey in [0, 1]",
        gt=0,
    )
    min_distance_px: int = _parameter(
        10, "size of the cells that give one corner each", "px", ge=2, le=200
    )
    cell_size_px: int = _parameter(40, "size of the grid cells that share the budget", "px", ge=8)
    window_radius_px: int = _parameter(
        4, "half size of the window that is tracked", "px", ge=2, le=50
    )
    n_levels: int = _parameter(2, "pyramid levels above the image, from a prediction", ge=0, le=8)
    n_wide_levels: int = _parameter(
        4, "the same where there is no prediction, or it led to nothing", ge=0, le=8
    )
    max_return_px: float = _parameter(
        0.5, "the same: how far from its corner a track may end that is followed back", "px", gt=0
    )
    pixel_sigma_px: float = _parameter(0.15, "noise of a tracked pixel", "px", gt=0)
    disparity_sigma_px: float = _parameter(
        0.15, "noise of the disparity of a corner or a track, for stereo", "px", gt=0
    )
    sigma_factor: float = _parameter(
        3.1, "factor on the sigmas of a registration: neighbouring tracks share their errors", gt=0
    )


class FeaturesConfig(Section):
    """Keypoints and descriptors."""

    kind: Literal["orb", "sift", "fast", "gftt"] = _parameter(
        "orb", "orb and sift bring their own descriptors; fast and gftt corners get ORB's"
    )
    n_features: int = _parameter(1200, "keypoints kept per image", ge=50, le=20000)
    n_octaves: int = _parameter(1, "pyramid levels (orb)", ge=1, le=8)
    scale_factor: float = _parameter(1.3, "size ratio of two pyramid levels (orb)", gt=1, le=2)
    fast_threshold: int = _parameter(20, "contrast of a corner (orb, fast)", "grey", ge=1, le=200)
    low_fast_threshold: int = _parameter(
        7, "tried where the first leaves the budget unfilled", "grey", ge=1, le=200
    )
    upright: bool = _parameter(
        True, "describe without rotation (orb, fast, gftt): surer while the camera rolls little"
    )
    cell_size_px: int = _parameter(40, "size of the grid cells that share the budget", "px", ge=8)


class StereoConfig(Section):
    """Matching of left and right."""

    min_depth_m: float = _parameter(0.5, "nearest depth that is searched", "m", gt=0)
    max_depth_m: float = _parameter(200.0, "farthest depth that is searched", "m", gt=0)
    row_tolerance_px: float = _parameter(1.5, "rows that left and right may differ", "px", ge=0)
    max_distance: float = _parameter(
        0.3, "largest descriptor distance, as a share of the largest possible", gt=0, le=1
    )
    max_ratio: float = _parameter(
        1.0, "largest ratio of the best to the second best descriptor distance; 1: any", gt=0, le=1
    )
    subpixel: Literal["parabola", "none"] = _parameter(
        "parabola", "fit over the patch differences, or the difference of the keypoints"
    )
    patch_radius_px: int = _parameter(5, "half size of the patches", "px", ge=1, le=20)
    search_radius_px: int = _parameter(3, "columns searched on either side", "px", ge=1, le=20)
    sigma_px: float = _parameter(0.3, "noise of the disparity", "px", gt=0)
    estimate_offset: bool = _parameter(
        True, "learn the constant error of the rig's disparities while running"
    )
    offset_sigma_px: float = _parameter(0.1, "how large that error may be", "px", gt=0)


class TemporalConfig(Section):
    """Matching of a reference and the current frame."""

    radius_px: float = _parameter(20.0, "search radius around a predicted pixel", "px", gt=0)
    wide_radius_px: float = _parameter(
        80.0, "search radius where there is no prediction, or it found too little", "px", gt=0
    )
    max_distance: float = _parameter(
        0.25, "largest descriptor distance, as a share of the largest possible", gt=0, le=1
    )
    max_ratio: float = _parameter(
        1.0, "largest ratio of the best to the second best descriptor distance; 1: any", gt=0, le=1
    )


class RansacConfig(Section):
    """Minimal samples of three points."""

    n_hypotheses: int = _parameter(128, "samples drawn at most", ge=1, le=100000)
    inlier_metric: Literal["reprojection", "distance"] = _parameter(
        "reprojection", "residual in the image (u, v, disparity), or between the points"
    )
    inlier_threshold_px: float = _parameter(3.0, "of the reprojection metric", "px", gt=0)
    inlier_threshold_m: float = _parameter(0.3, "of the distance metric", "m", gt=0)
    min_inliers: int = _parameter(12, "fewer mean failure", ge=3)
    min_disparity_px: float = _parameter(
        12.0, "points with less are counted but not fitted: depth noise grows with z^2", "px", ge=0
    )
    seed: int = _parameter(0, "of the random generator", ge=0)


class RegistrationConfig(Section):
    """Pose from 3D-3D correspondences."""

    weighting: Literal["inverse_depth", "none"] = _parameter(
        "inverse_depth", "weights of Umeyama's fit to the inliers: 1/z^2, or none"
    )
    refine: Literal["gauss_newton", "none"] = _parameter(
        "gauss_newton", "pose over (u, v, disparity) residuals after RANSAC, or not"
    )
    n_iterations: int = _parameter(10, "at most, of the refinement", ge=1, le=100)
    huber: float = _parameter(
        1.5, "threshold of the robust kernel, on a match's residual", "sigma", gt=0
    )
    gate: float = _parameter(
        3.0, "matches nearer to the refined pose than this become its inliers", "sigma", gt=0
    )
    pixel_sigma_px: float = _parameter(0.7, "noise of a keypoint's pixel", "px", gt=0)
    sigma_factor: float = _parameter(
        1.2, "factor on the sigmas of a registration: matches share errors residuals hide", gt=0
    )


class WindowConfig(Section):
    """Sliding-window smoothing."""

    size: int | None = _parameter(
        5, "recent frames in the window; null: all frames (full smoothing)", ge=2, le=1000
    )
    n_keyframes: int = _parameter(12, "keyframes kept beside them", ge=0, le=100)
    n_links: int = _parameter(
        3, "registrations per frame at most: predecessor and keyframes", ge=1, le=20
    )
    min_overlap: float = _parameter(
        0.4, "a keyframe leaves when a smaller share of its points is in view", ge=0, le=1
    )
    link_gain: float = _parameter(
        2.5, "a keyframe is linked where steps since, times its share in view, are no less", ge=0
    )
    keyframe_overlap: float = _parameter(
        0.9, "a frame becomes a keyframe when it overlaps all others less", ge=0, le=1
    )
    link_sigma_factor: float = _parameter(
        2.5, "factor on the sigmas of links to keyframes: a frame's links share its noise", gt=0
    )
    keyframe_distance_m: float = _parameter(
        1.0, "a frame this far from all keyframes becomes one, where no overlap is known", "m", gt=0
    )
    keyframe_angle_deg: float = _parameter(15.0, "the same for a turn", "deg", gt=0, le=180)
    kernel: Kernel = _parameter("huber", "robust kernel of the edges")
    kernel_threshold: float | None = _parameter(
        None,
        "of the kernel, on the norm of the whitened 6-vector (dcs: its square); "
        "null: huber 3.55, cauchy 9.4, geman_mcclure 13.6, dcs 15.6",
        gt=0,
    )
    gate: float | None = _parameter(
        10.0, "an edge that disagrees more with most others of its pose is refused", "sigma", gt=0
    )
    coasting_sigma_deg_per_s: float = _parameter(
        30.0, "rotation sigma of a step without registration, by its duration", "deg/s", gt=0
    )
    coasting_sigma_m_per_s: float = _parameter(
        3.0, "translation sigma of a step without registration, by its duration", "m/s", gt=0
    )
    lost_after_s: float = _parameter(
        2.0, "without a registration for longer the camera is lost: a segment begins", "s", gt=0
    )
    relocalize: bool = _parameter(
        True, "after that, look for the keyframes of earlier segments, to join them"
    )
    zero_motion: bool = _parameter(
        False, "at standstill, tie a frame to its predecessor by an edge without motion"
    )
    zero_motion_flow_px: float = _parameter(
        1.0, "standstill: the median pixel moves by less", "px", gt=0
    )
    zero_motion_gate: float = _parameter(
        5.0, "standstill: the motion is this insignificant against its covariance", "sigma", gt=0
    )
    zero_motion_sigma_factor: float = _parameter(
        1.0, "sigmas of that edge, as a multiple of those of the registration", gt=0
    )


class RuntimeConfig(Section):
    """How the work is done."""

    threads: int = _parameter(
        2,
        "1: one thing after the other; 2: images are decoded ahead; 3: corners are found aside "
        "(klt), a little faster for a little more CPU time",
        ge=1,
        le=64,
    )


class CheckConfig(Section):
    """What `gvo check` looks at, and where it warns."""

    n_samples: int = _parameter(12, "frames looked at, each with the next one", ge=2, le=1000)
    max_lost_share: float = _parameter(
        0.05, "share of frames lost: dropped, unpaired, undecodable, repeated", ge=0, le=1
    )
    fault_lost_share: float = _parameter(0.2, "the same, called a fault", ge=0, le=1)
    max_jitter: float = _parameter(
        0.3, "95 % of the periods differ less from the median, relative to it", ge=0
    )
    max_gap_s: float = _parameter(
        0.5, "longest time without a frame; window.lost_after_s is a fault", "s", gt=0
    )
    max_stereo_difference_ms: float = _parameter(
        2.0, "median difference between the stamps of left and right", "ms", ge=0
    )
    max_depth_difference_ms: float = _parameter(
        10.0, "median difference between the stamps of colour and depth", "ms", ge=0
    )
    max_clock_drift_ms_per_min: float = _parameter(
        60.0, "drift of the header clock against the recording clock", "ms/min", ge=0
    )
    max_clock_jump_ms: float = _parameter(100.0, "jump of the same", "ms", ge=0)
    max_row_offset_px: float = _parameter(
        0.75, "median row difference of left and right; above is a fault", "px", ge=0
    )
    max_row_spread_px: float = _parameter(
        2.0, "95 % of the row differences are below; above is a fault", "px", ge=0
    )
    max_lens_k1: float = _parameter(
        0.15, "radial distortion k1 left in rectified images; above is a fault", ge=0
    )
    min_stereo_matches: int = _parameter(60, "matches of left and right per frame", ge=0)
    max_negative_share: float = _parameter(
        0.1, "share of matches behind infinity; more than half: left and right swapped", ge=0, le=1
    )
    min_depth_median_m: float = _parameter(
        0.2, "smallest median depth that a right scale gives", "m", ge=0
    )
    max_depth_median_m: float = _parameter(
        50.0, "largest median depth that a right scale gives", "m", gt=0
    )
    min_depth_in_range: float = _parameter(
        0.5, "share of known depth within depth.min_depth_m and depth.max_depth_m", ge=0, le=1
    )
    max_unknown_depth: float = _parameter(0.5, "share of unknown depth", ge=0, le=1)
    min_depth_levels: int = _parameter(64, "different values in a depth image", ge=1)
    max_misregistration_px: float = _parameter(
        3.0, "offset between the edges of depth and colour; twice as much is a fault", "px", ge=0
    )
    min_brightness: float = _parameter(25.0, "smallest mean grey value", "grey", ge=0, le=255)
    max_brightness: float = _parameter(230.0, "largest mean grey value", "grey", ge=0, le=255)
    max_clipped_share: float = _parameter(0.3, "share of black and of white pixels", ge=0, le=1)
    max_exposure_ratio: float = _parameter(
        1.3, "ratio of the mean grey values of left and right", ge=1
    )
    max_blur_px: float = _parameter(1.6, "sigma of the blur of edges", "px", gt=0)
    min_corners: int = _parameter(80, "corners per image (of klt.n_corners)", ge=0)
    min_followed_share: float = _parameter(
        0.3, "share of corners that are found again in the next frame", ge=0, le=1
    )
    max_tf_gap_s: float = _parameter(0.5, "longest time without a transform of a chain", "s", gt=0)


class Config(Section):
    """The whole configuration."""

    sync: SyncConfig = SyncConfig()
    images: ImagesConfig = ImagesConfig()
    depth: DepthConfig = DepthConfig()
    frontend: FrontendConfig = FrontendConfig()
    klt: KltConfig = KltConfig()
    features: FeaturesConfig = FeaturesConfig()
    stereo: StereoConfig = StereoConfig()
    temporal: TemporalConfig = TemporalConfig()
    ransac: RansacConfig = RansacConfig()
    registration: RegistrationConfig = RegistrationConfig()
    window: WindowConfig = WindowConfig()
    runtime: RuntimeConfig = RuntimeConfig()
    check: CheckConfig = CheckConfig()


def load_configuration(path: Path | None = None, settings: Sequence[str] = ()) -> Config:
    """Read the configuration from a YAML file and settings, later ones winning.

    Parameters
    ----------
    path : Path, optional
        YAML file of sections; what it leaves out keeps its default.
    settings : sequence of str
        `section.key=value`, the value in YAML.

    Raises
    ------
    ConfigurationError
        Unreadable file, unknown key (the nearest one is named), value out of range.
    """
    values = _read_yaml(path) if path is not None else {}
    for setting in settings:
        key, separator, text = setting.partition("=")
        section, dot, name = key.strip().partition(".")
        if not separator or not dot:
            raise ConfigurationError(
                f"--set {cut(setting, MAX_SHOWN)}: expected section.key=value, for example "
                "window.n_links=3"
            )
        values.setdefault(section, {})[name] = _parse_value(setting, text)
    return validate_configuration(values)


def _parse_value(setting: str, text: str) -> object:
    try:
        return load_yaml(text)
    except YamlError as error:
        raise ConfigurationError(
            f"--set {cut(setting, MAX_SHOWN)}: the value is no YAML ({error})"
        ) from error


def _read_yaml(path: Path) -> dict[str, dict[str, object]]:
    try:
        content = load_yaml(read_text(path, max_bytes=MAX_CHARACTERS))
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigurationError(f"{path}: cannot be read: {error}") from error
    except YamlError as error:
        raise ConfigurationError(f"{path}: no YAML ({error})") from error
    if content is None:
        return {}
    if not isinstance(content, dict):
        raise ConfigurationError(f"{path}: expected sections with keys, see `gvo config`")
    for section, keys in content.items():
        if not isinstance(keys, dict):
            raise ConfigurationError(
                f"{path}: {cut(str(section), MAX_SHOWN)} must hold keys, see `gvo config`"
            )
    return content


def validate_configuration(values: Mapping[str, object]) -> Config:
    """Return the configuration of values by section and key; see `load_configuration`."""
    try:
        config = Config.model_validate(values)
    except ValidationError as error:
        raise ConfigurationError(_explain(error)) from error
    for section in ("depth", "stereo"):
        limits = getattr(config, section)
        if limits.min_depth_m >= limits.max_depth_m:
            raise ConfigurationError(
                f"{section}.min_depth_m={limits.min_depth_m} must be below "
                f"{section}.max_depth_m={limits.max_depth_m}"
            )
    images = config.images
    if images.black >= images.white:
        raise ConfigurationError(
            f"images.black={images.black} must be below images.white={images.white}"
        )
    return config


def _explain(error: ValidationError) -> str:
    first = error.errors()[0]
    name = cut(".".join(str(part) for part in first["loc"]), MAX_SHOWN)
    if first["type"] != "extra_forbidden":
        return f"{name}={shortened(first['input'])}: {first['msg'].lower()}; see `gvo config`"
    known = _known_keys() if "." in name else list(sections())
    nearest = difflib.get_close_matches(name, known, n=1, cutoff=0.0)[0]
    return f"unknown key {name}: did you mean {nearest}? `gvo config` lists all"


def _known_keys() -> list[str]:
    return [
        f"{section}.{key}" for section, group in sections().items() for key in group.model_fields
    ]


def sections() -> dict[str, type[Section]]:
    """Return the classes of the sections by name, in their order."""
    return {
        name: field.annotation
        for name, field in Config.model_fields.items()
        if isinstance(field.annotation, type) and issubclass(field.annotation, Section)
    }


def describe_configuration(config: Config) -> str:
    """Return the configuration as YAML, each key with unit, range and meaning."""
    lines: list[str] = []
    for section, group in sections().items():
        lines += ["", f"# {group.__doc__}".rstrip("."), f"{section}:"]
        values = getattr(config, section)
        for key, field in group.model_fields.items():
            text = yaml.safe_dump(getattr(values, key)).splitlines()[0]
            lines.append(f"  {key}: {text}".ljust(34) + f"  # {describe_field(field)}")
    return "\n".join(lines[1:]) + "\n"


def describe_field(field: Any) -> str:  # noqa: ANN401 - a field of pydantic's
    """Return the meaning of a parameter with its unit and range."""
    unit = str((field.json_schema_extra or {}).get("unit", ""))
    notes = ", ".join(filter(None, [unit, _choices(field)]))
    return f"{field.description}" + (f" [{notes}]" if notes else "")


def _choices(field: Any) -> str:  # noqa: ANN401
    choices = getattr(field.annotation, "__args__", ())
    if choices and all(isinstance(choice, str) for choice in choices):
        return " | ".join(choices)
    signs = {"Ge": ">=", "Gt": ">", "Le": "<="}
    return ", ".join(
        f"{signs[type(limit).__name__]} {getattr(limit, type(limit).__name__.lower()):g}"
        for limit in field.metadata
        if type(limit).__name__ in signs
    )
