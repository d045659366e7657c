"""`gvo convert`, in both directions."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import gvo
from gvo.geometry.se3 import make_transform
from gvo.io.convert.convert import convert
from gvo.io.synthetic import SyntheticRecording
from gvo.trajectory.formats import read_trajectory
from tests.conftest import Command, refused
from tests.io.conftest import Tiny
from tests.make.recordings import Held, Item, held

_TRAJECTORIES = ("raw.txt", "causal.txt", "smoothed.txt")


@pytest.fixture
def kitti(tmp_path: Path) -> Path:
    return Tiny().write_kitti(tmp_path / "kitti", n_frames=3)


def test_the_body_of_a_data_set_is_a_frame_of_its_bag(command: Command, tmp_path: Path) -> None:
    rendered = SyntheticRecording("handheld", "stereo", n_frames=4, scale=0.25)
    source = held(
        "stereo",
        [(image.stream, image.stamp_ns, image.load()) for image in rendered.images()],
        calibrations=rendered.info.calibrations,
        truth=rendered.ground_truth(),
    )
    R = np.asarray(Rotation.from_euler("xyz", [80, -10, 95], degrees=True).as_matrix())
    T_body_cam = make_transform(R, np.array([0.1, -0.2, 0.3]))
    source.info = replace(source.info, T_body_cam=T_body_cam)
    convert(source, tmp_path / "euroc", layout="euroc")
    for name in ("a.bag", "b.mcap"):
        assert command("convert", tmp_path / "euroc", tmp_path / name).code == 0
    outs = []
    for name in ("euroc", "a.bag", "b.mcap"):
        outs.append(tmp_path / f"run_{name}")
        answer = command(
            "run", "--no-report", tmp_path / name, "--frame", "body", "--out", outs[-1]
        )
        assert answer.code == 0
        assert "ATE" in answer.out
    for trajectory in _TRAJECTORIES:
        folder, *bags = (read_trajectory(out / trajectory) for out in outs)
        for bag in bags:
            np.testing.assert_allclose(bag.T_world_frame, folder.T_world_frame, rtol=0, atol=2e-9)
    camera = tmp_path / "camera"
    assert command("run", "--no-report", tmp_path / "a.bag", "--out", camera).code == 0
    T_first_cam = read_trajectory(camera / "raw.txt").T_world_frame
    T_first_body = read_trajectory(outs[0] / "raw.txt").T_world_frame
    np.testing.assert_allclose(
        T_first_body, T_body_cam @ T_first_cam @ np.linalg.inv(T_body_cam), rtol=0, atol=1e-8
    )


def _noise(stamps_ns: Sequence[int], delay_ns: int = 0) -> Held:
    tiny = Tiny()
    items: list[Item] = [
        (stream, stamp_ns + delay_ns * stream, tiny.texture(2 * k + stream))
        for k, stamp_ns in enumerate(stamps_ns)
        for stream in (0, 1)
    ]
    return tiny.stereo(items)


def test_a_bag_that_is_cut_off_gives_what_it_holds_and_exit_code_3(
    command: Command, tmp_path: Path, kitti: Path
) -> None:
    convert(_noise([10**8 * k for k in range(300)]), tmp_path / "whole.bag")
    data = (tmp_path / "whole.bag").read_bytes()
    (tmp_path / "cut.bag").write_bytes(data[: len(data) * 2 // 3])
    answer = command("convert", tmp_path / "cut.bag", tmp_path / "b.mcap")
    assert answer.code == 3
    assert "missing" in answer.err
    assert len(answer.err.splitlines()) <= 8
    copies = [i.load() for i in gvo.open_recording(tmp_path / "b.mcap").images() if not i.stream]
    assert 50 < len(copies) < 300
    for k, pixels in enumerate(copies):
        np.testing.assert_array_equal(pixels, Tiny().texture(2 * k))


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["convert", "{kitti}", "a.zip"], r"a.zip: expected a name ending in .bag"),
        (["convert", "{kitti}", "V1.01"], "got .01; give --layout"),
        (["convert", "{kitti}", "{kitti}"], "exists already"),
        (["convert", "{kitti}", "a", "--layout", "tum"], "cannot have the layout tum"),
        (["convert", "{kitti}", "a.bag", "--layout", "euroc"], "leave .bag away"),
        (["convert", "{kitti}", "a", "--layout", "euroc", "--png"], "--png is for bags"),
    ],
)
def test_misuse_is_one_line_and_exit_code_2(
    command: Command, here: Path, kitti: Path, arguments: list[str], expected: str
) -> None:
    words = (argument.format(kitti=kitti) for argument in arguments)
    assert expected in refused(command(*words))
    assert [path.name for path in here.iterdir()] == ["kitti"]
