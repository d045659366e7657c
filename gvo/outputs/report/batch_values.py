"""The rows of a batch as the report needs them: arrays, order, words."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from gvo.config import Config
from gvo.outputs.batch_rows import BatchRow, Value
from gvo.parameter_effects import Runs, VariantMean, accuracy_front
from gvo.types import BoolArray, FloatArray
from gvo.viz.plots import plain

DEFAULT = "default"
N_LABEL = 40
"""Letters of a name in a picture."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Batch:
    """The rows, and what is computed of them once.

    Parameters
    ----------
    rows : tuple of BatchRow, length n
    runs : Runs
    errors_m, times_ms, coverages_percent : ndarray of float64, shape (n,)
        Smoothed ATE, time of a frame, coverage; NaN where there is none.
    means : tuple of VariantMean
        The configurations, the best first.
    default : str or None
        Name of the configuration whose swept parameters have their defaults.
    labels : dict of str to str
        Short names of the configurations.
    label_words : str
        What the short names mean; empty where that is plain.
    """

    rows: tuple[BatchRow, ...]
    runs: Runs
    errors_m: FloatArray
    times_ms: FloatArray
    coverages_percent: FloatArray
    means: tuple[VariantMean, ...]
    default: str | None
    labels: Mapping[str, str]
    label_words: str

    @classmethod
    def of(cls, rows: Sequence[BatchRow]) -> Batch:
        """Take the numbers out of the rows."""
        errors_m = _numbers([row.ate_smoothed_m for row in rows])
        times_ms = _numbers([row.frame_ms for row in rows])
        coverages = _numbers([row.coverage_percent for row in rows])
        frames = _numbers([None if row.frames is None else float(row.frames) for row in rows])
        runs = Runs(
            recordings=[row.recording for row in rows],
            variants=[row.variant for row in rows],
            parameters=_parameters(rows),
            is_failed=np.array([row.status == "failed" for row in rows], dtype=np.bool_),
            n_poses=frames * coverages / 100.0,
        )
        means = accuracy_front(runs, errors_m, times_ms)
        labels, label_words = _labels(rows)
        return cls(
            rows=tuple(rows),
            runs=runs,
            errors_m=errors_m,
            times_ms=times_ms,
            coverages_percent=coverages,
            means=_ranked(means, rows),
            default=_default_of(rows),
            labels=labels,
            label_words=label_words,
        )

    @property
    def is_sweep(self) -> bool:
        """Whether there is more than one configuration."""
        return len(self.means) > 1

    @property
    def has_errors(self) -> bool:
        """Whether any run has a true trajectory beside it."""
        return bool(np.any(self.runs.has(self.errors_m)))

    @property
    def has_times(self) -> bool:
        """Whether any comparable run tells how long a frame took."""
        return bool(np.any(self.runs.has(self.times_ms)))

    def is_of(self, variant: str) -> BoolArray:
        """Tell which rows are of a configuration, shape (n,)."""
        return np.array([row.variant == variant for row in self.rows], dtype=np.bool_)

    def over_best(self) -> FloatArray:
        """Return each error over the least comparable one of its recording, shape (n,)."""
        return self.errors_m / self._by_recording(np.fmin.reduce)

    def over_mean(self) -> FloatArray:
        """Return each error over the geometric mean of its recording, shape (n,)."""
        return self.errors_m / self._by_recording(lambda errors: np.exp(np.mean(np.log(errors))))

    def _by_recording(self, summary: object) -> FloatArray:
        codes, is_used = self.runs.recording_codes(), self.runs.has(self.errors_m)
        found = np.full(len(codes), np.nan)
        for code in np.unique(codes[is_used]):
            found[code] = summary(self.errors_m[is_used & (codes == code)])  # type: ignore[operator]
        return found[codes]


def _numbers(values: Sequence[float | None]) -> FloatArray:
    return np.array([np.nan if value is None else value for value in values], dtype=np.float64)


def _parameters(rows: Sequence[BatchRow]) -> dict[str, list[Value]]:
    names = dict.fromkeys(name for row in rows for name in row.parameters)
    return {name: [row.parameters.get(name) for row in rows] for name in names}


