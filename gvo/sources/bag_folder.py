"""The files of a ROS 2 bag folder: split, compressed, missing."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path, PurePath

from gvo.bounded_text import read_text
from gvo.errors import RecordingError
from gvo.sources.salvage.inflate import inflate_file
from gvo.yaml_text import YamlError, load_yaml

STORAGE_SUFFIXES = (".mcap", ".db3")
_COMPRESSED = ".zstd"
_MAX_METADATA = 1 << 20  # bytes; thousands of files


@dataclass(frozen=True, slots=True, kw_only=True)
class FolderFiles:
    """What a folder holds.

    Parameters
    ----------
    paths : tuple of Path
        The files to read; those that end in `.zstd` are compressed.
    notes : tuple of str
        What was decided.
    damage : tuple of str
        What is missing.
    """

    paths: tuple[Path, ...]
    notes: tuple[str, ...] = ()
    damage: tuple[str, ...] = ()


def find_files(folder: Path) -> FolderFiles:
    """Find the files of a bag folder.

    The metadata only name them. All else that they say is in the files too, and not always the
    same: readers that compare the two find no messages then.

    Parameters
    ----------
    folder : Path

    Raises
    ------
    RecordingError
        When there is none.
    """
    held = sorted(path for path in folder.iterdir() if is_storage(path))
    has_metadata = (folder / "metadata.yaml").is_file()
    if not held and not has_metadata:
        raise RecordingError(f"{folder}: holds neither metadata.yaml nor a .mcap or .db3")
    counts = _listed_files(folder / "metadata.yaml") if has_metadata else {}
    listed = {name: _find(name, held) for name in counts}
    found = tuple(path for path in listed.values() if path is not None)
    if not found:
        if not held:
            raise RecordingError(
                f"{folder}: holds no .mcap or .db3, only metadata.yaml; copy it anew"
            )
        state = "names other files" if counts else "is malformed" if has_metadata else "is missing"
        names = ", ".join(path.name for path in held)
        return FolderFiles(
            paths=tuple(held), notes=(f"bag: metadata.yaml {state}: read {names} without it",)
        )
    others = [path.name for path in held if path not in found]
    return FolderFiles(
        paths=found,
        notes=tuple(f"bag: {name} is left out: metadata.yaml does not name it" for name in others),
        damage=tuple(
            f"{folder / name}: is missing{counts[name]}; copy it anew"
            for name, path in listed.items()
            if path is None
        ),
    )


def unpack(path: Path, folder: Path) -> tuple[Path, str]:
    """Decompress a file.

    Parameters
    ----------
    path : Path
        Ends in `.zstd`.
    folder : Path
        Where to.

    Returns
    -------
    path : Path
        The decompressed file.
    damage : str
        What is missing of it; nothing where nothing is.

    Raises
    ------
    RecordingError
        When it cannot be read or the folder cannot be written.
    """
    target = folder / path.name.removesuffix(_COMPRESSED)
    try:
        reason = inflate_file(path, target)
    except OSError as error:
        raise RecordingError(f"{path}: cannot be decompressed to {folder}: {error}") from error
    return target, f"{path}: is cut or damaged ({reason}); copy it anew" if reason else ""


def is_storage(path: Path) -> bool:
    """Tell whether a path is a file of ROS 2, by its name, compressed or not."""
    return path.is_file() and path.name.removesuffix(_COMPRESSED).endswith(STORAGE_SUFFIXES)


def _find(name: str, held: list[Path]) -> Path | None:
    """Return the file of a name, compressed or not."""
    plain = name.removesuffix(_COMPRESSED)
    names = (name, plain, f"{plain}{_COMPRESSED}")
    return next((path for wanted in names for path in held if path.name == wanted), None)


def _listed_files(metadata: Path) -> dict[str, str]:
    """Return the names of the files, and for each what is known of its size, as text."""
    try:
        text = read_text(metadata, max_bytes=_MAX_METADATA)
        content = load_yaml(text, max_characters=_MAX_METADATA)["rosbag2_bagfile_information"]
        names = [PurePath(name).name for name in content["relative_file_paths"]]
        files = {
            PurePath(file["path"]).name: f" ({file['message_count']} messages)"
            for file in content.get("files") or []
        }
    except (YamlError, OSError, ValueError, TypeError, LookupError, AttributeError):
        return {}
    return {name: files.get(name, "") for name in names}
