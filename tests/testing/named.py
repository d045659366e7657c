"""A fault with a name, what it means, and what a run makes of it."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import Literal, TypeAlias

from gvo.io.recording import Sensor, Source
from gvo.testing.faults import Fault, FaultySource, PixelFault

Group: TypeAlias = Literal[
    "delivery", "stamps", "light and lens", "transfer", "stereo", "depth", "calibration"
]
ExitCode: TypeAlias = Literal[0, 2, 3]

_BOTH: tuple[Sensor, ...] = ("stereo", "rgbd")


@dataclass(frozen=True, slots=True, kw_only=True)
class NamedFault:
    """Faults with a name, for recordings of at least `n_frames` frames.

    Parameters
    ----------
    name : str
    group : str
        What kind it is.
    meaning : str
        What is wrong, one line.
    happens : str
        What a run makes of it, one line.
    exit_code : {0, 2, 3}
        Of `gvo run`: complete, nothing usable, partly.
    found_by : str
        Which check of `gvo check` names it, without the name of the stream; empty: none.
    make : callable
        Returns the faults, given the recording that they are put into.
    sensors : tuple of {"stereo", "rgbd"}
    n_frames : int
    is_silent : bool
        Poses are wrong, by more than their covariances say, and the run does not tell.
    """

    name: str
    group: Group
    meaning: str
    happens: str
    exit_code: ExitCode
    found_by: str
    make: Callable[[Source], tuple[Fault, ...]]
    sensors: tuple[Sensor, ...] = _BOTH
    n_frames: int = 20
    is_silent: bool = False

    def wrap(self, source: Source, *, is_lasting: bool = False) -> FaultySource:
        """Return the recording with the fault.

        Parameters
        ----------
        source : Source
        is_lasting : bool
            Faults of pixels last from the first frame to the last one: a check that looks at a
            few frames of a recording finds what lasts.
        """
        return FaultySource(source, *map(_lasting if is_lasting else _as_is, self.make(source)))


def fixed(*faults: Fault) -> Callable[[Source], tuple[Fault, ...]]:
    """Return faults that do not depend on the recording."""
    return lambda _: faults


def describe_faults(faults: Iterable[NamedFault]) -> str:
    """Return the faults as a table in Markdown, a row each."""
    header = "| fault | what is wrong | what happens | exit code | found by `gvo check` |"
    lines = [header, "|---|---|---|---|---|"]
    for fault in faults:
        sensor = "" if len(fault.sensors) > 1 else f" ({_SENSOR_TEXTS[fault.sensors[0]]})"
        found = f"`{fault.found_by}`" if fault.found_by else "no"
        lines.append(
            f"| `{fault.name}`{sensor} | {fault.meaning} | {fault.happens} "
            f"| {fault.exit_code} | {found} |"
        )
    return "\n".join(lines)


_SENSOR_TEXTS: dict[Sensor, str] = {"stereo": "stereo", "rgbd": "RGB-D"}


def _as_is(fault: Fault) -> Fault:
    return fault


def _lasting(fault: Fault) -> Fault:
    if not isinstance(fault, PixelFault):
        return fault
    return replace(fault, first=0, end=None)
