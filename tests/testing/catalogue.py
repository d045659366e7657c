"""The faults of docs/reliability.md: how they are made, and what the page says of them."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import pytest

from gvo.io.recording import Sensor, Source
from gvo.testing.faults import (
    Banded,
    Black,
    Blurred,
    BrokenOff,
    Covered,
    DepthConstant,
    DepthHoles,
    DepthNoisy,
    DepthQuantized,
    DepthSaturated,
    DepthScaled,
    Dropped,
    Elsewhere,
    Exchanged,
    Exposed,
    Fault,
    FaultySource,
    Flickering,
    Frozen,
    HalfWritten,
    Lagging,
    Late,
    MotionBlurred,
    Noisy,
    OfType,
    PixelFault,
    Repeated,
    Resized,
    RowsShifted,
    SaltAndPepper,
    Shifted,
    Shuffled,
    StampBackwards,
    StampConstant,
    StampFromZero,
    StampJitter,
    StampRate,
    StampShift,
    StampUnit,
    Turned,
    Unloadable,
    White,
    WrongBaseline,
    WrongFocalLength,
    WrongPrincipalPoint,
)

PAGE = Path(__file__).parents[2] / "docs/reliability.md"
_SENSORS: dict[str | None, tuple[Sensor, ...]] = {
    None: ("stereo", "rgbd"),
    "stereo": ("stereo",),
    "RGB-D": ("rgbd",),
}
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
        made = faults(source) if callable(faults) else faults
        return FaultySource(source, *map(_lasting, made) if is_lasting else made)


def _lasting(fault: Fault) -> Fault:
    return replace(fault, first=0, end=None) if isinstance(fault, PixelFault) else fault


def _elsewhere(source: Source) -> list[Fault]:
    """Show the mirrored world, 10 s later: as strange a place as any."""
    exchange = [Exchanged()] if source.info.sensor == "stereo" else []
    other = FaultySource(source, Turned(how="mirrored"), *exchange)
    return [Elsewhere(other=other, first=10), StampShift(first=10, by_s=10.0)]


MADE: dict[str, list[Fault] | Callable[[Source], list[Fault]]] = {
    # delivery
    "dropped-one": [Dropped(first=10, end=11)],
    "dropped-some": [Dropped(first=1, share=0.3, seed=1)],
    "dropped-every-other": [Dropped(first=1, every=2)],
    "dropped-bursts": [Dropped(first=4, every=8, burst=4)],
    "dropped-left": [Dropped(first=8, end=12, streams=(0,))],
    "dropped-right": [Dropped(first=8, end=12, streams=(1,))],
    "dropped-depth": [Dropped(first=8, end=12, streams=(1,))],
    "no-right": [Dropped(streams=(1,))],
    "no-depth": [Dropped(streams=(1,))],
    "no-colour": [Dropped(streams=(0,))],
    "empty": [Dropped()],
    "one-frame": [Dropped(first=1)],
    "delivered-twice": [Repeated(first=6, end=9)],
    "frozen": [Frozen(first=10, end=16)],
    "late-frame": [Late(first=8, end=9, by=3)],
    "late-right": [Late(by=3, streams=(1,))],
    "shuffled": [Shuffled(within=3)],
    "cut-off": [BrokenOff(first=12)],
    "disk-fails": [BrokenOff(first=12, error=OSError, message="Input/output error")],
    "image-damaged": [Unloadable(first=8, end=10)],
    "image-unreadable": [Unloadable(first=8, end=10, error=OSError, message="Input/output error")],
    "image-too-large": [Unloadable(first=8, end=10, error=MemoryError, message="cannot allocate")],
    "decoder-fails": [Unloadable(first=8, end=10, error=cv2.error, message="bad decode")],
    "all-damaged": [Unloadable()],
    "gap": [Dropped(first=10, end=312)],
    "lost": [Dropped(first=9, end=309, every=30, burst=29), Black(first=9, end=309)],
    "elsewhere": _elsewhere,
    # stamps
    "clock-set-forward": [StampShift(first=12, by_s=3600.0)],
    "clock-set-back": [StampShift(first=12, by_s=-3600.0)],
    "clock-stepped-back": [StampShift(first=12, by_s=-0.1)],
    "stamp-ahead": [StampShift(first=12, end=13, by_s=3600.0)],
    "stamp-behind": [StampShift(first=12, end=13, by_s=-0.5)],
    "stamp-zero": [StampConstant(first=12, end=13)],
    "stamps-zero": [StampConstant()],
    "stamps-equal": [StampConstant(stamp_ns=None)],
    "stamps-backwards": [StampBackwards()],
    "stamps-from-zero": [StampFromZero()],
    "stamps-negative": [StampShift(by_s=-1_700_000_010.0)],
    "stamps-in-seconds": [StampUnit()],
    "stamps-in-microseconds": [StampUnit(unit_ns=1000)],
    "stamps-jitter": [StampJitter(sigma_s=0.01)],
    "stamps-apart": [StampJitter(sigma_s=0.002, is_shared=False)],
    "clocks-offset": [StampShift(by_s=0.03, streams=(1,))],
    "depth-offset": [StampShift(by_s=0.03, streams=(1,))],
    "clocks-drift": [StampRate(rate=1.02, streams=(1,))],
    # light and lens
    "black": [Black(first=8, end=11)],
    "all-black": [Black()],
    "white": [White(first=8, end=11)],
    "white-half": [White(part=0.5, first=8, end=14)],
    "blurred": [Blurred(sigma_px=4.0, first=8, end=11)],
    "motion-blurred": [MotionBlurred(first=8, end=11)],
    "noisy": [Noisy(sigma=50.0, first=8, end=11)],
    "salt-and-pepper": [SaltAndPepper(density=0.15, first=8, end=11)],
    "exposure-jump": [Exposed(factor=2.0, first=10)],
    "flicker": [Flickering(amplitude=0.2)],
    "bands": [Banded(amplitude=0.1)],
    "covered": [Covered()],
    # transfer
    "half-grey": [HalfWritten(first=2, every=4)],
    "half-garbage": [HalfWritten(first=2, every=4, fill="garbage")],
    "half-former": [HalfWritten(first=2, every=4, fill="former")],
    "rows-shifted": [RowsShifted(first=8, end=10)],
    "upside-down": [Turned(first=8, end=9)],
    "half-turn": [Turned(how="half turn", first=8, end=9)],
    "all-upside-down": [Turned()],
    "transposed": [Turned(how="transposed", first=8, end=11)],
    "resized": [Resized()],
    "type-float": [OfType(first=8, end=11, streams=(0,))],
    "type-16-bit": [OfType(pixel_type="uint16", first=8, end=11)],
    "type-flat": [OfType(pixel_type="flat", first=8, end=11)],
    "type-colour": [OfType(pixel_type="colour", first=8, end=11, streams=(0,))],
    # stereo
    "exchanged": [Exchanged()],
    "mirrored": [Turned(how="mirrored")],
    "right-behind": [Lagging(streams=(1,)), Dropped(end=1)],
    "right-frozen": [Frozen(first=10, end=16, streams=(1,))],
    "right-black": [Black(first=8, end=11, streams=(1,))],
    "right-darker": [Exposed(factor=0.5, streams=(1,))],
    "right-lower": [Shifted(rows=3, streams=(1,))],
    # depth
    "depth-nan": [DepthConstant(first=8, end=11)],
    "depth-zero": [DepthConstant(depth_m=0.0, first=8, end=11)],
    "depth-infinite": [DepthConstant(depth_m=float("inf"), first=8, end=11)],
    "depth-negative": [DepthConstant(depth_m=-1.0, first=8, end=11)],
    "depth-all-nan": [DepthConstant()],
    "depth-flat": [DepthConstant(depth_m=2.0)],
    "depth-in-mm": [DepthScaled(factor=1000.0)],
    "depth-in-km": [DepthScaled(factor=0.001)],
    "depth-twice": [DepthScaled(factor=2.0)],
    "depth-coarse": [DepthQuantized()],
    "depth-holes": [DepthHoles()],
    "depth-saturated": [DepthSaturated()],
    "depth-noisy": [DepthNoisy()],
    "depth-behind": [Lagging(by=2, streams=(1,)), Dropped(end=2)],
    "depth-frozen": [Frozen(first=10, end=16, streams=(1,))],
    "depth-shifted": [Shifted(columns=12, streams=(1,))],
    "depth-16-bit": [OfType(pixel_type="uint16", streams=(1,))],
    "depth-in-colour": [OfType(pixel_type="colour", streams=(1,))],
    "depth-resized": [Resized(streams=(1,))],
    # calibration
    "baseline-half": [WrongBaseline(factor=0.5)],
    "baseline-twice": [WrongBaseline(factor=2.0)],
    "baseline-in-mm": [WrongBaseline(factor=1000.0)],
    "baseline-negative": [WrongBaseline(factor=-1.0)],
    "baseline-zero": [WrongBaseline(factor=0.0)],
    "focal-length-of-one": [WrongFocalLength(factor=1.3, streams=(1,))],
    "focal-length": [WrongFocalLength(factor=1.3)],
    "principal-point": [WrongPrincipalPoint()],
}


def _read(page: str) -> Iterator[NamedFault]:
    """Yield the rows of the page's tables."""
    listed = page.partition("the run does not tell:")[2].split(".")[0]
    silent = re.findall(r"`([\w-]+)`", listed)
    for section in page.split("\n### ")[1:]:
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
