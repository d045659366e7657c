"""Every parameter, with its unit, range, default and meaning.

The models are frozen and refuse unknown keys. `load_configuration` reads YAML and
`section.key=value` settings; `describe_configuration` prints all of it as commented YAML.
"""

from __future__ import annotations

import difflib
import math
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import NoneType
from typing import Any, Literal, TypeAlias, get_args

import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from gvo._text import MAX_CHARACTERS, MAX_SHOWN, YamlError, cut, load_yaml, read_text, shortened
from gvo.errors import ConfigurationError, named_faults


def _parameter(
    default: object, meaning: str, unit: str = "", *, is_expert: bool, **limits: float
) -> Any:  # noqa: ANN401 - pydantic types its own Field so
    shown = {"unit": unit, "is_expert": is_expert}
    options: dict[str, Any] = {"json_schema_extra": shown, **limits}
    return Field(default, description=meaning, **options)


# A parameter that matters to many, and one that hardly anyone needs.
_common = partial(_parameter, is_expert=False)
_expert = partial(_parameter, is_expert=True)

Kernel = Literal["none", "huber", "cauchy", "geman_mcclure", "dcs"]
Value: TypeAlias = bool | int | float | str | None
Kind = Literal["switch", "choice", "integer", "number"]
_WIDEST_SLIDER = 1000.0
# Parameters that there are no more, and the values at which they are fixed.
_FIXED = Path(__file__).with_name("fixed_parameters.yaml")
# what a number starts from where its default is null
_STARTS: Mapping[tuple[str, str], float] = {
    ("depth", "scale"): 1000.0,
}


