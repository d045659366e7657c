"""The verdict of a run: how far, how good, what to look at, in plain words."""

from typing import Any

import pytest

from gvo.io.run_folder.verdict import imu_words, loop_words, nees_table, reference_words, verdict


def row(nees: float, *, error_m: float = 0.05, **changes: float) -> dict[str, Any]:
    told = {"rotation": nees, "translation": nees, "along": nees, "low": 0.6, "high": 1.5}
    return told | {"n": 40, "error_m": error_m, "error_deg": 0.1} | changes


def nees(bare: dict[str, Any], fitted: dict[str, Any] | None = None) -> dict[str, Any]:
    ways = {"bare": bare} | ({"fitted": fitted} if fitted else {})
    return {"raw": {"1s": {"bare": row(7.0)}, "5s": {}}, "window": {"1s": ways, "5s": {}}}


def summary(**changes: Any) -> dict[str, Any]:
    counts = {"ok": 393, "coasting": 0, "lost": 0, "resumed": 0, "skipped": 0}
    plain: dict[str, Any] = {
        "state": "complete",
        "frames": 393,
        "tracked": 393,
        "path_m": 298.4,
        "extent_m": 120.0,
        "segments": [{"id": 0, "joined_to": None}],
        "status_counts": counts,
        "errors": [
            {"name": name, "n": 393, "ate_m": ate_m, "rpe_m": 0.004}
            for name, ate_m in (("raw", 0.52), ("smoothed", 0.304))
        ],
        "truth_jump_m": 0.004,
        "nees": nees(row(1.1)),
        "rig_offsets": None,
        "warnings": [],
    }
    status_counts = counts | changes.pop("status_counts", {})
    return plain | changes | {"status_counts": status_counts}


def without_truth(**changes: Any) -> dict[str, Any]:
    return summary(errors=[], nees={}, **changes)


def optimum(counted: int, **refused: int) -> dict[str, Any]:
    n_found = counted + sum(refused.values())
    return {"loops": {"found": n_found, "counted": counted, "refused": refused}}


CLOSED = [
    {"name": "smoothed", "n": 393, "ate_m": 0.304},
    {"name": "global", "n": 393, "ate_m": 0.1},
]
LOOK = "frames.csv, which says why frames are not tracked"
LEARNT = "(learnt and corrected)"
CASES = [
    (summary(), "298 m in 393 frames, all tracked; 0.3 m from the truth. Covariances fit."),
    (without_truth(), "298 m in 393 frames, all tracked; no truth to compare with."),
    (
        without_truth(warnings=["not compared with the ground truth: x"]),
        "298 m in 393 frames, all tracked; not compared with the truth.",
    ),
    # at rest, noise adds up to a path
    (
        without_truth(path_m=1.2, extent_m=0.0123),
        "at rest, within 0.012 m, in 393 frames, all tracked; no truth to compare with.",
    ),
    # nothing could be registered: that is no rest
    (
        without_truth(path_m=0.0, extent_m=0.0, tracked=0, status_counts={"coasting": 393}),
        "0 m in 393 frames, none tracked, 393 bridged; no truth to compare with. "
        f"Worth a look: {LOOK}.",
    ),
    # lost, faulty, bridged
    (
        without_truth(
            tracked=371,
            status_counts={"lost": 12, "coasting": 5, "skipped": 5},
            segments=[{"joined_to": None}, {"joined_to": 0}, {"joined_to": None}],
        ),
        "298 m in 393 frames, 371 tracked, 5 bridged, 12 lost, 5 faulty, in 3 segments, 1 of them "
        f"joined to another; no truth to compare with. Worth a look: {LOOK}.",
    ),
    # a run that is not over
    (
        without_truth(state="interrupted", path_m=None, extent_m=None, frames=20, tracked=20),
        "20 frames so far, all tracked.",
    ),
    # a truth of a part of the frames
    (
        summary(errors=[{"name": "smoothed", "n": 64, "ate_m": 0.0039, "rpe_m": None}]),
        "298 m in 393 frames, all tracked; 0.0039 m from the truth, known of 64 frames. "
        "Covariances fit.",
    ),
    # global poses are the best where loops were closed, and else as good as the smoothed ones
    (
        summary(errors=CLOSED, nees={}, **{"global": optimum(3, odd=2)}),
        "298 m in 393 frames, all tracked; 0.1 m from the truth with loops closed.",
    ),
]


@pytest.mark.parametrize(("told", "words"), CASES)
def test_the_verdict_says_how_far_and_how_good(told: dict[str, Any], words: str) -> None:
    assert verdict(told) == words


def test_causes_come_before_looks_and_covariances() -> None:
    error = {"name": "smoothed", "n": 393, "ate_m": 9.0, "scale": 0.5, "scaled_ate_m": 0.2}
    error["jumps"] = [[7, 2_500_000_000, 4.0], [9, 3_000_000_000, 0.1]]
    offsets = {"readout_ms": 20.9, "readout_sigma_ms": 1.3}
    said = verdict(summary(sensor="rgbd", errors=[error], rig_offsets=offsets))
    assert said == (
        "298 m in 393 frames, all tracked; 9 m from the truth. Likely cause: the scale, the path "
        "is 2 times as long as the true one (is depth.scale right? times 0.5, errors fall to "
        "0.2 m); a jump of 4 m at frame 7 (2.500 s) in the estimate or the truth. Worth a look: a "
        f"rolling shutter, rows are read out over 21 ms {LEARNT}. Covariances fit."
    )


