"""The command for a camera that is running."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack
from functools import partial
from typing import TYPE_CHECKING, Annotated, Literal, cast

import typer
from typer import Argument, Option

from gvo._text import cut
from gvo.cli import options as opt
from gvo.cli.terminal import Work, exit_code, poses_so_far, say, tell, warn
from gvo.errors import ConfigurationError

if TYPE_CHECKING:
    from gvo.config import Config
    from gvo.io.opening import RecordingOptions
    from gvo.io.poses.base_frame import BaseFrame
    from gvo.io.recording import Source
    from gvo.live.odometry import LiveOdometry
    from gvo.live.transport import Sink, Transport
    from gvo.types import Progress


_EVERY_S = 5.0
_MAX_PORT = 65535
_NETWORKS = ("ros1", "ros2")
_KINDS = (*_NETWORKS, "camera", "-")
_Sensor = Literal["stereo", "rgbd"]
_Qos = Literal["sensor", "reliable", "system"]

_say = partial(say, err=True)


def live(
    camera: Annotated[
        list[str],
        Argument(
            metavar="CAMERA...",
            help="ros1, ros2, - (standard input), or camera with a device number or video file.",
        ),
    ],
    *,
    options: opt.Options,
    sensor: Annotated[_Sensor, Option(help="Kind of camera on standard input.")] = "stereo",
    is_rectified: Annotated[
        bool, Option("--rectified", help="Do not rectify the images of - and camera.")
    ] = False,
    frame: Annotated[
        str | None, Option(metavar="NAME", help="Base frame of the robot, such as base_link.")
    ] = None,
    world: Annotated[str, Option(metavar="NAME", help="Name of the fixed frame sent.")] = "map",
    with_tf: Annotated[bool, Option("--tf/--no-tf", help="Send transforms.")] = True,
    qos: Annotated[
        _Qos, Option(metavar="QOS", help="QoS of ROS 2 images: sensor, reliable, system.")
    ] = "sensor",
    foxglove: Annotated[
        str | None, Option(metavar="[HOST:]PORT", help="Serve Foxglove at this port.")
    ] = None,
    view: Annotated[
        str | None, Option(metavar="[HOST:]PORT", help="Serve a page for the browser at this port.")
    ] = None,
    out: opt.Out = None,
    force: opt.Force = False,
    parameters: opt.LoopParameters,
    queue: Annotated[
        int, Option(metavar="N", help="Keep at most N image pairs waiting; drop the oldest.")
    ] = 10,
    max_lag: Annotated[
        float | None,
        Option(
            metavar="S",
            help="Skip image pairs when more than S seconds behind; always process the newest.",
        ),
    ] = None,
    bag: opt.Bag = None,
    with_report: opt.Report = True,
) -> None:
    """Track a running camera: ROS topics, standard input or a device."""
    from gvo.io.poses.base_frame import find_base_frame
    from gvo.live.odometry import LiveOdometry
    from gvo.runs.outputs.options import RunOutputs

    outputs = RunOutputs(bag=bag, report=with_report)
    out = opt.new_folder(out, "live", force=force)
    outputs.check(force=force)
    page = None if view is None else _address("--view", view)
    has_signal = threading.Event()
    with ExitStack() as stack, Work() as work:
        work.on_signal = has_signal.set
        sinks = _connect(camera, qos, foxglove, stack)
        kind, *devices = camera
        if kind != "ros2":
            opt.refuse("only ROS 2 has it", qos=qos != "sensor")
        if kind in _NETWORKS:
            own = {"sensor": sensor != "stereo", "rectified": is_rectified}
            opt.refuse("only - and camera have it, ROS says so itself", **own)
            source, base_frame = _wait(sinks[0], parameters, options, has_signal, frame)
        else:
            source = _own_camera(devices, parameters, options, sensor, is_rectified)
            base_frame = find_base_frame(source, frame)
        make = partial(LiveOdometry, source, parameters, sinks=sinks, base_frame=base_frame)
        try:
            odometry = make(
                world=world, with_tf=with_tf, max_waiting=queue, max_lag_s=max_lag, say=_say
            )
        except ValueError as error:
            raise ConfigurationError(f"--queue, --max-lag: {error}") from error
        if page is not None:
            _show(odometry, source, page, stack)
        work.on_signal, work.stands = odometry.stop, poses_so_far(out)
        if has_signal.is_set():
            odometry.stop()
        runs = odometry.run(out, outputs=outputs, force=force, on_progress=_status(odometry))
    for folder, result in runs:
        tell(result, folder)
    raise typer.Exit(exit_code(all(result.is_complete for _, result in runs)))


def _connect(words: list[str], qos: _Qos, foxglove: str | None, stack: ExitStack) -> list[Sink]:
    """Join the ROS network and start the server of Foxglove, as asked for."""
    kind, *rest = words
    is_right = {"camera": bool(rest), "ros1": all(":=" in word for word in rest)}
    if kind not in _KINDS or not is_right.get(kind, not rest):
        raise ConfigurationError(
            f"expected ros1 [FROM:=TO...], ros2, - or camera DEVICE [DEVICE], got {' '.join(words)}"
        )
    sinks: list[Sink] = []

    def join(sink: Sink) -> None:
        stack.callback(sink.close)
        sinks.append(sink)

    if kind == "ros1":
        from gvo.live.ros1 import Ros1

        join(Ros1(rest))
    elif kind == "ros2":
        from gvo.live.dds import Dds

        join(Dds(qos=qos))
    if foxglove is not None:
        from gvo.live.foxglove import Foxglove

        host, port = _address("--foxglove", foxglove)
        server = Foxglove(host=host, port=port)
        _say(f"{server.url} serves Foxglove")
        join(server)
    return sinks


def _address(option: str, text: str) -> tuple[str, int]:
    host, _, port = text.rpartition(":")
    if not port.isdecimal() or len(port) > 5 or int(port) > _MAX_PORT:
        raise ConfigurationError(f"{option} {cut(text, 60)}: expected [HOST:]PORT")
    return host.strip("[]") or "127.0.0.1", int(port)


def _show(odometry: LiveOdometry, source: Source, page: tuple[str, int], stack: ExitStack) -> None:
    """Serve the page of a run until `stack` closes."""
    from gvo.viz.view import serve
    from gvo.viz.view.live import LivePlayer

    odometry.viewer = LivePlayer(source, odometry.parameters)
    server = stack.enter_context(serve(odometry.viewer, host=page[0], port=page[1]))
    warn([server.note] if server.note else [])
    _say(f"{server.url} shows the run")


def _wait(
    network: Sink,
    config: Config,
    options: RecordingOptions,
    has_signal: threading.Event,
    frame: str | None,
) -> tuple[Source, BaseFrame]:
    """Wait for the topics of a camera and its calibration; return it with its base frame."""
    from gvo.io.opening import as_asked, asked_imu
    from gvo.io.poses.base_frame import find_base_frame
    from gvo.live.topics import NetworkReader, TopicSource, wait_for

    reader = NetworkReader(cast("Transport", network))
    calibration, imu = asked_imu(options)

    def find() -> tuple[TopicSource, BaseFrame]:
        source = TopicSource(
            reader, topics=options, calibration=calibration, config=config, imu=imu
        )
        return source, find_base_frame(source, frame)

    found = wait_for(find, _say, has_signal)
    if found is None:
        raise KeyboardInterrupt
    source, base_frame = found
    source.info = as_asked(source.info, config, options, imu)
    for line in source.info.decisions:
        _say(line)
    return source, base_frame


def _own_camera(
    names: list[str], config: Config, options: RecordingOptions, sensor: _Sensor, is_rectified: bool
) -> Source:
    from gvo.io.calibration.files import paths_of
    from gvo.io.frames import Rig
    from gvo.io.opening import as_asked, refuse_topics
    from gvo.live.sources import Device, StandardInput

    refuse_topics(options, "camera" if names else "-")
    files = paths_of(options.calibration)
    if not 1 <= len(files) <= 2:
        raise ConfigurationError(f"expected one or two --calibration, got {len(files)}")
    rig = Rig(*files, sensor=sensor, is_rectified=is_rectified)
    info = as_asked(rig.info, config, options)
    if names:
        return Device(names, info)
    number, scale = sys.stdin.fileno(), rig.depth_scale
    return StandardInput(info, config, depth_scale=scale, number=number)


def _status(odometry: LiveOdometry) -> Callable[[Progress], None]:
    """Return a callback that says every few seconds how many frames were tracked."""
    said_s = started_s = time.monotonic()

    def show(progress: Progress) -> None:
        nonlocal said_s
        now_s = time.monotonic()
        if now_s - said_s >= _EVERY_S:
            said_s = now_s
            counts = f"{progress.n_done} frames, {progress.n_tracked} tracked"
            rate = progress.n_done / (now_s - started_s)
            _say(f"{counts}, {odometry.n_dropped} dropped, {rate:.1f} Hz")

    return show