class Section(BaseModel):
    """A group of parameters: frozen, no unknown keys, no infinities."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class SyncConfig(Section):
    """Pairing of images into frames."""

    max_difference_ms: float = _common(
        20.0, "maximum difference between the stamps of a colour and a depth image", "ms", ge=0
    )
    stereo_tolerance_ms: float = _common(
        0.0, "maximum difference between the stamps of left and right; 0: equal stamps", "ms", ge=0
    )
    stamps: Literal["header", "recording"] = _common(
        "header", "clock of the stamps of a bag's images; recording: for drivers that set none"
    )
    repeated_images: Literal["skip", "keep"] = _expert(
        "skip", "frames with the image of the one before; keep: for simulation without noise"
    )


class ImagesConfig(Section):
    """Grey and colour images: how 16 bits become 8, and which pixels are not used."""

    black: int = _common(
        0, "largest value mapped to black; above 0 for some thermal cameras", ge=0, le=65534
    )
    white: int = _common(
        65535, "smallest value mapped to white; 4095 for a camera of 12 bits", ge=1, le=65535
    )
    mask: list[str] = _common(
        [],
        "files of masks as for --mask, from this one's folder: [both], or [left, right]",
        max_length=2,
    )


class DepthConfig(Section):
    """Depth images of RGB-D cameras."""

    scale: float | None = _common(
        None, "counts per metre of integer depth; null: 5000 in TUM folders, else 1000", "1/m", gt=0
    )
    min_depth_m: float = _common(0.3, "minimum valid depth", "m", gt=0)
    max_depth_m: float = _common(8.0, "maximum valid depth", "m", gt=0)
    max_edge_step: float = _expert(
        0.03, "maximum spread of depth in the window around a keypoint, relative to its depth", ge=0
    )
    edge_radius_px: int = _expert(2, "half size of that window", "px", ge=0, le=10)
    sigma_px: float = _expert(1.0, "standard deviation of the virtual disparity", "px", gt=0)


class FrontendConfig(Section):
    """Front-end that registers two frames."""

    kind: Literal["klt", "descriptor"] = _common(
        "klt", "corners tracked by Lucas-Kanade, or keypoints matched by descriptors"
    )


class KltConfig(Section):
    """Corners tracked by Lucas-Kanade (frontend.kind: klt)."""

    n_corners: int = _common(250, "maximum corners per image", ge=50, le=20000)


class FeaturesConfig(Section):
    """Keypoints and descriptors (frontend.kind: descriptor)."""

    kind: Literal["orb", "sift", "fast", "gftt"] = _expert(
        "orb", "detector: orb and sift with their own descriptors, fast and gftt with those of ORB"
    )
    n_features: int = _expert(1200, "maximum keypoints per image", ge=50, le=20000)
    n_octaves: int = _expert(1, "pyramid levels (orb)", ge=1, le=8)
    scale_factor: float = _expert(1.3, "scale factor between pyramid levels (orb)", gt=1, le=2)
    fast_threshold: int = _expert(20, "FAST threshold (orb, fast)", "grey", ge=1, le=200)
    upright: bool = _expert(
        True, "no orientation (orb, fast, gftt): more distinctive while the camera rolls little"
    )
    cell_size_px: int = _expert(40, "size of the cells that share the budget", "px", ge=8)


class CameraConfig(Section):
    """The camera."""

    readout_ms: float | None = _common(
        None,
        "time from the first to the last row of a rolling shutter, 0: global; null: learnt",
        "ms",
        ge=-100,
        le=100,
    )


class StereoConfig(Section):
    """Matching of left and right."""

    min_depth_m: float = _common(0.5, "minimum depth of a match", "m", gt=0)
    max_depth_m: float = _common(200.0, "maximum depth of a match", "m", gt=0)
    row_tolerance_px: float = _expert(
        1.5, "maximum row difference of a match (descriptor)", "px", ge=0
    )
    max_distance: float = _expert(
        0.3, "maximum distance of descriptors, relative to the largest possible", gt=0, le=1
    )
    max_ratio: float = _expert(
        1.0, "maximum ratio of best to second-best (descriptor); 1: no test", gt=0, le=1
    )
    subpixel: Literal["parabola", "none"] = _expert(
        "parabola", "disparity by a parabola through patch differences, or from the keypoints"
    )
    estimate_offset: bool = _expert(True, "learn online what the calibration of the rig leaves")


class TemporalConfig(Section):
    """Matching of the reference and the current frame (frontend.kind: descriptor)."""

    radius_px: float = _expert(
        20.0,
        "search radius around a predicted pixel; four times as much without a prediction",
        "px",
        gt=0,
    )
    max_distance: float = _expert(
        0.25, "maximum descriptor distance, relative to the largest possible", gt=0, le=1
    )
    max_ratio: float = _expert(
        1.0, "maximum ratio of best to second-best descriptor distance; 1: no test", gt=0, le=1
    )


class RansacConfig(Section):
    """RANSAC over minimal samples of three points."""

    n_hypotheses: int = _expert(128, "maximum number of samples", ge=1, le=100000)
    inlier_metric: Literal["reprojection", "distance"] = _expert(
        "reprojection", "residual in the image (u, v, disparity), or distance in space"
    )
    inlier_threshold_px: float = _expert(3.0, "inlier threshold (reprojection)", "px", gt=0)
    inlier_threshold_m: float = _expert(0.3, "inlier threshold (distance)", "m", gt=0)
    min_inliers: int = _expert(12, "minimum number of inliers", ge=3)
    min_disparity_px: float = _expert(
        12.0, "minimum disparity of a fitted point: depth noise grows with z^2", "px", ge=0
    )
    seed: int = _expert(0, "seed of the random generator", ge=0)


class RegistrationConfig(Section):
    """Relative pose from 3D-3D correspondences."""

    weighting: Literal["inverse_depth", "none"] = _expert(
        "inverse_depth", "weights of Umeyama's fit to the inliers: 1/z^2, or equal"
    )
    refine: Literal["gauss_newton", "none"] = _expert(
        "gauss_newton", "refinement of the pose on (u, v, disparity) residuals after RANSAC"
    )


class WindowConfig(Section):
    """Sliding-window smoothing."""

    size: int | None = _common(
        5, "number of recent frames in the window; null: all frames (full smoothing)", ge=2, le=1000
    )
    n_keyframes: int = _common(20, "maximum number of keyframes kept", ge=0, le=100)
    n_links: int = _expert(
        3, "maximum registrations per frame, with its predecessor and keyframes", ge=1, le=20
    )
    keyframe_distance_m: float = _expert(
        1.0, "distance from all keyframes that makes a keyframe, if overlap is unknown", "m", gt=0
    )
    keyframe_angle_deg: float = _expert(
        15.0, "rotation from all that makes a keyframe, if overlap is unknown", "deg", gt=0, le=180
    )
    kernel: Kernel = _expert("huber", "robust kernel of the edges")
    gate: float | None = _expert(
        10.0, "maximum disagreement with most other edges of the pose; null: any", "sigma", gt=0
    )


class ImuConfig(Section):
    """An IMU that carries the camera where it sees nothing."""

    enabled: bool = _common(True, "use the IMU of the recording, if it has one")
    max_coast_s: float = _common(5.0, "longest time that it carries the camera", "s", ge=0, le=60)
    delay_ms: float | None = _expert(
        None,
        "added to its stamps to get those of images; null: as the recording says, else learnt",
        "ms",
        ge=-60_000,
        le=60_000,
    )
    gyro_noise: float | None = _expert(
        None,
        "noise density of the gyro; null: as the recording says",
        "rad/s/sqrt(Hz)",
        gt=0,
        le=10,
    )
    gyro_walk: float | None = _expert(
        None,
        "random walk of its bias; null: as the recording says",
        "rad/s^2/sqrt(Hz)",
        gt=0,
        le=10,
    )
    acceleration_noise: float | None = _expert(
        None,
        "noise density of accelerations; null: as the recording says",
        "m/s^2/sqrt(Hz)",
        gt=0,
        le=10,
    )
    acceleration_walk: float | None = _expert(
        None,
        "random walk of their bias; null: as the recording says",
        "m/s^3/sqrt(Hz)",
        gt=0,
        le=10,
    )


class LoopsConfig(Section):
    """Places seen again, and the global poses."""

    enabled: bool = _common(
        True, "look for places seen before: join segments, close loops, write global poses"
    )


class RuntimeConfig(Section):
    """Parallel work."""

    threads: int = _common(
        2,
        "1: sequential; 2: images decoded ahead, left and right described side by side "
        "(descriptor); 3 and more: two threads decode",
        ge=1,
        le=64,
    )


class Config(Section):
    """The whole configuration."""

    sync: SyncConfig = SyncConfig()
    images: ImagesConfig = ImagesConfig()
    camera: CameraConfig = CameraConfig()
    depth: DepthConfig = DepthConfig()
    frontend: FrontendConfig = FrontendConfig()
    klt: KltConfig = KltConfig()
    features: FeaturesConfig = FeaturesConfig()
    stereo: StereoConfig = StereoConfig()
    temporal: TemporalConfig = TemporalConfig()
    ransac: RansacConfig = RansacConfig()
    registration: RegistrationConfig = RegistrationConfig()
    window: WindowConfig = WindowConfig()
    imu: ImuConfig = ImuConfig()
    loops: LoopsConfig = LoopsConfig()
    runtime: RuntimeConfig = RuntimeConfig()


def load_configuration(path: Path | None = None, settings: Sequence[str] = ()) -> Config:
    """Read the configuration from a YAML file and settings; later ones override earlier ones.

    Parameters
    ----------
    path : Path, optional
        YAML file of sections; omitted keys keep their defaults.
    settings : sequence of str
        `section.key=value`, the value in YAML.

    Raises
    ------
    ConfigurationError
        When the file is unreadable, a key unknown (the nearest is named) or a value out of range.
    """
    values = _read_yaml(path) if path is not None else {}
    for setting in settings:
        key, separator, text = setting.partition("=")
        section, dot, name = key.strip().partition(".")
        shown = f"--set {cut(setting, MAX_SHOWN)}"
        if not separator or not dot:
            raise ConfigurationError(
                f"{shown}: expected section.key=value, for example window.n_links=3"
            )
        try:
            values.setdefault(section, {})[name] = load_yaml(text)
        except YamlError as error:
            raise ConfigurationError(f"{shown}: the value is no YAML ({error})") from error
    return validate_configuration(values)


def _read_yaml(path: Path) -> dict[str, dict[str, object]]:
    try:
        with named_faults(ConfigurationError, path):
            text = read_text(path, max_bytes=MAX_CHARACTERS)
        content = load_yaml(text)
    except UnicodeDecodeError as error:
        raise ConfigurationError(f"{path}: is no text") from error
    except YamlError as error:
        raise ConfigurationError(f"{path}: no YAML ({error})") from error
    if content is None:
        return {}
    if not isinstance(content, dict):
        raise ConfigurationError(f"{path}: expected sections with keys, see `gvo config --all`")
    for section, keys in content.items():
        if not isinstance(keys, dict):
            raise ConfigurationError(
                f"{path}: {cut(str(section), MAX_SHOWN)} must hold keys, see `gvo config --all`"
            )
    with named_faults(ConfigurationError, path, others=(ConfigurationError,)):
        config = validate_configuration(content)
    if config.images.mask:
        content["images"]["mask"] = [str(path.parent / name) for name in config.images.mask]
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
        return f"{name}={shortened(first['input'])}: {first['msg'].lower()}; see `gvo config --all`"
    gone = name
    if isinstance(first["input"], Mapping):  # a whole section
        gone = ".".join([name, *map(str, first["input"])][:2])
    fixed = load_yaml(read_text(_FIXED, max_bytes=MAX_CHARACTERS))
    if gone in fixed:
        return f"{gone} is no parameter any more: it is fixed at {_yaml(fixed[gone])}"
    known = list(values_by_name(Config()) if "." in name else sections())
    nearest = difflib.get_close_matches(name, known, n=1, cutoff=0.0)[0]
    return f"unknown key {name}: did you mean {nearest}? `gvo config --all` lists all"


def values_by_name(config: Config) -> dict[str, Value]:
    """Return the values of all parameters by `section.key`."""
    return {
        f"{section}.{key}": ", ".join(value) if isinstance(value, list) else value
        for section, values in config.model_dump().items()
        for key, value in values.items()
    }


def sections() -> dict[str, type[Section]]:
    """Return the classes of the sections by name, in order."""
    return {
        name: field.annotation
        for name, field in Config.model_fields.items()
        if isinstance(field.annotation, type) and issubclass(field.annotation, Section)
    }


def describe_configuration(config: Config, *, for_experts: bool = True) -> str:
    """Return the configuration as YAML, each key with unit, range and meaning.

    Parameters
    ----------
    config : Config
    for_experts : bool
        All parameters; else those that matter most, and those that differ from their defaults.
    """
    lines: list[str] = []
    for section, group in sections().items():
        values = getattr(config, section)
        fields = {
            key: field
            for key, field in group.model_fields.items()
            if for_experts or not is_expert(field) or getattr(values, key) != field.default
        }
        lines += ["", f"# {group.__doc__}".rstrip("."), f"{section}:"] if fields else []
        for key, field in fields.items():
            text = _yaml(getattr(values, key))
            lines.append(f"  {key}: {text}".ljust(34) + f"  # {describe_field(field)}")
    return "\n".join(lines[1:]) + "\n"


def _yaml(value: Value | list[str]) -> str:
    return str(yaml.safe_dump(value, default_flow_style=None, width=math.inf).splitlines()[0])


def is_expert(field: Any) -> bool:  # noqa: ANN401 - a field of pydantic's
    """Tell whether a parameter is one that hardly anyone needs."""
    return bool(field.json_schema_extra["is_expert"])


def describe_field(field: Any) -> str:  # noqa: ANN401 - a field of pydantic's
    """Return the meaning of a parameter with its unit and range."""
    notes = ", ".join(filter(None, [field.json_schema_extra["unit"], _choices(field)]))
    return f"{field.description}" + (f" [{notes}]" if notes else "")


def _choices(field: Any) -> str:  # noqa: ANN401
    choices = getattr(field.annotation, "__args__", ())
    if choices and all(isinstance(choice, str) for choice in choices):
        return " | ".join(choices)
    return ", ".join(f"{sign} {limit:g}" for sign, limit in _limits(field).items())


def _limits(field: Any) -> dict[str, float]:  # noqa: ANN401
    """Return the limits of a number by their signs."""
    names = {"ge": ">=", "gt": ">", "le": "<="}
    return {
        sign: float(getattr(limit, name))
        for limit in field.metadata
        for name, sign in names.items()
        if hasattr(limit, name)
    }


@dataclass(frozen=True, slots=True, kw_only=True)
class Parameter:
    """How a parameter is shown and changed.

    Parameters
    ----------
    section, key : str
        Its name is `section.key`.
    kind : {"switch", "choice", "integer", "number"}
    is_optional : bool
        Whether null is a value, too.
    choices : tuple of str
        Of a choice.
    minimum, maximum : float or None
        Smallest and largest value that the control offers, where there is one.
    step : float
        Between two values that the control offers.
    is_slider : bool
        Whether both bounds are near enough for a slider.
    default, start : bool, int, float, str or None
        The default; what a number starts from that was null.
    hint : str
        Meaning, unit, range and default, on one line.
    """

    section: str
    key: str
    kind: Kind
    is_optional: bool
    choices: tuple[str, ...]
    minimum: float | None
    maximum: float | None
    step: float
    is_slider: bool
    default: Value
    start: Value
    hint: str


def list_parameters() -> dict[str, list[Parameter]]:
    """Return the parameters by section, in the order of the configuration; not names of files."""
    return {
        section: [
            _shown(section, key, field)
            for key, field in model.model_fields.items()
            if not isinstance(field.default, list)
        ]
        for section, model in sections().items()
    }


def _shown(section: str, key: str, field: Any) -> Parameter:  # noqa: ANN401
    options = get_args(field.annotation)
    default = _yaml(field.default)
    limits = _limits(field)
    kind = _kind(field.annotation)
    lower, upper = limits.get(">=", limits.get(">")), limits.get("<=")
    start = field.default
    if start is None:
        start = _STARTS.get((section, key), 1.0)
    span = math.inf if lower is None or upper is None else upper - lower
    is_number = kind in ("integer", "number")
    is_slider = is_number and span <= _WIDEST_SLIDER
    step = _step(kind, span if is_slider else 10.0 * float(start)) if is_number else 1.0
    if lower is not None and ">" in limits and (is_slider or kind == "integer"):
        lower += step
    return Parameter(
        section=section,
        key=key,
        kind=kind,
        is_optional=NoneType in options,
        choices=tuple(options) if kind == "choice" else (),
        minimum=lower,
        maximum=upper,
        step=step,
        is_slider=is_slider,
        default=field.default,
        start=start,
        hint=f"{describe_field(field)}; default {default}",
    )


def _kind(annotation: Any) -> Kind:  # noqa: ANN401
    options = [option for option in get_args(annotation) if option is not NoneType]
    if options and all(isinstance(option, str) for option in options):
        return "choice"
    plain = options[0] if options else annotation
    kinds: dict[type, Kind] = {bool: "switch", int: "integer", float: "number"}
    return kinds[plain]


def _step(kind: Kind, size: float) -> float:
    """Return a power of ten, about a hundredth of the range or a tenth of the value."""
    if kind == "integer" or size <= 0.0:
        return 1.0
    return 10.0 ** (math.floor(math.log10(size)) - 2)


class Parameters:
    """The configuration of a run that goes on, which any thread may change.

    `list_parameters` has the names, ranges and meanings.

    Parameters
    ----------
    config : Config
    """

    def __init__(self, config: Config) -> None:
        self._config = config
        self._followers: list[Callable[[Config], None]] = []
        self._lock = threading.Lock()

    @property
    def config(self) -> Config:
        """The configuration of the next frame."""
        return self._config

    def follow(self, callback: Callable[[Config], None]) -> None:
        """Call `callback` after each change, in the thread that made it."""
        self._followers.append(callback)

    def set(self, values: Mapping[str, object]) -> Config:
        """Change parameters.

        Parameters
        ----------
        values : mapping of str to object
            By `section.key`.

        Returns
        -------
        Config
            With the changes.

        Raises
        ------
        ConfigurationError
            If one does not exist or is out of range; then none is changed.
        """
        with self._lock:
            nested = self._config.model_dump()
            for name, value in values.items():
                section, _, key = name.partition(".")
                if key not in nested.get(section, ()):
                    raise ConfigurationError(f"there is no parameter {cut(name, 60)}")
                nested[section][key] = value
            self._config = config = validate_configuration(nested)
        for callback in self._followers:
            callback(config)
        return config
