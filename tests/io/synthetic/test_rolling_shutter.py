"""A rolling shutter: each row is what a camera at the row's own pose sees in it."""

from typing import Any

import numpy as np
import pytest

from gvo.geometry.camera import StereoCamera
from gvo.geometry.se3 import make_transform
from gvo.io.synthetic import SyntheticRecording
from gvo.io.synthetic.world import WORLDS
from tests.make.recordings import PERFECT


@pytest.mark.parametrize(("name", "sensor"), [("driving", "stereo"), ("handheld", "rgbd")])
def test_each_row_is_that_of_an_image_taken_at_its_stamp(name: Any, sensor: Any) -> None:
    recording = SyntheticRecording(
        name, sensor, n_frames=12, noise=PERFECT, scale=0.25, readout_ms=30.0
    )
    camera, scene = recording.info.camera, WORLDS[name].scene(0)
    loaded = [image.load() for image in list(recording.images())[-2:]]
    stamps_ns = recording.ground_truth().stamps_ns
    for row in (0, camera.height // 3, camera.height - 1):
        elapsed_s = 1e-9 * (stamps_ns[-1] - stamps_ns[0]) + 0.03 * (row / camera.height - 0.5)
        views = [WORLDS[name].motion(0)(np.array([elapsed_s]))[0]]
        if isinstance(camera, StereoCamera):
            shift = np.array([camera.baseline, 0.0, 0.0])
            views.append(views[0] @ make_transform(np.eye(3), shift))
        for stream, view in enumerate(views):
            grey = scene.image(0.0, view, camera)[row]
            np.testing.assert_allclose(loaded[stream][row], grey, atol=1.5)
            depth = scene.depth(0.0, view, camera)[row]
            np.testing.assert_allclose(recording.render_depth(11, stream)[row], depth, rtol=1e-6)
        if sensor == "rgbd":
            np.testing.assert_allclose(loaded[1][row], depth, rtol=1e-5)
