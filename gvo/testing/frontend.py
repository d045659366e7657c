"""The contract of a front-end, as a test that one's own suite can call."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import fields, is_dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np

from gvo.frontend.offsets import RigOffsets
from gvo.frontend.protocol import CheckedFrontend, Frontend, Recognizer, find_fault
from gvo.geometry import se3
from gvo.geometry.camera import PinholeCamera, StereoCamera
from gvo.types import (
    Failure,
    FloatArray,
    MotionPrior,
    RelativePose,
    RgbdFrame,
    Stamped,
    StereoFrame,
)

# Of six honest errors, 3 in 10,000 are farther off; it leaves room for covariances a little small.
_AGREEMENT_SIGMAS = 5.0
# Differences below this are none, however sure the front-end is: radians and metres.
_NEGLIGIBLE_RAD = 1e-4
_NEGLIGIBLE_M = 1e-3
# A prior is made wrong by so many sigmas, but not by more than a search has to forgive.
_PRIOR_SIGMAS = np.array([10.0, -10.0, 10.0, -10.0, 10.0, -10.0])
_PRIOR_LIMITS = np.repeat([0.005, 0.02], 3)
_SHIFT_PX = 3
_SHIFT_DEPTH_M = 5.0
# How deep a fingerprint looks into what a value is made of.
_MAX_DEPTH = 6
_MAX_PLACE_BYTES = 100_000


class ContractError(AssertionError):
    """A front-end breaks its contract; the message says how, in one line."""


def check_frontend(
    frontend: Frontend[Any], frames: Sequence[Stamped], *, blank: Stamped | None = None
) -> None:
    """Check that a front-end keeps its contract on consecutive frames of a recording.

    - `extract` keeps the stamp and leaves the frame as it is;
    - a frame registered against itself has not moved;
    - T_reference_current is rigid, its covariance symmetric and positive definite, both float64;
    - forth and back are inverse to each other, and a prior whose prediction or recent median
      motion is 10 sigma off changes nothing, both within 5 sigma of their covariances;
    - it maps the current frame to the reference, not the other way round (camera images only);
    - the same call gives the same result, bit for bit, and changes none of its arguments;
    - where nothing can be seen there is a falsy `Failure` with a reason, and no exception;
    - `describe` and `recognize`, where it has them, give places of at most 100 kB, in which the
      same frame is recognized, within 5 sigma of where it is, and frames without anything are not.

    Differences below 0.1 mrad and 1 mm count as none.

    Parameters
    ----------
    frontend : Frontend
    frames : sequence of at least three frames
        Consecutive ones, with motion and something to see.
    blank : frame, optional
        One without anything to see, stamped later than the others; made from the first where
        this is a StereoFrame or RgbdFrame, else left out.

    Raises
    ------
    ContractError
        With the first breach. It is an AssertionError, so that test runners show it as one.
    ValueError
        For fewer than three frames.

    Examples
    --------
    In a test of your own::

        def test_my_front_end_keeps_the_contract() -> None:
            recording = gvo.SyntheticRecording("handheld", "stereo", n_frames=3)
            frames = list(gvo.frames(recording, gvo.Config()))
            check_frontend(MyFrontend(recording.info.camera), frames)
    """
    if len(frames) < 3:
        raise ValueError(f"the contract is checked on at least three frames, got {len(frames)}")
    _check_capabilities(frontend)
    seen = [_extract(frontend, frame) for frame in frames]
    for each in seen[:3]:
        result = _find(frontend, each, each)
        name = f"register of the frame at {each.stamp_ns} with itself and the identity"
        _check_agreement(name, result.T_reference_current, result.covariance)
    if isinstance(frames[0], StereoFrame | RgbdFrame):
        _check_direction(frontend, frames[0], frames[1].stamp_ns + 1)
    results = [_find(frontend, *pair) for pair in pairwise(seen)]
    for pair, result in zip(pairwise(seen), results, strict=True):
        _check_inverse(frontend, result, *pair)
        _check_prior(frontend, result, *pair)
    for nothing in _without_anything(frames[0], frames[-1].stamp_ns, blank):
        _check_places(CheckedFrontend(frontend).recognizer, seen[0], nothing)
        _check_nothing_seen(frontend, seen[0], nothing)


def _require(is_kept: bool | np.bool_, message: str) -> None:
    if not is_kept:
        raise ContractError(message)


def _check_capabilities(frontend: Frontend[Any]) -> None:
    """Check the values of what a front-end offers besides; else they are ignored without a word."""
    for name, kinds in (("camera", StereoCamera | PinholeCamera), ("rig_offsets", RigOffsets)):
        kind = type(getattr(frontend, name, None))
        is_right = issubclass(kind, kinds | None)
        _require(is_right, f"{name} is a {kind.__name__}, which is none of {kinds}")
    methods = {n: getattr(frontend, n, None) for n in ("reconfigure", "describe", "recognize")}
    for name, method in methods.items():
        _require(method is None or callable(method), f"{name} must be a method")
    is_alone = (methods["describe"] is None) != (methods["recognize"] is None)
    _require(not is_alone, "of describe and recognize, one needs the other")


def _extract(frontend: Frontend[Any], frame: Stamped) -> Stamped:
    """Extract twice; check the stamp, and that nothing changes."""
    before = fingerprint(frame)
    first: Stamped = frontend.extract(frame)
    _require(fingerprint(frame) == before, f"extract changes the frame at {frame.stamp_ns}")
    stamp_ns = getattr(first, "stamp_ns", None)
    message = f"extract must keep the stamp {frame.stamp_ns}, its observations have {stamp_ns}"
    _require(stamp_ns == frame.stamp_ns, message)
    message = f"extract gives other observations of the frame at {frame.stamp_ns} when repeated"
    _require(fingerprint(first) == fingerprint(frontend.extract(frame)), message)
    return first


def _register(
    frontend: Frontend[Any], reference: Stamped, current: Stamped, prior: MotionPrior | None
) -> RelativePose | Failure:
    """Register twice; check what holds for any arguments."""
    name = f"register({reference.stamp_ns}, {current.stamp_ns})"
    given = reference, current, prior
    before = [fingerprint(value) for value in given]
    first, second = frontend.register(*given), frontend.register(*given)
    for k, part in enumerate(("reference", "current", "prior")):
        _require(fingerprint(given[k]) == before[k], f"{name} changes its argument {part}")
    is_result, kind = isinstance(first, RelativePose | Failure), type(first).__name__
    _require(is_result, f"{name} must return RelativePose or Failure, got {kind}")
    is_same = fingerprint(first) == fingerprint(second)
    _require(is_same, f"{name} gives another result when called again with the same arguments")
    fault = find_fault(first) if isinstance(first, RelativePose) else ""
    _require(not fault, f"{name}: {fault}")
    return first


def _find(frontend: Frontend[Any], reference: Stamped, current: Stamped) -> RelativePose:
    """Register two frames that see the same."""
    result = _register(frontend, reference, current, None)
    if isinstance(result, Failure):
        name = f"register({reference.stamp_ns}, {current.stamp_ns})"
        raise ContractError(f"{name} fails on consecutive frames: {result.reason}")
    return result


def _check_agreement(name: str, difference: FloatArray, covariance: FloatArray) -> None:
    """Check that a transform is the identity within its covariance."""
    twist = se3.log(difference)
    rotation, translation = np.linalg.norm(twist[:3]), np.linalg.norm(twist[3:])
    if rotation < _NEGLIGIBLE_RAD and translation < _NEGLIGIBLE_M:
        return
    n_sigmas = float(np.sqrt(max(float(se3.mahalanobis(twist, covariance)), 0.0)))
    off = f"{n_sigmas:.1f} sigma ({1e3 * rotation:.2f} mrad, {1e3 * translation:.2f} mm)"
    _require(n_sigmas <= _AGREEMENT_SIGMAS, f"{name} disagree by {off}")


def _check_inverse(
    frontend: Frontend[Any], forth: RelativePose, reference: Stamped, current: Stamped
) -> None:
    back = _find(frontend, current, reference)
    name = f"register({reference.stamp_ns}, {current.stamp_ns})"
    difference = forth.T_reference_current @ back.T_reference_current
    covariance = se3.compose_covariance(forth.covariance, back.T_reference_current, back.covariance)
    _check_agreement(f"{name} and its inverse the other way round", difference, covariance)


def _check_prior(
    frontend: Frontend[Any], result: RelativePose, reference: Stamped, current: Stamped
) -> None:
    T, sigmas = result.T_reference_current, np.sqrt(np.diag(result.covariance))
    T_wrong = T @ se3.exp(np.clip(_PRIOR_SIGMAS * sigmas, -_PRIOR_LIMITS, _PRIOR_LIMITS))
    name = f"register({reference.stamp_ns}, {current.stamp_ns})"
    for kind, prior in (
        ("a prior", MotionPrior(T_predicted=T)),
        ("a prior", MotionPrior(T_predicted=T_wrong)),
        ("a recent median motion", MotionPrior(T_predicted=T, T_recent=T)),
        ("a recent median motion", MotionPrior(T_predicted=T, T_recent=T_wrong)),
    ):
        guided = _register(frontend, reference, current, prior)
        if isinstance(guided, Failure):
            raise ContractError(f"{name} fails with {kind} and not without: {guided.reason}")
        difference = se3.invert(T) @ guided.T_reference_current
        covariance = result.covariance + guided.covariance
        _check_agreement(f"{name} with and without {kind}", difference, covariance)


def _check_direction(
    frontend: Frontend[Any], frame: StereoFrame | RgbdFrame, stamp_ns: int
) -> None:
    """Shift images to the left: the camera has turned, or moved, to the right."""
    shifted: dict[str, Any] = {
        name: np.pad(image[:, _SHIFT_PX:], ((0, 0), (0, _SHIFT_PX)), mode="edge")
        for name, image in _images_of(frame).items()
    }
    turned = replace(frame, stamp_ns=stamp_ns, **shifted)
    result = _find(frontend, frontend.extract(frame), frontend.extract(turned))
    ahead = result.T_reference_current @ [0.0, 0.0, _SHIFT_DEPTH_M, 1.0]
    _require(
        ahead[0] > 0.0,
        "register must return T_reference_current, which maps the current frame to the reference: "
        "images shifted to the left are a turn to the right, and it says the opposite",
    )


def _images_of(frame: StereoFrame | RgbdFrame) -> dict[str, Any]:
    names = ("left", "right") if isinstance(frame, StereoFrame) else ("image", "depth")
    return {name: getattr(frame, name) for name in names}


def _without_anything(first: Stamped, last_ns: int, blank: Stamped | None) -> list[Stamped]:
    """Return frames that have nothing in common with any other: uniform ones, and noise."""
    frames = [] if blank is None else [blank]
    if not isinstance(first, StereoFrame | RgbdFrame):
        return frames
    rng = np.random.default_rng(0)
    images = _images_of(first)
    uniform: dict[str, Any] = {name: np.full_like(image, 100) for name, image in images.items()}
    if "depth" in images:
        uniform["depth"] = np.full_like(images["depth"], np.nan)
    grey = {name: image for name, image in images.items() if name != "depth"}
    noise: dict[str, Any] = {
        name: rng.integers(0, 256, image.shape, dtype=np.uint8) for name, image in grey.items()
    }
    contents = enumerate((uniform, noise), start=1)
    return frames + [replace(first, stamp_ns=last_ns + n, **each) for n, each in contents]


def _check_places(recognizer: Recognizer | None, seen: Stamped, frame: Stamped) -> None:
    """Recognize a frame in its own place, and one without anything not."""
    if recognizer is None:
        return
    name = f"recognize of the frame at {seen.stamp_ns} in its own place"
    place, nothing = _place_of(recognizer, seen), recognizer.extract(frame)
    result = recognizer.recognize(place, place, seen)
    if isinstance(result, Failure):
        raise ContractError(f"{name} fails: {result.reason}")
    _require(not find_fault(result), f"{name}: {find_fault(result)}")
    _check_agreement(name, result.T_reference_current, result.covariance)
    result = recognizer.recognize(place, _place_of(recognizer, nothing), nothing)
    name = f"frames without anything in common ({seen.stamp_ns}, {frame.stamp_ns})"
    _require(isinstance(result, Failure), f"{name} are recognized")


def _place_of(recognizer: Recognizer, observations: Stamped) -> Any:  # noqa: ANN401
    name = f"describe of the frame at {observations.stamp_ns}"
    place, again = (recognizer.describe(observations) for _ in range(2))
    _require(fingerprint(place) == fingerprint(again), f"{name} gives another place when repeated")
    for attribute in ("stamp_ns", "points_cam", "descriptors_left"):
        is_there = getattr(place, attribute, None) is not None
        _require(is_there, f"{name} gives a place without {attribute}")
    n_bytes = sum(len(part) for part in _parts(place, _MAX_DEPTH))
    _require(n_bytes <= _MAX_PLACE_BYTES, f"{name} gives a place of {1e-3 * n_bytes:.0f} kB")
    return place


def _check_nothing_seen(frontend: Frontend[Any], seen: Stamped, frame: Stamped) -> None:
    name = f"frames without anything in common ({seen.stamp_ns}, {frame.stamp_ns})"
    still = np.eye(4)
    priors = None, MotionPrior(T_predicted=still), MotionPrior(T_predicted=still, T_recent=still)
    try:
        nothing = frontend.extract(frame)
        pairs = (seen, nothing), (nothing, seen)
        results = [_register(frontend, a, b, prior) for a, b in pairs for prior in priors]
    except ContractError:
        raise
    except Exception as error:  # whatever it is, it is the breach that is looked for
        reason = f"{type(error).__name__}: {error}"
        raise ContractError(f"{name} raise {reason}; a Failure is expected") from error
    for result in results:
        if not isinstance(result, Failure):
            raise ContractError(f"{name} are registered")
        _require(bool(result.reason.strip()), f"the Failure of {name} gives no reason")


def fingerprint(value: object) -> str:
    """Return a digest of all arrays and plain values that a value holds, six levels deep.

    Fields of data classes with `compare=False` are no part of the value.
    """
    return hashlib.blake2b(b"|".join(_parts(value, _MAX_DEPTH))).hexdigest()


def _parts(value: object, depth: int) -> Iterator[bytes]:
    if isinstance(value, np.ndarray) and value.dtype != object:
        yield f"{value.dtype}{value.shape}".encode()
        yield np.ascontiguousarray(value).tobytes()
    elif isinstance(value, bool | int | float | complex | str | bytes | np.generic | None):
        yield repr(value).encode()
    elif depth > 0:
        yield type(value).__name__.encode()
        for name, member in _members(value):
            yield name.encode()
            yield from _parts(member, depth - 1)


def _members(value: object) -> Iterator[tuple[str, object]]:
    if is_dataclass(value):
        own = (field.name for field in fields(value) if field.compare)
        yield from ((name, getattr(value, name)) for name in own)
    elif isinstance(value, Mapping):
        yield from ((repr(key), member) for key, member in value.items())
    elif isinstance(value, list | tuple):
        yield from ((str(index), member) for index, member in enumerate(value))
    else:
        yield from getattr(value, "__dict__", {}).items()
