"""Forms in which systems write poses, and which of them a file has.

A header that names the columns decides. Without one it is the form of the one system whose
number of columns, separator, stamps and rotations fit: the order of a quaternion cannot be told
from its numbers.
"""

from __future__ import annotations

import re
from collections.abc import Container, Sequence
from typing import Literal, NamedTuple

import numpy as np

from gvo._text import shortened
from gvo.geometry import se3
from gvo.types import BoolArray, FloatArray

Stamps = Literal["s", "s.", "ms", "us", "ns", "ns.", "index", "none"]
"""Their unit, with a point where a fraction is always written; or an index, a second each."""

UNITS_NS = {"s": 10**9, "s.": 10**9, "ms": 10**6, "us": 10**3, "ns": 1, "ns.": 1, "index": 10**9}
"""Nanoseconds of a unit of the stamps, where there are any."""

_POSITION = ("x", "y", "z")
_QUATERNION = ("qx", "qy", "qz", "qw")
_MATRIX = ("r11", "r12", "r13", "r21", "r22", "r23", "r31", "r32", "r33")
_FAULTS = {
    _QUATERNION: "the quaternion is not of length one",
    _MATRIX: "the first three columns of the pose are no rotation",
    ("roll", "pitch", "yaw"): "roll, pitch and yaw are no angles in radians",
}
# rounding of published files: four decimals in TUM's ground truths, seven digits in KITTI's
_ROUNDING = 1e-2
_LATEST_S = 1e10  # the year 2286; later stamps are in another unit
_HOUR_S = 3600.0
_MIN_STEP_S, _MAX_STEP_S = 1e-3, 10.0
_MAX_INDEX = 1e7
_LARGEST = 1e20  # of a number: any stamp in int64
_MAX_HEADER = 2000  # characters
_REMEDY = "name the columns in a first line like '# stamp [ns] x y z qw qx qy qz'"
_UNKNOWN = f"no form of poses that gvo knows; {_REMEDY}; of a matrix keep three rows, as KITTI does"
_UNNAMED: tuple[Stamps, ...] = ("s", "ns")
_UNIT_NAMES: dict[str, Stamps] = {"": "s", "m": "ms", "u": "us", "n": "ns"}
_OF_POSITION = {"", "t", "p", "pos", "position", "translation", "pose"}
_OF_QUATERNION = {"q", "quat", "quaternion", "orientation", "rot", "rotation"}
_AXIS = re.compile(r"(?P<group>.*?)[._ ]?(?P<axis>[wxyz])")
# of a topic that rostopic printed the stamp in the header, not the time of arrival (%time)
_STAMP = re.compile(r"(?:.*header[._]stamp|u?time_?(?:stamps?)?|stamps?|ts?)(?:_[nmu]?s(?:ec)?)?")
_STAMP_UNIT = re.compile(r"(?:[\[(] *|_|^(?=utime))(?P<prefix>[nmu]?)(?:s(?:ec\w*)?\W*$|time)")
_FRACTION = re.compile(r"\d+\.\d+")
_SCALAR_FIRST = re.compile(r"\bw\W+x\W+y\W+z\b")
_SCALAR_LAST = re.compile(r"\bx\W+y\W+z\W+w\b")


class Form(NamedTuple):
    """What the columns of a file hold.

    They are named `stamp`, `x`, `y`, `z` and `qx` to `qw`, `r11` to `r33`, or `roll`, `pitch`,
    `yaw` with R = Rz(yaw) Ry(pitch) Rx(roll), in a layout separated by blanks; others, and those
    beyond it, are not read. Separators: none but blanks, ",,": a comma at the end of the row, too.
    """

    system: str
    n_columns: Container[int]
    stamps: Stamps
    layout: str
    separators: Container[str] = ("", ",", ", ", ";")

    @property
    def names(self) -> list[str]:
        """Names of the columns from the first on."""
        return self.layout.split()

    @property
    def rotation(self) -> tuple[str, ...]:
        """Names of the columns of the rotation."""
        return next(group for group in _FAULTS if group[0] in self.names)

    @property
    def columns(self) -> list[int]:
        """Columns of the position, then of the rotation."""
        return [self.names.index(name) for name in (*_POSITION, *self.rotation)]

    @property
    def fault(self) -> str:
        """What is wrong with a row whose rotation is none."""
        remedy = "if the columns are others, name them in a first line"
        return f"{_FAULTS[self.rotation]} (read as {self.describe()}; {remedy})"

    def is_rotation(self, rotations: FloatArray) -> BoolArray:
        """Tell which rows, shape (n, k), of its columns are rotations."""
        if self.rotation == _QUATERNION:
            is_rotation = np.abs(np.linalg.norm(rotations, axis=1) - 1.0) <= _ROUNDING
        elif self.rotation == _MATRIX:
            is_rotation = se3.is_rotation(rotations.reshape(-1, 3, 3), tolerance=_ROUNDING)
        else:
            is_rotation = np.all(np.abs(rotations) <= 2.0 * np.pi, axis=1)
        return np.asarray(is_rotation)

    def describe(self) -> str:
        """Return the system with its columns and the unit of its stamps."""
        return f"{self.system} ({self.layout}; stamps: {self.stamps})"


