"""Limits on the errors of recorded and rendered starts, about 1.25 times what is reached."""

from collections.abc import Callable
from pathlib import Path

import pytest

import gvo
from gvo.io.recording import Sensor, Source
from tests.worlds import rendered

KITTI = "kitti_06_start"
XYZ = "rgbd_dataset_freiburg1_xyz_start"
RPY = "rgbd_dataset_freiburg1_rpy_part"
ROOM = "sevenscenes_start"
EUROC = "euroc_mh01_start"
DRIVE = "driving stereo"
HAND = "handheld stereo"
HAND_RGBD = "handheld rgbd"

pytestmark = pytest.mark.acceptance


# Recorded starts, then rendered ones (half size) of the worlds and sensors in their names: raw and
# smoothed ATE (m), and what else is limited. `t_pct` and `path_error` (how far the ratio of the
# path lengths may be from one) are of raw and of smoothed; `gain` is smoothed over raw ATE, where
# a camera looks back. The errors are printed by `benchmark.py errors`.
LIMITS: dict[str, tuple[float, float, dict[str, float]]] = {
    KITTI: (0.031, 0.031, {"t_pct": 0.78, "path_error": 0.002}),
    EUROC: (0.0046, 0.0042, {}),
    XYZ: (0.0085, 0.0050, {}),
    RPY: (0.030, 0.0080, {}),
    ROOM: (0.036, 0.024, {"gain": 0.85}),
    DRIVE: (0.0039, 0.0035, {"t_pct": 0.03, "path_error": 0.0002}),
    HAND: (0.0035, 0.00073, {"gain": 0.5}),
    HAND_RGBD: (0.0051, 0.0018, {"gain": 0.5}),
}
RENDERED: dict[str, tuple[str, Sensor, int]] = {
    DRIVE: ("driving", "stereo", 50),
    HAND: ("handheld", "stereo", 60),
    HAND_RGBD: ("handheld", "rgbd", 60),
}
SEED = 7


@pytest.fixture
def recording(request: pytest.FixtureRequest) -> Callable[[str], Source]:
    """Return a function that opens a recorded start, or skips, or renders one."""

    def read(name: str) -> Source:
        if name not in RENDERED:
            folder: Path = request.getfixturevalue("gvo_data")
            return gvo.open_recording(folder / name)
        world, sensor, n_frames = RENDERED[name]
        return rendered(world, sensor, n_frames=n_frames, seed=SEED, scale=0.5)

    return read


def evaluations(source: Source, *settings: str) -> tuple[gvo.Evaluation, gvo.Evaluation]:
    """Compare raw and smoothed with the truth; every frame must be registered."""
    config = gvo.load_configuration(settings=settings)
    odometry = gvo.Odometry(source.info.camera, config)
    raw: list[gvo.Estimate] = []
    smoothed: list[gvo.Estimate] = []
    for frame in gvo.frames(source, gvo.Config()):
        if isinstance(frame, gvo.FaultyFrame):
            assert frame.is_unpaired, frame.reason
            continue
        result = odometry.track(frame)
        raw.append(result.raw)
        smoothed += result.finished
    smoothed += odometry.finish()
    smoothed.sort(key=lambda estimate: estimate.stamp_ns)
    assert {estimate.status for estimate in [*raw, *smoothed]} == {gvo.Status.OK}
    truth = source.ground_truth()
    assert truth is not None
    first, second = (
        gvo.evaluate(truth, gvo.Trajectory.of(estimates), name=name)
        for name, estimates in (("raw", raw), ("smoothed", smoothed))
    )
    return first, second


def exceeded(name: str, raw: gvo.Evaluation, smoothed: gvo.Evaluation) -> list[str]:
    """Return each error above its limit, a line each."""
    raw_m, smoothed_m, others = LIMITS[name]
    measured = [("raw ATE", raw.ate_m, raw_m), ("smoothed ATE", smoothed.ate_m, smoothed_m)]
    if "gain" in others:
        measured.append(("smoothed / raw", smoothed.ate_m / raw.ate_m, others["gain"]))
    if "t_pct" in others:
        for each in (raw, smoothed):
            assert each.t_pct is not None
            assert each.path_ratio is not None
            measured.append((f"{each.name} t_err", each.t_pct, others["t_pct"]))
            error = abs(each.path_ratio - 1.0)
            measured.append((f"{each.name} path error", error, others["path_error"]))
    return [f"{what} {error:.4g} > {limit:.4g}" for what, error, limit in measured if error > limit]


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=[] if name in RENDERED else [pytest.mark.recorded])
        for name in LIMITS
    ],
)
def test_errors_stay_below_their_limits(recording: Callable[[str], Source], name: str) -> None:
    # Of some two dozen seeds one leaves freiburg1_rpy with a wrong step: the second best of three.
    seeds = [0] if name in RENDERED else [0, 1, 2]
    source = recording(name)
    misses: list[list[str]] = []
    for seed in seeds:
        misses.append(exceeded(name, *evaluations(source, f"ransac.seed={seed}")))
        if misses.count([]) > len(seeds) // 2:  # whatever the rest would give
            return
    pytest.fail(str(misses))


@pytest.mark.recorded
def test_plain_umeyama_drifts_little(recording: Callable[[str], Source]) -> None:
    settings = ["registration.refine=none", "registration.weighting=none"]
    settings.append("ransac.inlier_metric=distance")
    for evaluation in evaluations(recording(KITTI), *settings):
        assert evaluation.t_pct is not None
        assert evaluation.t_pct <= 2.0
