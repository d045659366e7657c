"""Write the images of a RealSense camera to standard output as `gvo live -` reads them.

Colour and depth, aligned to it, or with `--sensor stereo` both infrared images, without the
pattern. With `--calibration` the calibration of the device is written to a file instead, which
`gvo live -` takes. Needs pyrealsense2, and on Linux libusb.

Example: python scripts/feed_realsense.py --calibration camera.yaml
Example: python scripts/feed_realsense.py | gvo live - --sensor rgbd --calibration camera.yaml
"""

import argparse
import json
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyrealsense2 as rs  # type: ignore[import-not-found,import-untyped,unused-ignore]
from feed_recording import send  # type: ignore[import-not-found]  # beside this one

NAMES = {
    (rs.stream.color, 0): "color",
    (rs.stream.depth, 0): "depth",
    (rs.stream.infrared, 1): "left",
    (rs.stream.infrared, 2): "right",
}
STREAMS = {
    "rgbd": ((rs.stream.color, 0, rs.format.bgr8), (rs.stream.depth, 0, rs.format.z16)),
    "stereo": ((rs.stream.infrared, 1, rs.format.y8), (rs.stream.infrared, 2, rs.format.y8)),
}
MODELS = {rs.distortion.brown_conrady: "plumb_bob", rs.distortion.kannala_brandt4: "equidistant"}


def main() -> None:
    """Write the calibration of a camera, or its images until Ctrl-C."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sensor", choices=STREAMS, default="rgbd")
    parser.add_argument("--size", type=int, nargs=2, default=(640, 480), metavar=("W", "H"))
    parser.add_argument("--rate", type=int, default=30, metavar="HZ")
    parser.add_argument("--calibration", type=Path, metavar="FILE", help="write it, and end")
    arguments = parser.parse_args()
    pipeline = rs.pipeline()
    profile = start(pipeline, arguments.sensor, arguments.size, arguments.rate)
    try:
        if arguments.calibration is None:
            feed(iter(pipeline.wait_for_frames, None))
        else:
            content = calibration(profile, arguments.sensor)
            arguments.calibration.write_text(json.dumps(content))
    except (KeyboardInterrupt, BrokenPipeError):
        pass
    finally:
        pipeline.stop()


def start(
    pipeline: rs.pipeline, sensor: str, size: Sequence[int], rate_hz: int
) -> rs.pipeline_profile:
    """Start both streams; for infrared ones without the pattern, which moves along."""
    config = rs.config()
    for stream, index, pixels in STREAMS[sensor]:
        config.enable_stream(stream, index, *size, pixels, rate_hz)
    profile = pipeline.start(config)
    for each in profile.get_device().sensors if sensor == "stereo" else ():
        if each.supports(rs.option.emitter_enabled):
            each.set_option(rs.option.emitter_enabled, 0)
    return profile


def calibration(profile: rs.pipeline_profile, sensor: str) -> dict[str, Any]:
    """Return what a calibration file says of both streams."""
    first, second = (profile.get_stream(stream, index) for stream, index, _ in STREAMS[sensor])
    if sensor == "rgbd":
        units_m = profile.get_device().first_depth_sensor().get_depth_scale()
        return {**_camera(first, 0.0), "depth_scale": 1.0 / units_m}
    baseline = -first.get_extrinsics_to(second).translation[0]
    return {"left": _camera(first, 0.0), "right": _camera(second, baseline)}


def _camera(profile: rs.stream_profile, baseline: float) -> dict[str, Any]:
    """Return the intrinsics of a stream, as the messages of ROS have them."""
    found = profile.as_video_stream_profile().get_intrinsics()
    if any(found.coeffs) and found.model not in MODELS:
        raise ValueError(f"the distortion is {found.model}: choose another --size or --sensor")
    K = [found.fx, 0.0, found.ppx, 0.0, found.fy, found.ppy, 0.0, 0.0, 1.0]
    P = [*K[:3], -found.fx * baseline, *K[3:6], 0.0, *K[6:], 0.0]
    model = MODELS.get(found.model, "plumb_bob")
    D = list(found.coeffs)[: 4 if model == "equidistant" else 5]
    size = {"width": found.width, "height": found.height}
    return {
        **size,
        "distortion_model": model,
        "K": K,
        "D": D,
        "R": np.eye(3).ravel().tolist(),
        "P": P,
    }


def feed(framesets: Iterable[rs.composite_frame]) -> None:
    """Send the images of framesets, each of them once; depth as the colour camera sees it."""
    align, last = rs.align(rs.stream.color), dict[str, int]()
    for frameset in framesets:
        has_both = frameset.get_color_frame() and frameset.get_depth_frame()
        for frame in align.process(frameset) if has_both else frameset:
            profile = frame.get_profile()
            name = NAMES[profile.stream_type(), profile.stream_index()]
            if last.get(name) != frame.get_frame_number():
                last[name] = frame.get_frame_number()
                send(name, round(1e6 * frame.get_timestamp()), np.asanyarray(frame.get_data()))


if __name__ == "__main__":
    try:
        main()
    except (RuntimeError, ValueError, OSError) as error:
        print(f"feed_realsense: error: {error}", file=sys.stderr)
        sys.exit(2)
