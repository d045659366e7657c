"""YAML of calibrations, that of OpenCV's `FileStorage` included."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

from gvo.bounded_text import read_text
from gvo.errors import CalibrationError
from gvo.yaml_text import MAX_CHARACTERS, YamlError, load_yaml

_OPENCV_HEADER = "%YAML:"
_OPENCV_MATRIX = "tag:yaml.org,2002:opencv-matrix"


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
        text = read_text(path, max_bytes=MAX_CHARACTERS)
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
        content = load_yaml(text, _Loader)
    except YamlError as error:
        raise CalibrationError(f"{path}: the calibration is no YAML ({error})") from error
    if not isinstance(content, dict):
        raise CalibrationError(f"{path}: the calibration holds no keys")
    return content