FIT = "fit"
SMALL = (
    "are too small, 4.2 times in sigma, unless the truth itself is off by 0.091 m and 0.1 deg "
    "over 1 s"
)


@pytest.mark.parametrize(
    ("found", "words"),
    [
        (row(1.0), FIT),
        (row(3.9), FIT),  # within a factor of two in sigma
        (row(0.26), FIT),
        (row(0.04), "are too large, 5 times in sigma"),
        (
            row(18.0, error_m=0.091),
            SMALL,
        ),
        # the error over a second is hardly larger than what the truth jumps by between frames
        (
            row(25.0, error_m=0.006),
            "cannot be judged, the truth jumps by 0.004 m between frames",
        ),
        # of so few motions chance makes more
        (row(5.0, high=6.0), FIT),
        (row(0.2, low=0.1), FIT),
        # rotation and translation count alike, a hand has no way to be along
        (row(0.0, rotation=10.0, translation=26.0, error_m=0.091), SMALL),
    ],
)
def test_the_verdict_judges_the_covariances(found: dict[str, Any], words: str) -> None:
    said = verdict(summary(nees=nees(found)))
    assert said == f"298 m in 393 frames, all tracked; 0.3 m from the truth. Covariances {words}."


@pytest.mark.parametrize(
    ("found", "words"),
    [
        (row(9.0), "are too small, 3 times in sigma"),
        (row(1.0), FIT),
        (row(0.04), "are too large, 5 times in sigma"),
    ],
)
def test_a_fitted_reference_is_judged_by_alone(found: dict[str, Any], words: str) -> None:
    assert verdict(summary(nees=nees(row(400.0), found))).endswith(f"Covariances {words}.")


def test_without_motions_of_the_window_the_raw_chain_is_judged() -> None:
    told = nees(row(1.0)) | {"window": {"1s": {}, "5s": {}}}
    assert "Covariances are too small, 2.6 times" in verdict(summary(nees=told))


ACROSS = "; across the way the reference cannot tell"


@pytest.mark.parametrize(
    ("found", "words"),
    [
        # three degrees of freedom turn, one is along the way
        (row(0.0, rotation=11.0, translation=1e4, along=3.0), "are too small, 3 times in sigma"),
        (row(0.0, rotation=1.0, translation=1e4, along=1.0), FIT),
    ],
)
def test_a_drive_is_judged_by_rotation_and_along(found: dict[str, Any], words: str) -> None:
    drive = summary(nees=nees(row(1.0), found), heading_deg=4.0)
    assert verdict(drive).endswith(f"Covariances {words}{ACROSS}.")
    for other in ({"path_m": 19.0}, {"heading_deg": 16.0}):
        assert "across" not in verdict(drive | other)


def test_the_table_of_nees_has_a_row_for_each_way() -> None:
    (_, *first), *rows = nees_table(nees(row(7.0), row(1.5, along=0.25)))
    assert first[-1] == "by chance"
    assert rows == [
        ("raw over 1 s, bare", "40", "7.00", "7.00", "7.00", "0.60 to 1.50"),
        ("window over 1 s, bare", "40", "7.00", "7.00", "7.00", "0.60 to 1.50"),
        ("window over 1 s, fitted", "40", "1.50", "1.50", "0.25", "0.60 to 1.50"),
    ]
    assert len(nees_table({})) == 1


def test_a_sentence_tells_what_was_fitted_of_the_reference() -> None:
    found = {"rotation_deg": [-1.0, 0.6, 0.2], "lever_m": [0.003, 0.0, 0.004], "delay_ms": -4.31}
    sigmas = {"rotation_deg": [0.1, 0.2, 0.1], "lever_m": [0.001, 0.002, 0.001], "delay_ms": 0.62}
    assert reference_words(found | {"sigmas": sigmas}) == (
        "Fitted: the reference is turned by 1.2 \u00b1 0.2 deg and lies 5 \u00b1 2 mm off, and it "
        "is 4.3 \u00b1 0.62 ms early."
    )
    assert reference_words(found | {"delay_ms": 4.31, "sigmas": sigmas}).endswith("ms late.")
    assert (
        reference_words("too short to fit")
        == "The run is too short to fit where the reference lies."
    )
    assert reference_words(None) == ""


ANEW = ": calibrate anew"


