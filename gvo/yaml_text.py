"""YAML of configurations, calibrations and metadata, read within bounds.

A few lines of YAML can stand for gigabytes: aliases of aliases, merged keys, numbers of a million
digits. What is read here is bounded before any value is made of it.
"""

from __future__ import annotations

from typing import Any, cast

import yaml

MAX_CHARACTERS = 1 << 18
"""Of a text; a configuration with all its comments has a thirtieth."""

MAX_VALUES = 100_000
"""Values, keys and lists, each counted as often as aliases repeat it."""

_MAX_NUMBER = 250  # characters; in any notation a float can hold it
_NUMBERS = ("tag:yaml.org,2002:int", "tag:yaml.org,2002:float")

# Dates that are none, numbers too long and tags that do not fit their values come as these.
_VALUE_FAULTS = (
    ArithmeticError,
    AttributeError,
    LookupError,
    RecursionError,
    TypeError,
    ValueError,
)


class YamlError(Exception):
    """A text that is no YAML, or more than is read; its one line says where or why."""


def load_yaml(
    text: str,
    loader_class: type[yaml.SafeLoader] = yaml.SafeLoader,
    *,
    max_characters: int = MAX_CHARACTERS,
) -> Any:  # noqa: ANN401 - YAML
    """Return what a YAML text holds.

    Parameters
    ----------
    text : str
        Of several documents the first that holds anything counts.
    loader_class : type
        Which tags are known.
    max_characters : int
        Of the text; a number has at most 250.

    Returns
    -------
    object
        Dictionaries, lists, numbers, texts; None where there is nothing.

    Raises
    ------
    YamlError
        When it is no YAML, longer than `max_characters`, or more than `MAX_VALUES` once its
        aliases are followed.
    """
    if len(text) > max_characters:
        raise YamlError(f"{len(text)} characters, expected at most {max_characters}")
    try:
        loader = loader_class(text)
        try:
            return _first_document(loader)
        finally:
            loader.dispose()
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        raise YamlError(f"line {mark.line + 1}" if mark else _first_line(error)) from error
    except _VALUE_FAULTS as error:
        raise YamlError(_first_line(error)) from error


def _first_document(loader: yaml.SafeLoader) -> Any:  # noqa: ANN401 - YAML
    while loader.check_node():
        node = cast(yaml.Node, loader.get_node())  # there is one, as was asked
        _count_values(node, {})
        document = loader.construct_document(node)
        if document is not None:
            return document
    return None


def _count_values(node: yaml.Node, counted: dict[int, int | None]) -> int:
    """Return how many values a node stands for; by their ids those that were counted."""
    key = id(node)
    if key in counted:
        known = counted[key]
        if known is None:
            raise YamlError(f"line {node.start_mark.line + 1}: a value holds itself")
        return known
    counted[key] = None
    n_values = 1 + sum(_count_values(child, counted) for child in _children(node))
    if n_values > MAX_VALUES:
        raise YamlError(f"more than {MAX_VALUES} values")
    counted[key] = n_values
    return n_values


def _children(node: yaml.Node) -> list[yaml.Node]:
    if isinstance(node, yaml.MappingNode):
        return [part for pair in node.value for part in pair]
    if isinstance(node, yaml.SequenceNode):
        return list(node.value)
    if node.tag in _NUMBERS and len(node.value) > _MAX_NUMBER:
        raise YamlError(f"line {node.start_mark.line + 1}: a number of {len(node.value)} digits")
    return []


def _first_line(error: Exception) -> str:
    lines = str(error).splitlines()
    return f"{lines[0][:200] if lines else type(error).__name__}"
