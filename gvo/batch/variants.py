"""The configurations of a batch: given, or the grid of a sweep."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping, Sequence
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
        Unique, and valid as the name of a folder.
    config : Config
    """

    name: str
    config: Config


def make_variants(
    files: Sequence[Path] = (), settings: Sequence[str] = (), sweeps: Sequence[str] = ()
) -> list[Variant]:
    """Return the product of configuration files and swept values.

    Parameters
    ----------
    files : sequence of Path
        YAML files; the defaults without one.
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
    bases: list[tuple[str, Path | None]] = [(name, file) for file, name in _names(files).items()]
    named = []
    for (base, file), chosen in product(bases or [("", None)], product(*grid)):
        swept = dict(zip(keys, chosen, strict=True))
        values = [f"{key}={json.dumps(value)}" for key, value in swept.items()]
        config = _on_one_thread(load_configuration(file, [*settings, *values]))
        named.append((",".join(filter(None, [base, _text_of(swept)])), config))
    return _variants(named)


def name_variants(
    configs: Config | Sequence[Config] | Mapping[str, Config] | None,
) -> list[Variant]:
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
    texts = map(_text_of, differences(configs))
    return _variants(zip(texts, configs, strict=True))


def _variants(named: Iterable[tuple[str, Config]]) -> list[Variant]:
    """Make the names unique, and valid as names of folders."""
    variants: dict[str, Config] = {}
    for name, config in named:
        variants[free_name(safe_name(name or DEFAULT), variants)] = config
    return [Variant(name=name, config=config) for name, config in variants.items()]


def differences(configs: Sequence[Config]) -> list[dict[str, Value]]:
    """Return the values of each configuration that are not the same in all."""
    flat = [flatten(config) for config in configs]
    keys = [
        key for key in (flat[0] if flat else {}) if any(one[key] != flat[0][key] for one in flat)
    ]
    return [{key: one[key] for key in keys} for one in flat]


def flatten(config: Config) -> dict[str, Value]:
    """Return a configuration by `section.key`, lists and mappings as JSON texts."""
    return {
        f"{section}.{key}": json.dumps(value) if isinstance(value, list | dict) else value
        for section, values in config.model_dump(mode="json").items()
        for key, value in values.items()
    }


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


def _names(files: Sequence[Path]) -> dict[Path, str]:
    names: dict[str, Path] = {}
    for file in dict.fromkeys(files):
        names[free_name(safe_name(file.stem), names)] = file
    return {file: name for name, file in names.items()}


def _on_one_thread(config: Config) -> Config:
    """Do not read ahead on a second thread unless asked to: each core has a run."""
    if "runtime" in config.model_fields_set and "threads" in config.runtime.model_fields_set:
        return config
    runtime = RuntimeConfig.model_validate({**config.runtime.model_dump(), "threads": 1})
    return config.model_copy(update={"runtime": runtime})
