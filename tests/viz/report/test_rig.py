"""The plot of what a run learnt of its camera."""

import numpy as np
import pytest

import gvo
from gvo.geometry.rig import LENS, LearntRig
from gvo.io.rig_file import rig_json
from gvo.viz.report.rig import rig_plots

CAMERA = gvo.SyntheticRecording("driving", n_frames=2).info.camera


def learnt(**values: float) -> dict[str, object]:
    constants = {name: (values.get(name, 0.0), 0.01) for name in LENS}
    return rig_json(CAMERA, LearntRig(constants=constants, information=np.eye(11), n_frames=9))


def test_what_a_turn_or_another_focal_length_would_do_is_not_shown() -> None:
    (plot,) = rig_plots(learnt(d0=-0.31, tx=-0.01, ty=0.004))
    tilt_px = plot.facts["pixel"]
    assert plot.facts["disparity"] == pytest.approx(0.31, abs=0.15)
    (plot,) = rig_plots(learnt(k1=0.01))
    corner = np.hypot(CAMERA.cx, CAMERA.cy) / CAMERA.fx
    assert 0.2 < plot.facts["pixel"] < 0.4 * 0.01 * CAMERA.fx * corner**3
    # A tilt is, to first order, a turn and what a turn does not explain.
    assert tilt_px < 0.5 * 0.01 * CAMERA.fx * corner**2
    assert plot.figure is not None


@pytest.mark.parametrize("rig", [None, {}, {"sensor": "stereo"}])
def test_without_it_there_is_no_plot(rig: object) -> None:
    assert rig_plots(rig) == []
