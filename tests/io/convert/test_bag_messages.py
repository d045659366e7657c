"""What single messages of a bag say."""

from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
from rosbags.highlevel import AnyReader
from rosbags.interfaces import ConnectionExtRosbag1, ConnectionExtRosbag2, QosDurability

from gvo.geometry.camera import Calibration, PinholeCamera
from gvo.io.convert.bag_messages import (
    BagWriter,
    FramePose,
    Header,
    write_camera_info,
    write_transforms,
)

_NAMES = pytest.mark.parametrize("name", ["a.bag", "a.mcap"])
_CAMERA = PinholeCamera(fx=50.1, fy=50.3, cx=23.7, cy=15.9, width=48, height=32)


@_NAMES
@pytest.mark.parametrize(
    ("model", "n_coefficients"),
    [("plumb_bob", 5), ("rational_polynomial", 8), ("rational_polynomial", 14), ("equidistant", 4)],
)
def test_camera_info_names_the_distortion_model_and_holds_all_its_coefficients(
    tmp_path: Path,
    name: str,
    model: Literal["plumb_bob", "rational_polynomial", "equidistant"],
    n_coefficients: int,
) -> None:
    D = np.linspace(-0.01, 0.02, n_coefficients)
    ideal = Calibration.from_camera(_CAMERA)
    with BagWriter(tmp_path / name) as bag:
        calibration = replace(ideal, D=D, model=model, is_rectified=False)
        write_camera_info(bag, "/camera_info", calibration, Header(5, "camera"))
    with AnyReader([bag.result]) as reader:
        ((connection, _, data),) = reader.messages()
        message: Any = reader.deserialize(data, connection.msgtype)
    assert message.distortion_model == model
    np.testing.assert_array_equal(message.d if name == "a.mcap" else message.D, D)


@_NAMES
def test_static_transforms_are_kept_for_those_who_come_late(tmp_path: Path, name: str) -> None:
    with BagWriter(tmp_path / name) as bag:
        poses = [FramePose(5, "base", "camera", np.eye(4))]
        write_transforms(bag, "/tf_static", poses, is_latched=True)
        write_transforms(bag, "/tf", poses)
        write_transforms(bag, "/empty", [])
    with AnyReader([bag.result]) as reader:
        extensions = {c.topic: c.ext for c in reader.connections}
    assert set(extensions) == {"/tf", "/tf_static"}
    static, moving = extensions["/tf_static"], extensions["/tf"]
    if isinstance(static, ConnectionExtRosbag1) and isinstance(moving, ConnectionExtRosbag1):
        assert (static.latching, moving.latching) == (1, None)
    else:
        assert isinstance(static, ConnectionExtRosbag2)
        assert isinstance(moving, ConnectionExtRosbag2)
        (offered,) = static.offered_qos_profiles
        assert offered.durability == QosDurability.TRANSIENT_LOCAL
        assert moving.offered_qos_profiles == []
