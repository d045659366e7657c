"""YAML of calibrations, that of OpenCV's `FileStorage` included."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

from gvo.errors import CalibrationError

_OPENCV_HEADER = "%YAML:"
_OPENCV_MATRIX = "tag:yaml.org,2002:opencv-matrix"

# Dates that are none, numbers too long and tags that do not fit their values come as these.
_VALUE_FAULTS = (
    ArithmeticError,
    AttributeError,
    LookupError,
    RecursionError,
    TypeError,
    ValueError,
)


class _Loader(yaml.SafeLoader):
    """Reads the matrices of OpenCV as the keys that they consist of."""


def _keys_of_matrix(loader: _Loader, node: yaml.MappingNode) -> dict[Any, Any]:
    return loader.construct_mapping(node, deep=True)


_Loader.add_constructor(_OPENCV_MATRIX, _keys_of_matrix)


def read_yaml(path: Path) -> dict[Any, Any]:
    """Read a YAML file of keys.

    Parameters
    ----------
    path : Path
        Text.

    Returns
    -------
    dict
        Values by key.

    Raises
    ------
    CalibrationError
        When it is missing, malformed or holds no keys.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        raise CalibrationError(
            f"{path}: the calibration cannot be read: {error.strerror}"
        ) from error
    except UnicodeDecodeError as error:
        raise CalibrationError(f"{path}: the calibration is no text") from error
    if text.startswith(_OPENCV_HEADER):
        text = text.partition("\n")[2]  # with its colon it is no directive of YAML
    try:
        # Of several documents, as `ros2 topic echo` prints them, the first counts.
        documents = yaml.load_all(text, Loader=_Loader)
        content = next((document for document in documents if document is not None), None)
    except (yaml.YAMLError, *_VALUE_FAULTS) as error:
        raise CalibrationError(f"{path}: the calibration is no YAML") from error
    if not isinstance(content, dict):
        raise CalibrationError(f"{path}: the calibration holds no keys")
    return content
