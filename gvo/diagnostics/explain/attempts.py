"""The ways in which one frame was tried to be registered against another."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from gvo._trace import Event
from gvo.diagnostics.explain.watch import Registration
from gvo.types import RelativePose

_TRACKS = "attempt.tracks"
_MATCHES = "attempt.matches"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Attempt:
    """One way to match, and what the registration made of it.

    Parameters
    ----------
    start : Event
        How it was matched.
    events : list of Event
        What came of it.
    """

    start: Event
    events: list[Event] = field(default_factory=list)

    @property
    def is_of_tracks(self) -> bool:
        """Tell that corners were tracked; else descriptors were matched."""
        return self.start.name == _TRACKS

    def all(self, name: str) -> list[Event]:
        """Return the events of a name."""
        return [event for event in self.events if event.name == name]

    def find(self, name: str) -> Event | None:
        """Return the first event of a name."""
        return next(iter(self.all(name)), None)

    @property
    def failure(self) -> str:
        """Why it failed; empty where it did not fail in the geometry."""
        for name, key in (
            ("registration.refined", "refined"),
            ("registration.consensus", "consensus"),
        ):
            event = self.find(name)
            if event is not None:
                outcome = event.values[key]
                return "" if outcome else str(outcome.reason)
        return "not registered"


def attempts_of(events: Sequence[Event]) -> list[Attempt]:
    """Split what happened in a registration into its attempts."""
    attempts: list[Attempt] = []
    for event in events:
        if event.name in (_TRACKS, _MATCHES):
            attempts.append(Attempt(start=event))
        elif attempts:
            attempts[-1].events.append(event)
    return attempts


def n_chain_calls(calls: Sequence[Registration], registration: RelativePose | None) -> int:
    """Tell how many of the first registrations of a frame were those of the raw chain.

    Where it failed, its last one was without a prediction; links to keyframes always have one.
    """
    found = [
        n
        for n, call in enumerate(calls, start=1)
        if not call.is_relocalization
        and (call.prior is None if registration is None else call.result is registration)
    ]
    return found[-1] if found else 0


def describe(call: Registration, indices: Mapping[int, int]) -> list[str]:
    """Describe the attempts of a registration, a line each.

    Parameters
    ----------
    call : Registration
    indices : mapping of int to int
        Of frames by their stamps.
    """
    reference = indices[call.reference_ns]
    attempts = attempts_of(call.events)
    lines = []
    for number, attempt in enumerate(attempts, start=1):
        is_last = number == len(attempts)
        lines.append(
            f"against frame {reference}, {_method(attempt)}: {_outcome(attempt, call, is_last)}"
        )
    return lines or [f"against frame {reference}: {_answer(call)}"]


def _method(attempt: Attempt) -> str:
    values = attempt.start.values
    if not attempt.is_of_tracks:
        place = "the previous pixels" if values["prior"] is None else "the predicted pixels"
        return f"descriptors within {values['radius_px']:g} px of {place}"
    if values["is_wide"]:
        return "tracks with the wide pyramid, followed back"
    return "tracks from the predicted pixels"


def _outcome(attempt: Attempt, call: Registration, is_last: bool) -> str:
    if is_last:
        return _answer(call)
    event = attempt.find("registration.refined")
    if attempt.failure or event is None:
        return attempt.failure
    refined = event.values["refined"]
    return f"{int(refined.inliers.sum())} inliers, taken as the prediction of the next attempt"


def _answer(call: Registration) -> str:
    if isinstance(call.result, RelativePose):
        return f"registered, {call.result.n_inliers} inliers of {call.result.n_matches} matches"
    return call.result.reason