@pytest.mark.parametrize(
    ("offsets", "looks"),
    [
        ({"disparity_px": 0.9, "pixel_px": 3.1, "row_px": 0.4}, []),
        ({"disparity_px": None, "row_px": None, "readout_ms": None}, []),
        (
            {"disparity_px": 1.84, "pixel_px": 3.1, "row_px": 0.61},
            [
                f"the calibration, disparities are off by up to 1.8 px, pixels by 3.1{ANEW}",
                f"the rectification, rows of the right image are off by up to 0.61 px{ANEW}",
            ],
        ),
        (
            {"delay_ms": -9.86},
            ["the trigger, right images are exposed 9.9 ms before left ones"],
        ),
        ({"delay_ms": 0.0, "readout_ms": 3.0, "readout_sigma_ms": 0.1}, []),
        ({"readout_ms": 30.0, "readout_sigma_ms": 0.0}, []),  # as it was given
        (
            {"readout_ms": 20.9, "readout_sigma_ms": 1.3},
            ["a rolling shutter, rows are read out over 21 ms"],
        ),
    ],
)
def test_the_verdict_names_what_was_learnt(offsets: dict[str, Any], looks: list[str]) -> None:
    said = verdict(summary(rig_offsets=offsets))
    text = "; ".join(f"{look} {LEARNT}" for look in looks)
    after = said.partition(" from the truth.")[2]
    assert after == (f" Worth a look: {text}. Covariances fit." if looks else " Covariances fit.")


def test_the_verdict_says_how_good_the_calibration_is() -> None:
    offsets = {"calibration_px": 0.312, "calibration_left_px": 0.0461}
    said = verdict(summary(rig_offsets=offsets))
    assert " The calibration is good to 0.31 px, after correction to 0.046 px. Cov" in said
    del offsets["calibration_left_px"]
    assert " The calibration is good to 0.31 px. Cov" in verdict(summary(rig_offsets=offsets))


LATE = {"delay_ms": 23.8, "disparity_px": 1.4, "row_px": 0.8}
ZOOMED = {"zoom": 1.0996, "zoom_ns": 15_100_000_000, "disparity_px": 1.4, "row_px": 0.8}
STILL = {"frame": 151, "speed_mps": 9.84}


@pytest.mark.parametrize(
    ("told", "look"),
    [
        (
            {"rig_offsets": LATE},
            "the trigger, right images are exposed 24 ms after left ones (learnt, and corrected in "
            "part)",
        ),
        (
            {"rig_offsets": ZOOMED},
            "zoom and focus, which have to be fixed: the view is 1.1 times as large from 15.100 s "
            "on",
        ),
        (
            {"standstill": STILL},
            "the camera's driver, images stand still from frame 151 on, at 9.8 m/s the frame "
            "before",
        ),
    ],
)
def test_a_large_fault_is_the_one_cause(told: dict[str, Any], look: str) -> None:
    errors = [{"name": "smoothed", "n": 393, "ate_m": 9.0, "scale": 0.5, "scaled_ate_m": 0.2}]
    said = verdict(summary(errors=errors, **told))
    assert said == (
        f"298 m in 393 frames, all tracked; 9 m from the truth. Worth a look: {look}. "
        "Covariances fit."
    )


def test_the_verdict_says_what_rides_with_the_camera() -> None:
    said = verdict(summary(rig_offsets={"carried_percent": 23.4, "carried_corners": 812}))
    assert said.endswith("23 % of the view rides with the camera (812 corners): not used.")


SAME = "global is smoothed"


@pytest.mark.parametrize(
    ("told", "words"),
    [
        (None, ""),
        (optimum(0), f"no loop found; {SAME}"),
        (optimum(0, odd=2), f"no loop closed, 2 refused (2: odd); {SAME}"),
        (optimum(31, odd=18, alone=2), "31 loops closed, 20 refused (18: odd, 2: alone)"),
    ],
)
def test_loops_are_counted_in_a_line(told: dict[str, Any] | None, words: str) -> None:
    assert loop_words({"global": told}) == words
    assert loop_words({}) == ""


IMU = {"name": "/imu", "has_started": True, "n_gaps": 0, "carried_s": 0.0, "longest_s": 0.0}
IMU |= {"n_restarts": 0, "reason": "", "is_delay_learnt": False, "delay_ms": 0.0}


@pytest.mark.parametrize(
    ("told", "words"),
    [
        ({}, "the IMU had nothing to carry"),
        (
            {"n_gaps": 1, "carried_s": 0.533, "longest_s": 0.533},
            "the IMU carried the camera once, 0.53 s",
        ),
        (
            {"n_gaps": 3, "carried_s": 4.2, "longest_s": 2.5, "n_restarts": 1, "reason": "a hole"},
            "the IMU carried the camera 3 times, 4.2 s in all, 2.5 s at the longest; it was "
            "interrupted once: a hole",
        ),
        (
            {"is_delay_learnt": True, "delay_ms": 4.13},
            "the IMU had nothing to carry; its delay of 4.1 ms was learnt",
        ),
        (
            {"has_started": False, "reason": "the accelerometer feels a gravity of 1 m/s^2"},
            "the IMU /imu was not used: the accelerometer feels a gravity of 1 m/s^2",
        ),
    ],
)
def test_what_an_imu_did_is_told_in_a_line(told: dict[str, Any], words: str) -> None:
    assert imu_words({"imu": IMU | told}) == words
    assert imu_words({}) == ""
