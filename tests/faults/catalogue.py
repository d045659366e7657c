"""The faults of docs/SECURITY.md: how they are made, and what the page says of them."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import pytest

from gvo.io.recording import Sensor, Source
from gvo.testing.faults import Fault, PixelFault
from tests import faults as made
from tests.faults.delivery import FaultySource
from tests.faults.images import of_all, of_depth, spoilt

PAGE = Path(__file__).parents[2] / "docs/SECURITY.md"
_SENSORS: dict[str | None, tuple[Sensor, ...]] = {
    None: ("stereo", "rgbd"),
    "stereo": ("stereo",),
    "RGB-D": ("rgbd",),
}
_IO_ERROR = "Input/output error"
_N_FRAMES = {"gap": 322, "lost": 320}
# One of each group.
_IN_SHORT_RUN = (
    "dropped-some", "stamp-ahead", "black", "transposed", "exchanged", "depth-nan", "baseline-in-mm"
)  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class NamedFault:
    """A row of the page: faults with a name, for recordings of at least `n_frames` frames.

    `found_by` is the check of `gvo check` that names the fault, without the name of the stream;
    empty: none. With `is_silent`, poses are wrong by more than their covariances say.
    """

    name: str
    group: str
    sensors: tuple[Sensor, ...]
    exit_code: int
    found_by: str
    is_silent: bool

    @property
    def n_frames(self) -> int:
        return _N_FRAMES.get(self.name, 20)

    def wrap(self, source: Source, *, is_lasting: bool = False) -> FaultySource:
        """Return the recording with the fault, in all frames where it is lasting and of pixels."""
        faults = MADE[self.name]
        faults = faults(source) if callable(faults) else faults
        return FaultySource(source, *map(_lasting, faults) if is_lasting else faults)


def _lasting(fault: Fault) -> Fault:
    return replace(fault, first=0, end=None) if isinstance(fault, PixelFault) else fault


def _elsewhere(source: Source) -> list[Fault]:
    """Show the mirrored world, 10 s later: as strange a place as any."""
    exchange = [made.Exchanged()] if source.info.sensor == "stereo" else []
    other = FaultySource(source, of_all(made.mirrored), *exchange)
    return [made.Elsewhere(other=other, first=10), made.stamps_moved(10.0, first=10)]


def _gaining(stamp_ns: int, start_ns: int) -> int:
    return start_ns + round(1.02 * (stamp_ns - start_ns))


MADE: dict[str, list[Fault] | Callable[[Source], list[Fault]]] = {
    # delivery
    "dropped-one": [made.Dropped(first=10, end=11)],
    "dropped-some": [made.Dropped(first=1, share=0.3, seed=1)],
    "dropped-right": [made.Dropped(first=8, end=12, streams=(1,))],
    "dropped-depth": [made.Dropped(first=8, end=12, streams=(1,))],
    "no-right": [made.Dropped(streams=(1,))],
    "no-depth": [made.Dropped(streams=(1,))],
    "no-colour": [made.Dropped(streams=(0,))],
    "empty": [made.Dropped()],
    "one-frame": [made.Dropped(first=1)],
    "delivered-twice": [made.Repeated(first=6, end=9)],
    "frozen": [made.Frozen(first=10, end=16)],
    "late-frame": [made.Late(first=8, end=9, by=3)],
    "late-right": [made.Late(by=3, streams=(1,))],
    "shuffled": [made.Shuffled(within=3)],
    "cut-off": [made.BrokenOff(first=12)],
    "disk-fails": [made.BrokenOff(first=12, error=OSError, message=_IO_ERROR)],
    "image-damaged": [made.Unloadable(first=8, end=10)],
    "image-unreadable": [made.Unloadable(first=8, end=10, error=OSError, message=_IO_ERROR)],
    "decoder-fails": [made.Unloadable(first=8, end=10, error=cv2.error, message="bad decode")],
    "all-damaged": [made.Unloadable()],
    "gap": [made.Dropped(first=10, end=312)],
    "lost": [made.Dropped(first=9, end=309, every=30, burst=29), made.Black(first=9, end=309)],
    "elsewhere": _elsewhere,
    # stamps
    "clock-set-forward": [made.stamps_moved(3600.0, first=12)],
    "clock-set-back": [made.stamps_moved(-3600.0, first=12)],
    "stamp-ahead": [made.stamps_moved(3600.0, first=12, end=13)],
    "stamp-behind": [made.stamps_moved(-0.5, first=12, end=13)],
    "stamps-zero": [made.Restamped(by=lambda *_: 0)],
    "stamps-equal": [made.Restamped(by=lambda _, start_ns: start_ns)],
    "stamps-backwards": [made.Restamped(by=lambda stamp_ns, start_ns: 2 * start_ns - stamp_ns)],
    "stamps-negative": [made.stamps_moved(-1_700_000_010.0)],
    "stamps-in-seconds": [made.Restamped(by=lambda stamp_ns, _: stamp_ns // 10**9)],
    "stamps-in-microseconds": [made.Restamped(by=lambda stamp_ns, _: stamp_ns // 1000)],
    "stamps-jitter": [made.stamps_of_arrival(0.01)],
    "stamps-apart": [made.stamps_of_arrival(0.002, streams=(1,))],
    "clocks-offset": [made.stamps_moved(0.03, streams=(1,))],
    "depth-offset": [made.stamps_moved(0.03, streams=(1,))],
    "clocks-drift": [made.Restamped(by=_gaining, streams=(1,))],
    # light and lens
    "black": [made.Black(first=8, end=11)],
    "all-black": [made.Black()],
    "white": [spoilt(made.white, first=8, end=11)],
    "white-half": [spoilt(made.white, part=0.5, first=8, end=14)],
    "blurred": [spoilt(made.blurred, sigma_px=4.0, first=8, end=11)],
    "noisy": [spoilt(made.noisy, sigma=50.0, first=8, end=11)],
    "exposure-jump": [spoilt(made.exposed, factor=2.0, first=10)],
    "flicker": [spoilt(made.flickering, amplitude=0.2)],
    "covered": [spoilt(made.covered)],
    # transfer
    "half-grey": [spoilt(made.half_written, first=2, every=4)],
    "half-garbage": [spoilt(made.half_written, first=2, every=4, fill="garbage")],
    "rows-shifted": [spoilt(made.rows_shifted, first=8, end=10)],
    "upside-down": [of_all(made.upside_down, first=8, end=9)],
    "all-upside-down": [of_all(made.upside_down)],
    "transposed": [of_all(made.transposed, first=8, end=11)],
    "resized": [of_all(made.halved)],
    "type-float": [of_all(made.of_type, dtype="float64", first=8, end=11, streams=(0,))],
    "type-16-bit": [of_all(made.of_type, dtype="uint16", first=8, end=11)],
    "type-colour": [of_all(made.in_colour, first=8, end=11, streams=(0,))],
    # stereo
    "exchanged": [made.Exchanged()],
    "mirrored": [of_all(made.mirrored)],
    "right-behind": [made.Lagging(streams=(1,)), made.Dropped(end=1)],
    "right-frozen": [made.Frozen(first=10, end=16, streams=(1,))],
    "right-black": [made.Black(first=8, end=11, streams=(1,))],
    "right-darker": [spoilt(made.exposed, factor=0.5, streams=(1,))],
    "right-lower": [of_all(made.shifted, rows=3, streams=(1,))],
    # depth
    "depth-nan": [of_depth(made.constant, first=8, end=11)],
    "depth-negative": [of_depth(made.constant, value=-1.0, first=8, end=11)],
    "depth-all-nan": [of_depth(made.constant)],
    "depth-flat": [of_depth(made.constant, value=2.0)],
    "depth-in-mm": [of_depth(made.scaled, factor=1000.0)],
    "depth-twice": [of_depth(made.scaled, factor=2.0)],
    "depth-coarse": [of_depth(made.quantized, step_m=0.25)],
    "depth-holes": [of_depth(made.holes, part=0.9)],
    "depth-saturated": [of_depth(made.saturated, depth_m=2.0)],
    "depth-noisy": [of_depth(made.rough, sigma_m=0.05)],
    "depth-behind": [made.Lagging(by=2, streams=(1,)), made.Dropped(end=2)],
    "depth-frozen": [made.Frozen(first=10, end=16, streams=(1,))],
    "depth-shifted": [of_all(made.shifted, columns=12, streams=(1,))],
    "depth-16-bit": [of_all(made.of_type, dtype="uint16", streams=(1,))],
    "depth-in-colour": [of_all(made.in_colour, streams=(1,))],
    "depth-resized": [of_all(made.halved, streams=(1,))],
    # calibration
    "baseline-half": [made.wrong_baseline(0.5)],
    "baseline-in-mm": [made.wrong_baseline(1000.0)],
    "baseline-negative": [made.wrong_baseline(-1.0)],
    "baseline-zero": [made.wrong_baseline(0.0)],
    "focal-length-of-one": [made.wrong_focal_length(1.3, streams=(1,))],
    "focal-length": [made.wrong_focal_length(1.3)],
    "principal-point": [made.wrong_principal_point(1.2)],
}


def _read(page: str) -> Iterator[NamedFault]:
    """Yield the rows of the page's tables."""
    listed = page.partition("the run does not tell:")[2].split(".")[0]
    silent = re.findall(r"`([\w-]+)`", listed)
    for section in page.partition("\n## The faults\n")[2].split("\n### ")[1:]:
        group = re.split("[:\n]", section)[0]
        row = r"^\| `([\w-]+)`(?: \((.+?)\))? \|.*\| (\d) \| (?:`(.+)`|no) \|$"
        for name, sensor, exit_code, found_by in re.findall(row, section, re.MULTILINE):
            yield NamedFault(
                name=name,
                group=group,
                sensors=_SENSORS[sensor or None],
                exit_code=int(exit_code),
                found_by=found_by,
                is_silent=name in silent,
            )


FAULTS = {fault.name: fault for fault in _read(PAGE.read_text())}
"""By name, in the order of the page."""


def parameters(*values: Any, fault: NamedFault, id_: str = "") -> Any:
    """Return the parameters of a test that the short run takes for one fault of each group."""
    marks = () if fault.name in _IN_SHORT_RUN else (pytest.mark.acceptance,)
    return pytest.param(*values, id=id_ or fault.name, marks=marks)
