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
from gvo.testing.faults import Fault, FaultySource, PixelFault
from tests import faults as made

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
    other = FaultySource(source, made.Turned(how="mirrored"), *exchange)
    return [made.Elsewhere(other=other, first=10), made.StampShift(first=10, by_s=10.0)]


MADE: dict[str, list[Fault] | Callable[[Source], list[Fault]]] = {
    # delivery
    "dropped-one": [made.Dropped(first=10, end=11)],
    "dropped-some": [made.Dropped(first=1, share=0.3, seed=1)],
    "dropped-every-other": [made.Dropped(first=1, every=2)],
    "dropped-bursts": [made.Dropped(first=4, every=8, burst=4)],
    "dropped-left": [made.Dropped(first=8, end=12, streams=(0,))],
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
    "image-too-large": [made.Unloadable(first=8, end=10, error=MemoryError, message="no room")],
    "decoder-fails": [made.Unloadable(first=8, end=10, error=cv2.error, message="bad decode")],
    "all-damaged": [made.Unloadable()],
    "gap": [made.Dropped(first=10, end=312)],
    "lost": [made.Dropped(first=9, end=309, every=30, burst=29), made.Black(first=9, end=309)],
    "elsewhere": _elsewhere,
    # stamps
    "clock-set-forward": [made.StampShift(first=12, by_s=3600.0)],
    "clock-set-back": [made.StampShift(first=12, by_s=-3600.0)],
    "clock-stepped-back": [made.StampShift(first=12, by_s=-0.1)],
    "stamp-ahead": [made.StampShift(first=12, end=13, by_s=3600.0)],
    "stamp-behind": [made.StampShift(first=12, end=13, by_s=-0.5)],
    "stamp-zero": [made.StampConstant(first=12, end=13)],
    "stamps-zero": [made.StampConstant()],
    "stamps-equal": [made.StampConstant(stamp_ns=None)],
    "stamps-backwards": [made.StampBackwards()],
    "stamps-from-zero": [made.StampFromZero()],
    "stamps-negative": [made.StampShift(by_s=-1_700_000_010.0)],
    "stamps-in-seconds": [made.StampUnit()],
    "stamps-in-microseconds": [made.StampUnit(unit_ns=1000)],
    "stamps-jitter": [made.StampJitter(sigma_s=0.01)],
    "stamps-apart": [made.StampJitter(sigma_s=0.002, is_shared=False)],
    "clocks-offset": [made.StampShift(by_s=0.03, streams=(1,))],
    "depth-offset": [made.StampShift(by_s=0.03, streams=(1,))],
    "clocks-drift": [made.StampRate(rate=1.02, streams=(1,))],
    # light and lens
    "black": [made.Black(first=8, end=11)],
    "all-black": [made.Black()],
    "white": [made.White(first=8, end=11)],
    "white-half": [made.White(part=0.5, first=8, end=14)],
    "blurred": [made.Blurred(sigma_px=4.0, first=8, end=11)],
    "motion-blurred": [made.MotionBlurred(first=8, end=11)],
    "noisy": [made.Noisy(sigma=50.0, first=8, end=11)],
    "salt-and-pepper": [made.SaltAndPepper(density=0.15, first=8, end=11)],
    "exposure-jump": [made.Exposed(factor=2.0, first=10)],
    "flicker": [made.Flickering(amplitude=0.2)],
    "bands": [made.Banded(amplitude=0.1)],
    "covered": [made.Covered()],
    # transfer
    "half-grey": [made.HalfWritten(first=2, every=4)],
    "half-garbage": [made.HalfWritten(first=2, every=4, fill="garbage")],
    "half-former": [made.HalfWritten(first=2, every=4, fill="former")],
    "rows-shifted": [made.RowsShifted(first=8, end=10)],
    "upside-down": [made.Turned(first=8, end=9)],
    "half-turn": [made.Turned(how="half turn", first=8, end=9)],
    "all-upside-down": [made.Turned()],
    "transposed": [made.Turned(how="transposed", first=8, end=11)],
    "resized": [made.Resized()],
    "type-float": [made.OfType(first=8, end=11, streams=(0,))],
    "type-16-bit": [made.OfType(pixel_type="uint16", first=8, end=11)],
    "type-flat": [made.OfType(pixel_type="flat", first=8, end=11)],
    "type-colour": [made.OfType(pixel_type="colour", first=8, end=11, streams=(0,))],
    # stereo
    "exchanged": [made.Exchanged()],
    "mirrored": [made.Turned(how="mirrored")],
    "right-behind": [made.Lagging(streams=(1,)), made.Dropped(end=1)],
    "right-frozen": [made.Frozen(first=10, end=16, streams=(1,))],
    "right-black": [made.Black(first=8, end=11, streams=(1,))],
    "right-darker": [made.Exposed(factor=0.5, streams=(1,))],
    "right-lower": [made.Shifted(rows=3, streams=(1,))],
    # depth
    "depth-nan": [made.DepthConstant(first=8, end=11)],
    "depth-zero": [made.DepthConstant(depth_m=0.0, first=8, end=11)],
    "depth-infinite": [made.DepthConstant(depth_m=float("inf"), first=8, end=11)],
    "depth-negative": [made.DepthConstant(depth_m=-1.0, first=8, end=11)],
    "depth-all-nan": [made.DepthConstant()],
    "depth-flat": [made.DepthConstant(depth_m=2.0)],
    "depth-in-mm": [made.DepthScaled(factor=1000.0)],
    "depth-in-km": [made.DepthScaled(factor=0.001)],
    "depth-twice": [made.DepthScaled(factor=2.0)],
    "depth-coarse": [made.DepthQuantized()],
    "depth-holes": [made.DepthHoles()],
    "depth-saturated": [made.DepthSaturated()],
    "depth-noisy": [made.DepthNoisy()],
    "depth-behind": [made.Lagging(by=2, streams=(1,)), made.Dropped(end=2)],
    "depth-frozen": [made.Frozen(first=10, end=16, streams=(1,))],
    "depth-shifted": [made.Shifted(columns=12, streams=(1,))],
    "depth-16-bit": [made.OfType(pixel_type="uint16", streams=(1,))],
    "depth-in-colour": [made.OfType(pixel_type="colour", streams=(1,))],
    "depth-resized": [made.Resized(streams=(1,))],
    # calibration
    "baseline-half": [made.WrongBaseline(factor=0.5)],
    "baseline-twice": [made.WrongBaseline(factor=2.0)],
    "baseline-in-mm": [made.WrongBaseline(factor=1000.0)],
    "baseline-negative": [made.WrongBaseline(factor=-1.0)],
    "baseline-zero": [made.WrongBaseline(factor=0.0)],
    "focal-length-of-one": [made.WrongFocalLength(factor=1.3, streams=(1,))],
    "focal-length": [made.WrongFocalLength(factor=1.3)],
    "principal-point": [made.WrongPrincipalPoint()],
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