_X_FIRST = "stamp x y z qx qy qz qw"
_W_FIRST = "stamp x y z qw qx qy qz"
_ROWS = "r11 r12 r13 x r21 r22 r23 y r31 r32 r33 z"

TUM = Form("TUM", (8,), "s", _X_FIRST, ("", ",", ", ", ";", ",,"))

FORMS = (
    TUM,
    Form("TUM in nanoseconds", (8,), "ns", _X_FIRST),
    Form("ORB-SLAM3", (8,), "ns.", _X_FIRST, ("",)),
    Form("EuRoC", (8, 17), "ns", _W_FIRST),
    Form("OKVIS", (17,), "ns", _X_FIRST, ("", ", ")),
    Form("VINS", (8, 11), "ns", _W_FIRST, (",,",)),
    Form("OpenVINS", range(17, 10_000), "s.", "stamp qx qy qz qw x y z", ("",)),
    Form("OpenVINS", (20,), "s.", _X_FIRST, ("",)),
    Form("KITTI", (12,), "none", _ROWS),
    Form("KITTI-360", (13, 17), "index", f"stamp {_ROWS}", ("",)),
    Form("KAIST", (13,), "ns", f"stamp {_ROWS}", (",", ", ")),
    Form("NCLT", (7,), "us", "stamp x y z roll pitch yaw", (",", ", ")),
    Form("TartanAir", (7,), "none", "x y z qx qy qz qw"),
)
"""Of files without a header that names their columns."""


class Sample(NamedTuple):
    """The first rows of a file, of as many fields, and the lines above that are no numbers."""

    rows: Sequence[Sequence[str]]
    separator: str
    header: Sequence[str]

    def numbers(self, columns: Sequence[int]) -> FloatArray:
        """Return some columns of the rows in which they are finite numbers, shape (n, k)."""
        numbers = []
        for row in self.rows:
            try:
                numbers.append([float(row[column]) for column in columns])
            except ValueError:  # refused with its line when it is read
                continue
        found = np.array(numbers).reshape(-1, len(columns))
        return found[np.all(np.abs(found) < _LARGEST, axis=1)]

    def describe(self) -> str:
        """Return what was read, for a message."""
        between = {"": "blanks", ";": "semicolons"}.get(self.separator, "commas")
        first = shortened(self.rows[0][0])
        return f"{len(self.rows[0])} columns between {between}, the first of them {first}"


def recognise(sample: Sample) -> Form:
    """Return the form of a file; ValueError, if none fits or more than one does."""
    n_columns = len(sample.rows[0])
    is_scalar_first = None
    for line in (line[:_MAX_HEADER].lower() for line in reversed(sample.header)):
        names, unit = _named(line, n_columns)
        if {*_POSITION, *_QUATERNION} <= {*names[:n_columns]}:
            return _form_of_names(sample, names[:n_columns], unit)
        is_scalar_first = _is_scalar_first(line, names)
        if is_scalar_first is not None:
            break
    forms = [
        form
        for form in FORMS
        if n_columns in form.n_columns
        and sample.separator in form.separators
        and is_scalar_first in (None, _is_scalar_first(form.layout, form.names))
        and _fits(form.stamps, sample, 0)
    ]
    rotated = [form for form in forms if _has_rotations(form, sample)]
    # of the only form that is left the reader says which row is wrong
    if len(rotated or forms) == 1:
        return (rotated or forms)[0]
    fitting = " and ".join(form.describe() for form in rotated)
    reason = f"this fits {fitting}; {_REMEDY}" if rotated else _UNKNOWN
    raise ValueError(f"{sample.describe()}: {reason}")