def _ranked(means: Sequence[VariantMean], rows: Sequence[BatchRow]) -> tuple[VariantMean, ...]:
    """Return those that completed most first, of these the most accurate; else by coverage."""

    def rank(mean: VariantMean) -> tuple[float, ...]:
        own = [row for row in rows if row.variant == mean.name]
        coverage = sum(row.coverage_percent or 0.0 for row in own) / len(own)
        ratio = math.inf if mean.error_ratio is None else mean.error_ratio
        return -mean.n_compared, ratio, -coverage, sum(row.frame_ms or 0.0 for row in own)

    return tuple(sorted(means, key=rank))


def _labels(rows: Sequence[BatchRow]) -> tuple[dict[str, str], str]:
    """Return names of the configurations without sections, or but values where they are long."""
    own = {row.variant: row.parameters for row in rows}
    parameters = dict.fromkeys(name for row in rows for name in row.parameters)
    keys = {name: name.rpartition(".")[2] for name in parameters}
    if len(set(keys.values())) < len(keys):
        keys = {name: name for name in parameters}
    labels = {}
    for variant in own:
        labels[variant] = printable(variant)
        for name, key in keys.items():
            labels[variant] = labels[variant].replace(f"{name}=", f"{key}=")
    if max(map(len, labels.values())) <= N_LABEL:
        return labels, ""
    short = {
        variant: " / ".join(map(value_text, values.values())) for variant, values in own.items()
    }
    if len(set(short.values())) < len(short) or max(map(len, short.values())) > N_LABEL:
        return _without_same_ends(labels), ""
    return short, f" Names are the values of {printable(' / '.join(keys.values()))}."


def _without_same_ends(labels: Mapping[str, str]) -> dict[str, str]:
    """Return what tells names apart, where cutting their middles would make equal ones."""
    texts = [*labels.values()]
    if len({shown(text, N_LABEL) for text in texts}) == len(texts):
        return dict(labels)
    n_start = _n_shared(texts)
    n_end = _n_shared([text[n_start:][::-1] for text in texts])
    return {
        variant: f"...{text[n_start : len(text) - n_end]}{'...' if n_end else ''}"
        for variant, text in labels.items()
    }


def _n_shared(texts: Sequence[str]) -> int:
    """Return how many letters all texts begin with."""
    columns = zip(*texts, strict=False)
    differs = (number for number, letters in enumerate(columns) if len(set(letters)) > 1)
    return next(differs, min(map(len, texts)))


def _default_of(rows: Sequence[BatchRow]) -> str | None:
    # lists come as text
    defaults = {
        f"{section}.{key}": json.dumps(value) if isinstance(value, (list, dict)) else value
        for section, values in Config().model_dump(mode="json").items()
        for key, value in values.items()
    }
    names = {row.variant for row in rows}
    if DEFAULT in names:
        return DEFAULT
    for row in rows:
        known = [
            name in defaults and defaults[name] == row.parameters[name] for name in row.parameters
        ]
        if known and all(known):
            return row.variant
    return None


def printable(text: str) -> str:
    """Return a text without what cannot be printed, or would turn the rest around.

    Examples
    --------
    >>> printable("a" + chr(0) + "b" + chr(10) + "c")
    'a?b c'
    """
    words = " ".join(text.split())
    return "".join(letter if letter.isprintable() else "?" for letter in words)


def shown(text: str, n_most: int) -> str:
    """Return a name as a label of a picture, its middle left out where it is long.

    Examples
    --------
    >>> shown("window.n_links=3", 11)
    'wind...ks=3'
    """
    text = printable(text)
    if len(text) > n_most:
        n_end = (n_most - 3) // 2
        text = f"{text[: n_most - 3 - n_end]}...{text[-n_end:]}"
    return plain(text)


def value_text(value: object) -> str:
    """Return a value as YAML has it."""
    if value is None:
        return "null"
    if isinstance(value, bool):
        return str(value).lower()
    return f"{value:g}" if isinstance(value, float) else printable(str(value))


def number_text(value: float | None, form: str = ".4g") -> str:
    """Return a number, a dash where there is none."""
    return "-" if value is None or math.isnan(value) else f"{value:{form}}"
