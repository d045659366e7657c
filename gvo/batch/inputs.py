"""Which recordings a batch runs, and with which configurations."""

from __future__ import annotations

import json
import math
import os
import re
from collections import Counter
from collections.abc import Container, Iterable, Iterator, Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import TypeVar

from gvo._text import YamlError, cut, load_yaml, text_lines
from gvo.batch.results import CSV
from gvo.batch.tasks import MARK, Value
from gvo.config import Config, RuntimeConfig, load_configuration, values_by_name
from gvo.errors import ConfigurationError, RecordingError
from gvo.io.opening import BAG_SUFFIXES, FOLDER_MARKERS
from gvo.io.run_folder.writer import REPORT

T = TypeVar("T")
_UNSAFE = re.compile(r"[^A-Za-z0-9._=,+-]+")
_MAX_NAME = 150
# Depth of the search: a link to a parent folder must end somewhere.
_MAX_DEPTH = 12
_COMPRESSED = ".zstd"
_COMMENT = re.compile(r"(^|\s)#.*")
# The batch's own files, also while they are written.
_TAKEN = {f"{name}{end}" for name in (CSV, REPORT, MARK) for end in ("", ".new")}
DEFAULT = "default"
_MAX_SHOWN = 100
_MAX_LISTED = 1_000_000  # lines of a list of recordings
_MAX_VARIANTS = 100_000


def find_recordings(asked: Sequence[str | Path]) -> dict[str, str]:
    """Find recordings, each once, in the order asked for.

    Parameters
    ----------
    asked : sequence of str or Path
        Each a path of a recording, a folder, which is searched unless it is a recording itself, or
        a `.txt` file with one of these a line, relative to its folder, with comments after `#`. A
        path that does not exist is taken for a recording that only the workers see.

    Returns
    -------
    dict of str to str
        Absolute paths by names that are unique, and valid as names of folders.

    Raises
    ------
    RecordingError
        If one of them leads to no recording.
    ValueError
        If nothing is asked for.
    """
    if not asked:
        raise ValueError("expected at least one recording")
    locations: dict[str, None] = {}
    for one in asked:
        found: dict[str, None] = {}
        for where, path in _places(Path(one).expanduser()):
            # Links are not resolved: on a worker they may lead elsewhere.
            here = dict.fromkeys(map(str, _search_below(Path(os.path.abspath(path)))))  # noqa: PTH100
            if not here:
                raise RecordingError(f"{where}: no recording there")
            found |= here
        if not found:
            raise RecordingError(f"{one}: no recording there")
        locations |= found
    return _name(list(locations))


def _places(path: Path) -> Iterator[tuple[str, Path]]:
    """Yield a path, or those in a list, each with where it was asked for."""
    if path.suffix != ".txt" or not path.is_file():
        yield str(path), path
        return
    for number, line in text_lines(path, RecordingError, max_lines=_MAX_LISTED):
        if entry := _COMMENT.sub("", line).strip():
            yield f"{path}, line {number}: {entry}", path.parent / entry


def _search_below(place: Path, depth: int = 0) -> Iterator[Path]:
    """Yield a place that is a recording, else the recordings in the folder."""
    if not place.is_dir():
        yield place
        return
    entries = sorted(place.iterdir())
    if any(entry.name in FOLDER_MARKERS for entry in entries):
        yield place
        return
    for entry in entries:
        is_open = depth < _MAX_DEPTH and not entry.name.startswith(".")
        if is_open and (_is_bag(entry.name) or entry.is_dir()):
            yield from _search_below(entry, depth + 1)


def _is_bag(name: str) -> bool:
    return name.removesuffix(_COMPRESSED).endswith(BAG_SUFFIXES)


def _name(locations: Sequence[str]) -> dict[str, str]:
    """Name each by its stem; where that repeats, by its path below the folder of all."""
    stems = Counter(map(_stem, locations))
    folder = os.path.commonpath([Path(each).parent for each in locations])
    names = []
    for each in locations:
        is_unique = stems[_stem(each)] == 1
        below = "-".join(Path(each).relative_to(folder).parts)
        names.append((_stem(each) if is_unique else below, each))
    return _numbered(names, _TAKEN)


def _stem(location: str) -> str:
    plain = Path(location).name.removesuffix(_COMPRESSED)
    return plain.rpartition(".")[0] if plain.endswith(BAG_SUFFIXES) else plain


