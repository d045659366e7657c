"""The samples of an IMU in the ASL layout: `imu0/data.csv`."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from itertools import dropwhile, islice
from pathlib import Path

import numpy as np

from gvo._text import cut, text_lines
from gvo.errors import RecordingError
from gvo.geometry.imu import ImuSamples

_HEADER = (
    "#timestamp [ns],w_RS_S_x [rad s^-1],w_RS_S_y [rad s^-1],w_RS_S_z [rad s^-1],"
    "a_RS_S_x [m s^-2],a_RS_S_y [m s^-2],a_RS_S_z [m s^-2]\n"
)
_ROW = np.dtype([("stamp_ns", np.int64), ("values", np.float64, 6)])
_N_AT_ONCE = 500
_MAX_SHOWN = 200  # characters


def read_imu_table(path: Path, start_ns: int) -> Iterator[ImuSamples]:
    """Yield the samples of a table from a stamp on, in its order, some at a time.

    Raises
    ------
    RecordingError
        Where a row is none, with its number.
    """
    lines = text_lines(path, RecordingError)
    filled = (each for each in lines if each[1].strip() and not each[1].startswith("#"))
    rows = dropwhile(lambda row: _is_before(row[1], start_ns), filled)
    while block := list(islice(rows, _N_AT_ONCE)):
        try:
            table = _parsed([line for _, line in block])
        except ValueError:
            raise RecordingError(f"{path}, {_first_fault(block)}") from None
        values = table["values"]
        yield ImuSamples(
            stamps_ns=table["stamp_ns"], gyro=values[:, :3], acceleration=values[:, 3:]
        )


def write_imu_table(path: Path, parts: Iterable[ImuSamples]) -> None:
    """Write samples without loss."""
    with path.open("w", encoding="utf-8", newline="\n") as file:
        file.write(_HEADER)
        for part in parts:
            values = np.hstack([part.gyro, part.acceleration]).tolist()
            for stamp_ns, row in zip(part.stamps_ns.tolist(), values, strict=True):
                file.write(f"{stamp_ns},{','.join(map(repr, row))}\n")


def _is_before(line: str, stamp_ns: int) -> bool:
    stamp = line.partition(",")[0].strip()
    return stamp.isdecimal() and int(stamp) < stamp_ns


def _parsed(lines: list[str]) -> np.ndarray[tuple[int], np.dtype[np.void]]:
    return np.loadtxt(lines, dtype=_ROW, delimiter=",", ndmin=1)


def _first_fault(block: list[tuple[int, str]]) -> str:
    """Say which is the first row that is none."""
    for number, line in block:
        try:
            _parsed([line])
        except ValueError:
            return (
                f"line {number}: expected a stamp in nanoseconds, three numbers of the gyro in "
                "rad/s and three of the acceleration in m/s^2, got "
                f"{cut(line.strip(), _MAX_SHOWN)}; mend it, or give --imu none"
            )
    return "a row is of another form"
