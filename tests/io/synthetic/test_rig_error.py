"""Rigs that are not what their calibration says."""

from dataclasses import replace

import numpy as np
import pytest

from gvo.config import Config
from gvo.frontend.offsets import RigOffsets
from gvo.geometry.camera import StereoCamera
from gvo.geometry.rig import LENS, ROWS, LearntRig
from gvo.io.synthetic import RigError
from gvo.io.synthetic.rig_error import BentRig

CAMERA = StereoCamera(fx=400.0, fy=400.0, cx=159.5, cy=99.5, width=320, height=200, baseline=0.2)
COMMON = {"d0", "dx", "dy", "dxx", "dxy", "dyy", "k1", "f", "baseline"}
STEREO = {"tx", "ty", "p1", "p2", *ROWS}
OTHERS = {"k2", "k1_right", "cx", "skew", "aspect", "ddx", "ddy"}


@pytest.mark.parametrize(
    ("is_stereo", "others", "names"),
    [
        (False, False, COMMON),
        (True, False, COMMON | STEREO),
        (True, True, COMMON | STEREO | OTHERS),
    ],
)
def test_what_is_drawn(is_stereo: bool, others: bool, names: set[str]) -> None:
    draws = [
        RigError(size_px=0.25, seed=seed, others=others).draw(CAMERA, is_stereo=is_stereo)
        for seed in range(400)
    ]
    assert {*draws[0]} == names
    assert draws[0] == RigError(size_px=0.25, seed=0, others=others).draw(
        CAMERA, is_stereo=is_stereo
    )
    sizes = {name: np.std([draw[name] for draw in draws]) for name in names}
    x, f = 160.0 / 400.0, 400.0
    seen_px = {"d0": 1.0, "dx": f * x, "dxx": f * x * x, "k1": f * x**3, "f": f * x}
    expected = {"d0": 0.3, "dx": 1.0, "dxx": 1.0, "k1": 2.0, "f": 3.0}
    for name, unit in seen_px.items():
        assert unit * sizes[name] == pytest.approx(0.25 * expected[name], rel=0.12)
    assert sizes["baseline"] == pytest.approx(0.0025, rel=0.12)


def test_constants_that_are_given_replace_draws() -> None:
    error = RigError(constants={"k1": 0.01})
    drawn = error.draw(CAMERA, is_stereo=True)
    assert {name for name, value in drawn.items() if value} == {"k1"}
    with pytest.raises(ValueError, match=r"unknown constants of a rig: \['k7'\]"):
        RigError(constants={"k7": 1.0})


@pytest.mark.parametrize("name", [*LENS, *ROWS])
def test_images_are_bent_as_what_is_learnt_unbends_them(name: str) -> None:
    """Images whose grey values are columns, or rows, tell which place each pixel shows."""
    value = {"d0": 0.4, "r0": 0.4, "tx": 0.004, "ty": 0.004, "k1": 0.01}.get(name, 0.003)
    rig = BentRig(CAMERA, CAMERA.baseline, {name: value})
    v, u = np.mgrid[:200, :320].astype(np.float32)
    depth = np.full(u.shape, 8.0, dtype=np.float32)
    disparity = CAMERA.fx * CAMERA.baseline / 8.0
    within = np.s_[20:-20, 40:-60]
    shown = {
        side: [rig.bend(each, d)[within].ravel() for each in (u, v)]
        for side, d in (("left", None), ("right", depth))
    }
    at = u[within].ravel(), v[within].ravel()
    # Where a point is in the left image, by how the left image is bent near there.
    moved = [here - there for here, there in zip(at, shown["left"], strict=True)]
    grid = [each.reshape(u[within].shape) for each in moved]
    left = np.array([shown["right"][0] + disparity, shown["right"][1]])
    rows, columns = (np.rint(left[1]) - 20).astype(int), (np.rint(left[0]) - 40).astype(int)
    is_seen = (columns >= 0) & (columns < u[within].shape[1])
    rows = rows.clip(0, u[within].shape[0] - 1)
    columns = columns.clip(0, u[within].shape[1] - 1)
    measured_left = left + [each[rows, columns] for each in grid]
    uvd = np.column_stack([*measured_left, measured_left[0] - at[0]])[is_seen].astype(np.float64)
    constants = {each: (value * (each == name), 1.0) for each in (*LENS, *ROWS)}
    learnt = LearntRig(constants=constants, information=np.eye(17), n_frames=1)
    held = Config.model_validate({"stereo": {"estimate_offset": False}})
    offsets = RigOffsets(replace(CAMERA, rig=learnt), held)
    ideal = np.column_stack([*left, np.full(left.shape[1], disparity)])[is_seen]
    # Places are rounded to a 32nd of a pixel.
    np.testing.assert_allclose(offsets.take_off(uvd), ideal, atol=0.05)
    lower = at[1][is_seen] - uvd[:, 1]
    np.testing.assert_allclose(offsets.row_errors(uvd), lower, atol=0.05)