def _numbered(named: Iterable[tuple[str, T]], taken: Container[str] = ()) -> dict[str, T]:
    """Return values by their names, made valid as names of folders, and unique by numbers."""
    found: dict[str, T] = {}
    for name, value in named:
        safe = _UNSAFE.sub("_", name).lstrip(".")[:_MAX_NAME] or "_"
        free, number = safe, 2
        while free in found or free in taken:
            free, number = f"{safe}-{number}", number + 1
        found[free] = value
    return found


def make_variants(
    files: Sequence[Path] = (), settings: Sequence[str] = (), sweeps: Sequence[str] = ()
) -> dict[str, Config]:
    """Return each configuration file with each combination of swept values, by its name.

    Parameters
    ----------
    files : sequence of Path
        YAML files; without one, the defaults.
    settings : sequence of str
        `section.key=value`, for all configurations.
    sweeps : sequence of str
        `section.key=a,b,c`, the values in YAML.

    Raises
    ------
    ConfigurationError
        If one cannot be read, or a value is out of range.
    """
    grid = [_parse_sweep(sweep) for sweep in sweeps]
    keys = [sweep.partition("=")[0].strip() for sweep in sweeps]
    if len(set(keys)) < len(keys):
        raise ConfigurationError(f"--sweep {max(keys, key=keys.count)}: is given twice")
    if math.prod(map(len, grid)) * max(len(files), 1) > _MAX_VARIANTS:
        raise ConfigurationError(f"the sweep has more than {_MAX_VARIANTS} configurations")
    bases = _numbered((file.stem, file) for file in dict.fromkeys(files)).items()
    named = []
    for (base, file), chosen in product(bases or [("", None)], product(*grid)):
        swept = dict(zip(keys, chosen, strict=True))
        values = [f"{key}={json.dumps(value)}" for key, value in swept.items()]
        config = _on_one_thread(load_configuration(file, [*settings, *values]))
        named.append((",".join(filter(None, [base, _text_of(swept)])), config))
    return _variants(named)


def name_variants(
    configs: Config | Sequence[Config] | Mapping[str, Config] | None,
) -> dict[str, Config]:
    """Name configurations by their keys, or by the values in which they differ.

    Raises
    ------
    ConfigurationError
        If there is none.
    """
    if configs is None:
        return make_variants()
    if isinstance(configs, Config):
        configs = [configs]
    if not configs:
        raise ConfigurationError("expected at least one configuration")
    if isinstance(configs, Mapping):
        return _variants(configs.items())
    return _variants(zip(map(_text_of, differences(configs)), configs, strict=True))


def _variants(named: Iterable[tuple[str, Config]]) -> dict[str, Config]:
    """Make the names unique, and valid as names of folders."""
    return _numbered((name or DEFAULT, config) for name, config in named)


def differences(configs: Sequence[Config]) -> list[dict[str, Value]]:
    """Return the values of each configuration that are not the same in all."""
    flat = [values_by_name(config) for config in configs]
    keys = [
        key for key in (flat[0] if flat else {}) if any(one[key] != flat[0][key] for one in flat)
    ]
    return [{key: one[key] for key in keys} for one in flat]


def _text_of(values: Mapping[str, Value]) -> str:
    return ",".join(
        f"{key}={value if isinstance(value, str) else json.dumps(value)}"
        for key, value in values.items()
    )


def _parse_sweep(sweep: str) -> list[Value]:
    key, separator, text = sweep.partition("=")
    shown = f"--sweep {cut(sweep, _MAX_SHOWN)}"
    if not separator or not text.strip() or "." not in key:
        raise ConfigurationError(
            f"{shown}: expected section.key=a,b,c, for example window.n_links=1,3"
        )
    try:
        # As the value of a key: YAML would ignore what follows a closing bracket.
        values = load_yaml(f"values: [{text}]")["values"]
    except YamlError as error:
        raise ConfigurationError(f"{shown}: the values are no YAML ({error})") from error
    if not isinstance(values, list):
        raise ConfigurationError(f"{shown}: expected values with commas between them")
    try:
        texts = [json.dumps(value) for value in values]
    except TypeError as error:  # YAML has dates, sets and bytes too
        raise ConfigurationError(f"{shown}: no parameter has such a value ({error})") from error
    if len(set(texts)) < len(texts):
        raise ConfigurationError(f"{shown}: {max(texts, key=texts.count)} is given twice")
    return values


def _on_one_thread(config: Config) -> Config:
    """Set one thread unless another number is asked for: each core has a run of its own."""
    if "runtime" in config.model_fields_set and "threads" in config.runtime.model_fields_set:
        return config
    runtime = RuntimeConfig.model_validate({**config.runtime.model_dump(), "threads": 1})
    return config.model_copy(update={"runtime": runtime})
