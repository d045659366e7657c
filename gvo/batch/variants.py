"""The configurations of a batch: given ones, and the grid of a sweep."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path

from gvo._text import YamlError, cut, load_yaml
from gvo.batch.recordings import free_name, safe_name
from gvo.batch.rows import Value
from gvo.config import Config, RuntimeConfig, load_configuration
from gvo.errors import ConfigurationError

DEFAULT = "default"
_MAX_SHOWN = 100
_MAX_VARIANTS = 100_000


@dataclass(frozen=True, slots=True, kw_only=True)
class Variant:
    """A configuration and its name in the batch.

    Parameters
    ----------
    name : str
        Unlike those of all others, fit for a folder.
    config : Config
    """

    name: str
    config: Config


def make_variants(
    files: Sequence[Path] = (), settings: Sequence[str] = (), sweeps: Sequence[str] = ()
) -> list[Variant]:
    """Return each combination of a configuration file and one value of each sweep.

    Parameters
    ----------
    files : sequence of Path
        YAML files; the defaults where there is none.
    settings : sequence of str
        `section.key=value`, for all of them.
    sweeps : sequence of str
        `section.key=a,b,c`, the values in YAML.

    Raises
    ------
    ConfigurationError
        Where one of them cannot be read, or is out of range.
    """
    grid = [_parse_sweep(sweep) for sweep in sweeps]
    keys = [sweep.partition("=")[0].strip() for sweep in sweeps]
    if len(set(keys)) < len(keys):
        raise ConfigurationError(f"--sweep {max(keys, key=keys.count)}: is given twice")
    if math.prod(map(len, grid)) * max(len(files), 1) > _MAX_VARIANTS:
        raise ConfigurationError(f"the sweep has more than {_MAX_VARIANTS} configurations")
    bases: list[tuple[str, Path | None]] = [(name, file) for file, name in _names(files).items()]
    variants: dict[str, Config] = {}
    for (base, file), chosen in product(bases or [("", None)], product(*grid)):
        values = [f"{key}={json.dumps(value)}" for key, value in zip(keys, chosen, strict=True)]
        words = ",".join(filter(None, [base, _text_of(dict(zip(keys, chosen, strict=True)))]))
        name = safe_name(words or DEFAULT)
        config = load_configuration(file, [*settings, *values])
        variants[free_name(name, variants)] = _on_one_thread(config)
    return [Variant(name=name, config=config) for name, config in variants.items()]


def name_variants(
    configs: Config | Sequence[Config] | Mapping[str, Config] | None,
) -> list[Variant]:
    """Return configurations with names: their own, or the values in which they differ.

    Raises
    ------
    ConfigurationError
        Where there is none.
    """
    if configs is None:
        return make_variants()
    if isinstance(configs, Config):
        return [Variant(name=DEFAULT, config=configs)]
    if isinstance(configs, Mapping):
        named = [(safe_name(name), config) for name, config in configs.items()]
    else:
        texts = [_text_of(values) for values in differences(configs)]
        named = [
            (safe_name(text) if text else DEFAULT, one)
            for text, one in zip(texts, configs, strict=True)
        ]
    if not named:
        raise ConfigurationError("expected at least one configuration")
    variants: dict[str, Config] = {}
    for name, config in named:
        variants[free_name(name, variants)] = config
    return [Variant(name=name, config=config) for name, config in variants.items()]


def differences(configs: Sequence[Config]) -> list[dict[str, Value]]:
    """Return, for each configuration, the values of the keys in which any two of them differ."""
    flat = [dict(_flatten(config)) for config in configs]
    keys = [
        key for key in (flat[0] if flat else {}) if any(one[key] != flat[0][key] for one in flat)
    ]
    return [{key: one[key] for key in keys} for one in flat]


def _flatten(config: Config) -> Iterator[tuple[str, Value]]:
    for section, values in config.model_dump(mode="json").items():
        for key, value in values.items():
            is_plain = value is None or isinstance(value, bool | int | float | str)
            yield f"{section}.{key}", value if is_plain else json.dumps(value)


def _text_of(values: Mapping[str, Value]) -> str:
    return ",".join(
        f"{key}={value if isinstance(value, str) else json.dumps(value)}"
        for key, value in values.items()
    )


def _parse_sweep(sweep: str) -> list[Value]:
    """Return the values of a sweep."""
    key, separator, text = sweep.partition("=")
    shown = f"--sweep {cut(sweep, _MAX_SHOWN)}"
    if not separator or not text.strip() or "." not in key:
        raise ConfigurationError(
            f"{shown}: expected section.key=a,b,c, for example window.n_links=1,3"
        )
    try:
        # As the value of a key: what follows a bracket too many would be left out silently.
        values = load_yaml(f"values: [{text}]")["values"]
    except YamlError as error:
        raise ConfigurationError(f"{shown}: the values are no YAML ({error})") from error
    if not isinstance(values, list):
        raise ConfigurationError(f"{shown}: expected values with commas between them")
    try:
        texts = [json.dumps(value) for value in values]
    except TypeError as error:  # dates, sets and bytes, which YAML has too
        raise ConfigurationError(f"{shown}: no parameter has such a value ({error})") from error
    if len(set(texts)) < len(texts):
        raise ConfigurationError(f"{shown}: {max(texts, key=texts.count)} is given twice")
    return values


def _names(files: Sequence[Path]) -> dict[Path, str]:
    names: dict[str, Path] = {}
    for file in dict.fromkeys(files):
        names[free_name(safe_name(file.stem), names)] = file
    return {file: name for name, file in names.items()}


def _on_one_thread(config: Config) -> Config:
    """Read ahead on no thread of its own, unless asked: each core has a run."""
    if "runtime" in config.model_fields_set and "threads" in config.runtime.model_fields_set:
        return config
    runtime = RuntimeConfig.model_validate({**config.runtime.model_dump(), "threads": 1})
    return config.model_copy(update={"runtime": runtime})
