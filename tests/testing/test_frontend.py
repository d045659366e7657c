"""The contract test passes for the front-ends of the project and finds planted faults."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np
import pytest

import gvo
from gvo.config import Config
from gvo.frontend.descriptor import DescriptorFrontend, DescriptorObservations
from gvo.frontend.factory import make_frontend
from gvo.frontend.klt import KltFrontend, KltObservations
from gvo.geometry import se3
from gvo.io.recording import Sensor
from gvo.testing import ContractError, check_frontend
from gvo.types import Failure, FloatArray, Frame, MotionPrior, RelativePose
from tests.make.recordings import frames_of

Result = RelativePose | Failure


@cache
def recording(sensor: Sensor) -> gvo.SyntheticRecording:
    return gvo.SyntheticRecording("handheld", sensor, n_frames=3, scale=0.3)


@cache
def frames(sensor: Sensor) -> list[Frame]:
    return frames_of(recording(sensor))


def configure(kind: str = "klt") -> Config:
    return Config.model_validate({"frontend": {"kind": kind}, "klt": {"n_corners": 300}})


@pytest.mark.parametrize(("kind", "sensor"), [("descriptor", "stereo"), ("klt", "rgbd")])
def test_the_front_ends_of_the_project_keep_the_contract(kind: str, sensor: Sensor) -> None:
    check_frontend(make_frontend(recording(sensor).info.camera, configure(kind)), frames(sensor))


class Spoilt(KltFrontend):
    """A front-end that spoils what it registers, knowing the prior that it was given."""

    def __init__(self, spoil: Callable[[Result, MotionPrior | None], Any]) -> None:
        super().__init__(recording("stereo").info.camera, configure())
        self._spoil = spoil

    def register(
        self, reference: KltObservations, current: KltObservations, prior: MotionPrior | None = None
    ) -> Result:
        spoilt: Result = self._spoil(super().register(reference, current, prior), prior)
        return spoilt


def spoil_found(change: Callable[[RelativePose], Any]) -> Spoilt:
    return Spoilt(lambda result, _: change(result) if isinstance(result, RelativePose) else result)


def spoil_pose(change: Callable[[FloatArray], FloatArray]) -> Spoilt:
    return spoil_found(
        lambda found: replace(found, T_reference_current=change(found.T_reference_current))
    )


def spoil_covariance(change: Callable[[FloatArray], FloatArray]) -> Spoilt:
    return spoil_found(
        lambda found: replace(
            found, covariance=change(found.covariance), passing_covariance=np.zeros((6, 6))
        )
    )


def spoil_failure(change: Callable[[MotionPrior | None], Result]) -> Spoilt:
    return Spoilt(lambda result, prior: result or change(prior))


def offset(T: FloatArray) -> FloatArray:
    return np.asarray(T @ se3.exp(np.array([0.0, 0.0, 0.0, 0.05, 0.0, 0.0])))


def scaled(T: FloatArray) -> FloatArray:
    return np.asarray(T * [1.001, 1.001, 1.001, 1.0])


def noisy(T: FloatArray, rng: np.random.Generator) -> FloatArray:
    return np.asarray(T @ se3.exp(1e-9 * rng.normal(size=6)))


def lopsided(covariance: FloatArray) -> FloatArray:
    changed = covariance.copy()
    changed[0, 1] += 0.1 * covariance[0, 0]
    return changed


def believing(name: str) -> Spoilt:
    """Return a front-end that finds the pose which the prior holds by this name."""

    def believe(result: Result, prior: MotionPrior | None) -> Result:
        T = getattr(prior, name, None)
        if isinstance(result, Failure) or T is None:
            return result
        return replace(result, T_reference_current=T.copy())

    return Spoilt(believe)


def changing(name: str) -> Spoilt:
    """Return a front-end that moves the pose which the prior holds by this name."""

    def change(result: Result, prior: MotionPrior | None) -> Result:
        T = getattr(prior, name, None)
        if T is not None:
            T.setflags(write=True)
            T[0, 3] += 1.0
        return result

    return Spoilt(change)


def raise_on_nothing(_: MotionPrior | None) -> Result:
    raise IndexError("no matches")


class Unspoilt(Spoilt):
    def __init__(self) -> None:
        super().__init__(lambda result, _: result)


class ChangesTheFrame(Unspoilt):
    def extract(self, frame: Frame) -> KltObservations:
        observations = super().extract(frame)
        assert isinstance(frame, gvo.StereoFrame)
        frame.left[:] //= 2
        return observations


class LosesTheStamp(Unspoilt):
    def extract(self, frame: Frame) -> KltObservations:
        return super().extract(replace(frame, stamp_ns=frame.stamp_ns // 1000))


class ExtractsAtRandom(DescriptorFrontend):
    """A front-end with observations that are open to view."""

    def __init__(self) -> None:
        super().__init__(recording("stereo").info.camera, configure("descriptor"))

    def extract(self, frame: Frame) -> DescriptorObservations:
        observations = super().extract(frame)
        return replace(observations, n_keypoints=int(np.random.default_rng().integers(2**62)))


class ChangesObservations(ExtractsAtRandom):
    def extract(self, frame: Frame) -> DescriptorObservations:
        return DescriptorFrontend.extract(self, frame)

    def register(
        self,
        reference: DescriptorObservations,
        current: DescriptorObservations,
        prior: MotionPrior | None = None,
    ) -> Result:
        result = super().register(reference, current, prior)
        current.points_cam[:1] += 1.0
        return result


def with_places(**methods: Any) -> KltFrontend:
    """Return a front-end with other methods of places."""
    kind: type[KltFrontend] = type("Places", (KltFrontend,), methods)
    return kind(recording("stereo").info.camera, configure())


def as_large_as_images(frontend: KltFrontend, observations: KltObservations) -> Any:
    place = KltFrontend.describe(frontend, observations)
    return replace(place, patches=np.repeat(place.patches, 40, axis=0))


def recognize_anything(*_: Any) -> RelativePose:
    return RelativePose(T_reference_current=np.eye(4), covariance=np.eye(6))


def recognize_elsewhere(frontend: KltFrontend, *places: Any) -> Result:
    found = KltFrontend.recognize(frontend, *places)
    if isinstance(found, Failure):
        return found
    return replace(found, T_reference_current=offset(found.T_reference_current))


@pytest.mark.parametrize(
    ("frontend", "reason"),
    [
        (with_places(describe=as_large_as_images), r"describe.* gives a place of \d{3,} kB"),
        (with_places(describe=lambda _, it: Scan(it.stamp_ns, np.eye(4))), "without points_cam"),
        (with_places(recognize=lambda *_: Failure(reason="dark")), "in its own place fails: dark"),
        (with_places(recognize=recognize_elsewhere), "in its own place disagree by"),
        (with_places(recognize=recognize_anything), "in common .* are recognized"),
        (spoil_pose(se3.invert), "maps the current frame to the reference"),
        (spoil_pose(offset), "with itself and the identity disagree"),
        (spoil_pose(scaled), "holds no rotation"),
        (spoil_pose(lambda T: noisy(T, np.random.default_rng())), "gives another result"),
        (spoil_covariance(lopsided), "not symmetric"),
        (spoil_found(lambda _: None), "must return RelativePose or Failure, got NoneType"),
        (spoil_found(lambda _: Failure(reason="no idea")), "fails on consecutive.*: no idea"),
        (believing("T_recent"), "^register.* a recent median motion disagree by"),
        (ChangesTheFrame(), "extract changes the frame"),
        (LosesTheStamp(), "must keep the stamp"),
        (ExtractsAtRandom(), "other observations"),
        (believing("T_predicted"), "with and without a prior disagree"),
        (changing("T_predicted"), "changes its argument prior"),
        (ChangesObservations(), "changes its argument"),
        (spoil_failure(raise_on_nothing), "raise IndexError: no matches"),
    ],
)
def test_a_fault_of_a_front_end_is_found(frontend: Any, reason: str) -> None:
    own = [
        replace(frame, left=frame.left.copy())
        for frame in frames("stereo")
        if isinstance(frame, gvo.StereoFrame)
    ]
    with pytest.raises(ContractError, match=reason) as caught:
        check_frontend(frontend, own)
    assert "\n" not in str(caught.value)


@dataclass(frozen=True)
class Scan:
    """A frame of another sensor: the pose itself, or nothing."""

    stamp_ns: int
    T_world_scan: FloatArray | None


class ScanFrontend:
    """Takes any frames, and keeps nothing but them."""

    def extract(self, frame: Scan) -> Scan:
        return frame

    def register(self, reference: Scan, current: Scan, prior: MotionPrior | None) -> Result:
        if reference.T_world_scan is None or current.T_world_scan is None:
            return Failure(reason="an empty scan")
        T = se3.invert(reference.T_world_scan) @ current.T_world_scan
        return RelativePose(T_reference_current=T, covariance=1e-6 * np.eye(6))


def test_front_ends_of_other_sensors_are_checked_with_their_own_blank_frame() -> None:
    rng = np.random.default_rng(0)
    scans = [Scan(n, se3.exp(0.1 * rng.normal(size=6))) for n in range(3)]
    check_frontend(ScanFrontend(), scans)
    check_frontend(ScanFrontend(), scans, blank=Scan(9, None))
    with pytest.raises(ContractError, match="are registered"):
        check_frontend(ScanFrontend(), scans, blank=Scan(9, np.eye(4)))


@pytest.mark.parametrize(
    ("name", "value"),
    [("camera", "none"), ("rig_offsets", 3), ("describe", True), ("reconfigure", "later")],
)
def test_what_a_front_end_offers_besides_has_to_be_usable(name: str, value: object) -> None:
    frontend = make_frontend(recording("stereo").info.camera, configure("klt"))

    class Offering:
        extract, register = frontend.extract, frontend.register

    setattr(Offering, name, value)
    with pytest.raises(ContractError, match=name):
        check_frontend(Offering(), frames("stereo"))
