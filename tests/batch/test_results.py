"""The table holds what the rows hold, and the file gives it back."""

from pathlib import Path

import pandas as pd
import pytest

from gvo.batch.results import CSV, to_frame, write_results
from gvo.errors import OutputError
from tests.batch.rows import complete, failed

HOSTILE = ['a,b"c\nd\re', " blank ", "NULL", "ü\u2028🤖", "\x00"]


MEASURED = {
    "tracked": 99,
    "coverage_percent": 100 / 3,
    "ate_smoothed_m": 0.1 + 0.2,
    "rpe_smoothed_deg": 1e-300,
    "run_s": 12.5,
    "gvo_version": "1",
    "configuration_hash": "00ff",
}


def read_csv(path: Path, frame: pd.DataFrame) -> pd.DataFrame:
    kinds = {str(name): kind for name, kind in frame.dtypes.items()}
    return pd.read_csv(path, dtype=kinds, keep_default_na=False, na_values=[""])


def assert_the_file_gives_it_back(frame: pd.DataFrame, folder: Path) -> None:
    write_results(frame, folder)
    # A table of text cannot tell an empty text from none.
    texts = list(frame.select_dtypes(["object", "string"]).columns)
    read = read_csv(folder / CSV, frame)
    filled = dict.fromkeys(texts, "")
    pd.testing.assert_frame_equal(read.fillna(filled), frame.fillna(filled), check_dtype=False)
    assert {path.name for path in folder.iterdir()} == {CSV}


def test_the_file_gives_the_table_back(tmp_path: Path) -> None:
    frame = to_frame(
        [complete(**MEASURED), failed(), complete(**MEASURED | {"is_found": True, "run_s": None})]
    )
    assert_the_file_gives_it_back(frame, tmp_path)
    assert pd.read_csv(tmp_path / CSV)["ate_smoothed_m"].tolist()[0] == 0.1 + 0.2


@pytest.mark.parametrize("name", HOSTILE)
def test_names_and_reasons_are_given_back_whatever_they_hold(tmp_path: Path, name: str) -> None:
    frame = to_frame([failed(recording=name, reason=name, source=name), complete()])
    assert frame["reason"].iloc[0] == name
    assert_the_file_gives_it_back(frame, tmp_path)


def test_what_is_no_character_in_the_name_of_a_file_is_escaped(tmp_path: Path) -> None:
    source = b"/x/\xff.bag".decode(errors="surrogateescape")
    frame = to_frame([failed(source=source, reason=f"{source}: no", parameters={"a.b": source})])
    write_results(frame, tmp_path)
    assert pd.read_csv(tmp_path / CSV)["source"][0] == r"/x/\udcff.bag"


def test_what_cannot_be_written_leaves_what_was_there(tmp_path: Path) -> None:
    write_results(to_frame([complete()]), tmp_path)
    (tmp_path / CSV).unlink()
    (tmp_path / CSV).mkdir()
    with pytest.raises(OutputError, match=r"results\.csv: cannot be written"):
        write_results(to_frame([failed()]), tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {CSV}