def _has_rotations(form: Form, sample: Sample) -> bool:
    is_rotation = form.is_rotation(sample.numbers(form.columns[3:]))
    return 2 * int(np.count_nonzero(is_rotation)) >= max(len(is_rotation), 1)


def _fits(stamps: Stamps, sample: Sample, column: int) -> bool:
    """Tell whether the stamps of a column have this form and unit."""
    if stamps == "none":
        return True
    texts = [row[column] for row in sample.rows]
    numbers = sample.numbers([column])
    latest = float(np.max(np.abs(numbers), initial=0.0))
    step = _step(numbers)
    if stamps == "index":
        return latest < _MAX_INDEX and all(map(str.isdigit, texts))
    has_fraction = bool(_FRACTION.fullmatch(texts[0]))
    if (stamps == "ns" and has_fraction) or (stamps.endswith(".") and not has_fraction):
        return False
    if stamps in ("s", "s."):
        # Of slow recordings: nine decimals are nanoseconds written in seconds, six microseconds.
        n_decimals = len(texts[0].partition(".")[2])
        longest = np.inf if n_decimals >= 9 else _HOUR_S if n_decimals >= 6 else _MAX_STEP_S
        return latest < _LATEST_S and not step > longest
    if np.isnan(step):
        return latest > _LATEST_S
    return _MIN_STEP_S <= 1e-9 * UNITS_NS[stamps] * step <= _MAX_STEP_S


def _step(stamps: FloatArray) -> float:
    """Return the median step of stamps, shape (n, 1), in their unit; NaN if there is none."""
    return float(np.median(np.abs(np.diff(stamps[:, 0])))) if len(stamps) > 1 else np.nan


def _form_of_names(sample: Sample, names: Sequence[str], unit: Stamps | None) -> Form:
    """Return the form that a header names; ValueError if its stamps stay unclear."""
    has_stamps = "stamp" in names
    column = names.index("stamp") if has_stamps else 0
    units = [unit] if unit else [each for each in _UNNAMED if _fits(each, sample, column)]
    if not has_stamps:
        units = ["none"] if len(names) == len((*_POSITION, *_QUATERNION)) else []
    if not units:
        missing = "unit of the stamps" if has_stamps else "stamps"
        stamp, step = shortened(sample.rows[0][column]), _step(sample.numbers([column]))
        raise ValueError(
            f"the header names no {missing} (first {stamp}, median step {step:g}); "
            "call the column 'stamp [s]', '[ms]', '[us]' or '[ns]'"
        )
    return Form("the header", (len(names),), units[0], " ".join(names))


def _named(line: str, n_columns: int) -> tuple[list[str], Stamps | None]:
    """Return what a line calls the columns, and the unit of the stamp if it says so."""
    text = re.sub(r"\s+(?=[\[(])", "", line.rpartition(":")[2]).strip()
    separator = next((mark for mark in ";," if mark in text), None)
    words = [word.strip(' "') for word in text.split(separator)]
    names = [_name(re.sub(r"[\[(].*", "", word)) for word in words]
    if "stamp" not in names:
        return ["stamp"] * (len(names) == n_columns - 1) + names, None
    found = _STAMP_UNIT.search(words[names.index("stamp")])
    return names, _UNIT_NAMES[found["prefix"]] if found else None


def _name(word: str) -> str:
    """Return what a column holds by gvo's names; "_" for all else."""
    if _STAMP.fullmatch(word):
        return "stamp"
    axis = _AXIS.fullmatch(word)
    groups = set(re.split("[._ ]", axis["group"])) if axis else set()
    if axis and groups & _OF_QUATERNION:
        return f"q{axis['axis']}"
    return axis["axis"] if axis and groups & _OF_POSITION else "_"


def _is_scalar_first(line: str, names: Sequence[str]) -> bool | None:
    """Tell whether a line names w first; None if it names no order."""
    if "qw" in names and "qx" in names:
        return names.index("qw") < names.index("qx")
    if _SCALAR_FIRST.search(line):
        return True
    return False if _SCALAR_LAST.search(line) else None
