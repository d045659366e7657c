"""Options that commands share: parameters, recordings, calibration, topics."""

import inspect
import logging
from collections.abc import Callable, Sequence
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import typer
from typer import Argument, Option

from gvo.cli.terminal import Command, Verbose
from gvo.errors import ConfigurationError

if TYPE_CHECKING:
    from gvo.config import Config
    from gvo.io.excerpt import Excerpt as _Excerpt
    from gvo.io.opening import RecordingOptions
    from gvo.io.recording import Source

_LOGGER = logging.getLogger(__name__)
Settings = Annotated[
    list[str] | None,
    Option("--set", metavar="SECTION.KEY=VALUE", help="Change a parameter. May be repeated."),
]
ConfigFile = Annotated[
    Path | None, Option("--config", metavar="FILE", help="Parameters as `gvo config` prints them.")
]
Loops = Annotated[
    bool | None, Option("--loops/--no-loops", help="Close loops and write global poses.")
]
Recordings = Annotated[
    list[Path], Argument(metavar="RECORDING...", help="Bags, or one data-set folder.")
]
Out = Annotated[
    Path | None, Option(metavar="DIR", help="Folder to write; gvo-RECORDING if omitted.")
]
Force = Annotated[bool, Option("--force", help="Replace earlier results.")]
Bag = Annotated[
    Path | None, Option(metavar="FILE", help="Also write a .mcap (ROS 2) or .bag (ROS 1).")
]
Report = Annotated[bool, Option("--report/--no-report", help="Draw plots and report.html.")]
Plots = Annotated[Path | None, Option(metavar="DIR", help="Also write each plot as PNG and PDF.")]
Start = Annotated[float, Option(metavar="S", help="Seconds to skip at the start.")]
Every = Annotated[int, Option(metavar="N", help="Take every Nth frame.")]


class _Group(NamedTuple):
    """Marks a parameter of a command that is made by `make` from options of the command line."""

    make: Callable[..., Any]


def add_command(app: typer.Typer, name: str | None = None) -> Callable[[Callable[..., None]], Any]:
    """Return a decorator that adds a command; see `_Group`."""
    return lambda run: app.command(name, cls=Command)(_ungrouped(run))


def _ungrouped(run: Callable[..., None]) -> Callable[..., None]:
    """Return a command in which each `_Group` is replaced by the options of its `make`."""
    groups: dict[str, tuple[Callable[..., Any], list[str]]] = {}
    options: list[inspect.Parameter] = []
    for name, option in inspect.signature(run, eval_str=True).parameters.items():
        [*marks] = getattr(option.annotation, "__metadata__", ())
        if marks and isinstance(marks[0], _Group):
            inner = inspect.signature(marks[0].make).parameters
            groups[name] = marks[0].make, [*inner]
            options += inner.values()
        else:
            options.append(option)
    kind = inspect.Parameter.KEYWORD_ONLY
    options.append(inspect.Parameter("verbose", kind, default=None, annotation=Verbose))

    @wraps(run)
    def command(verbose: None = None, **given: Any) -> None:  # noqa: ANN401 - options of any type
        for name, (make, names) in groups.items():
            given[name] = make(**{each: given.pop(each) for each in names})
        run(**given)

    keywords = [each.replace(kind=kind) for each in options]
    command.__signature__ = inspect.Signature(keywords)  # type: ignore[attr-defined]
    command.__annotations__ = {each.name: each.annotation for each in keywords}
    return command


def load(config: ConfigFile = None, set_: Settings = None) -> "Config":
    """Return the parameters of a file, changed by settings."""
    from gvo.config import load_configuration

    parameters = load_configuration(config, set_ or [])
    _LOGGER.debug("parameters: %s", parameters.model_dump(exclude_defaults=True) or "defaults")
    return parameters


def with_loops(settings: list[str] | None, loops: bool | None) -> list[str]:
    """Return the settings with `loops.enabled`, where `--loops` was given."""
    return [*(settings or []), *([] if loops is None else [f"loops.enabled={str(loops).lower()}"])]


def _load_with_loops(
    config: ConfigFile = None, set_: Settings = None, loops: Loops = None
) -> "Config":
    return load(config, with_loops(set_, loops))


def _make_excerpt(
    start: Start = 0.0,
    duration: Annotated[
        float | None, Option(metavar="S", help="Seconds to read from there.")
    ] = None,
    every: Every = 1,
) -> "_Excerpt":
    from gvo.io.excerpt import make_excerpt

    return make_excerpt(start, duration, every)


def _topic(what: str) -> Any:  # noqa: ANN401 - has no public type
    return Option(metavar="TOPIC", help=f"Topic of {what}.")


def _recording_options(
    calibration: Annotated[
        list[Path] | None,
        Option(
            metavar="FILE",
            help="File of ROS, OpenCV, Kalibr, EuRoC, ORB-SLAM, stella_vslam, VINS, OpenVINS or "
            "KITTI that replaces the recording's own. May be repeated.",
        ),
    ] = None,
    rig: Annotated[
        Path | None,
        Option(metavar="FILE", help="The rig.yaml of an earlier run with the same camera."),
    ] = None,
    mask: Annotated[
        list[Path] | None,
        Option(
            metavar="PNG",
            help="Image of the size of those recorded: 0 = not used. May be repeated: left, right.",
        ),
    ] = None,
    left: Annotated[str | None, _topic("the left images")] = None,
    right: Annotated[str | None, _topic("the right images")] = None,
    color: Annotated[str | None, _topic("the colour images")] = None,
    depth: Annotated[str | None, _topic("the depth images")] = None,
    camera_info: Annotated[
        list[str] | None, _topic("CameraInfo: left, then right; or colour, then depth")
    ] = None,
    imu: Annotated[
        str | None, Option(metavar="TOPIC", help="Topic of the IMU, or of its gyro; or none.")
    ] = None,
) -> "RecordingOptions":
    from gvo.io.opening import RecordingOptions

    topics: dict[str, Any] = {"left": left, "right": right, "color": color, "depth": depth}
    return RecordingOptions(
        calibration=tuple(calibration or ()),
        rig=rig,
        mask=tuple(mask or ()),
        camera_info=tuple(camera_info or ()),
        imu=imu,
        **topics,
    )


Parameters = Annotated["Config", _Group(load)]
LoopParameters = Annotated["Config", _Group(_load_with_loops)]
Excerpt = Annotated["_Excerpt", _Group(_make_excerpt)]
Options = Annotated["RecordingOptions", _Group(_recording_options)]


def new_folder(
    out: Path | None, recording: str | Path, *, what: str = "", force: bool = False
) -> Path:
    """Return the folder to write, a new one if none is given; refused before any work."""
    from gvo.io.run_folder.writer import check_unused, free_folder

    folder = free_folder(recording, what) if out is None else out
    check_unused(folder, force=force)
    return folder


def refuse(why: str, **options: object) -> None:
    """Refuse the first option that was given."""
    for name, given in options.items():
        if given:
            raise ConfigurationError(f"--{name}: {why}")


def open_source(
    recordings: Sequence[Path], config: "Config", options: "RecordingOptions"
) -> "Source":
    """Open a recording as the options say."""
    from gvo.io.opening import open_recording

    source = open_recording(recordings, config=config, options=options)
    _LOGGER.debug("opened %s: %s", source.info.name, "; ".join(source.info.decisions))
    return source
