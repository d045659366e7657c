"""The registrations of a frame against earlier ones, and the attempts that each made."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from gvo._trace import Trace
from gvo.types import Failure, RelativePose


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Registration:
    """One registration of the current frame.

    Parameters
    ----------
    reference_ns : int
        Stamp of the reference.
    result : RelativePose or Failure
    attempts : list of Trace
        Each begins with how it matched.
    """

    reference_ns: int
    result: RelativePose | Failure
    attempts: list[Trace]


def registrations_of(trace: Trace) -> list[Registration]:
    """Return the registrations of a frame in order."""
    return [
        Registration(
            reference_ns=part[0].values["reference"].stamp_ns,
            result=end["result"],
            attempts=part.before("frontend.end").split("attempt"),
        )
        for part in trace.split("frontend.begin")
        if (end := part.find("frontend.end")) is not None
    ]


def has_prior(attempt: Trace) -> bool:
    """Tell whether an attempt started from a predicted motion."""
    prior = attempt[0].values["prior"]
    return prior is not None and not np.array_equal(prior, np.eye(4))


def describe(registration: Registration, indices: Mapping[int, int]) -> list[str]:
    """Describe the attempts of a registration, one a line.

    Parameters
    ----------
    registration : Registration
    indices : mapping of int to int
        Numbers of frames by their stamps.
    """
    against = f"against frame {indices[registration.reference_ns]}"
    answer = _answer(registration.result)
    if not registration.attempts:
        return [f"{against}: {answer}"]
    *failed, last = registration.attempts
    lines = [f"{against}, {_method(attempt)}: {_outcome(attempt)}" for attempt in failed]
    return [*lines, f"{against}, {_method(last)}: {answer}"]


def _method(attempt: Trace) -> str:
    values = attempt[0].values
    if values["method"] == "descriptors":
        place = "predicted" if has_prior(attempt) else "previous"
        return f"descriptors within {values['radius_px']:g} px of the {place} pixels"
    if values["is_wide"]:
        return "tracks with the wide pyramid, checked backwards"
    return "tracks from the predicted pixels"


def _outcome(attempt: Trace) -> str:
    """Tell what came of an attempt that another one followed."""
    ends = attempt.find("registration.refined") or attempt.find("registration.consensus") or {}
    answer = ends.get("refined", ends.get("consensus"))
    if answer is None:
        return "not registered"
    if isinstance(answer, Failure):
        return answer.reason
    return f"{int(answer.inliers.sum())} inliers, used as the prediction of the next attempt"


def _answer(result: RelativePose | Failure) -> str:
    if isinstance(result, Failure):
        return result.reason
    return f"registered, {result.n_inliers} inliers of {result.n_matches} matches"
