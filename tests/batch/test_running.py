"""A batch leaves a folder for each run, a table and a page, however it ends."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pandas as pd
import pytest
from distributed import Client

from gvo.batch import BatchOptions, BatchProgress, run
from gvo.errors import OutputError
from tests.batch.conftest import NO_REPORT, state_of
from tests.conftest import assert_same_files

FORCED = BatchOptions(report=False, force=True)


def run_files(out: Path) -> dict[Path, Any]:
    """Return the state of what runs wrote, without the batch's own files."""
    return {path: state for path, state in state_of(out).items() if path.parent != out}


def test_a_batch_writes_runs_a_table_and_a_page(
    near: Client, bags: Path, tmp_path: Path, run_alone: Callable[[Path], Path]
) -> None:
    out = tmp_path / "out"
    asked: list[str | Path] = [bags / "walk1.mcap", bags / "walk0.mcap", "/none.bag"]
    table = run(asked, out=out, client=near, options=NO_REPORT)
    assert table["recording"].tolist() == ["walk1", "walk0", "none"]
    assert table["status"].tolist() == ["complete", "complete", "failed"]
    assert table["folder"].tolist() == ["walk1", "walk0", "none"]
    assert_same_files(out / "walk0", run_alone(bags / "walk0.mcap"))
    assert len(pd.read_csv(out / "results.csv")) == 3
    page = (out / "report.html").read_text(encoding="utf-8")
    assert all(name in page for name in ("walk0", "walk1", "none"))
    expected = {"walk0", "walk1", "batch.json", "report.html", "results.csv"}
    assert {path.name for path in out.iterdir()} == expected


def test_what_is_finished_is_found_the_rest_run(near: Client, bags: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    run(bags / "walk0.mcap", out=out, client=near, options=NO_REPORT)
    before = run_files(out)
    table = run(bags, out=out, client=near, options=NO_REPORT)
    assert table["is_found"].tolist() == [True, False, False]
    assert {path: run_files(out)[path] for path in before} == before
    forced = run(bags, out=out, client=near, options=FORCED)
    assert not forced["is_found"].any()
    assert {path: run_files(out)[path][0] for path in before} != {
        path: state[0] for path, state in before.items()
    }
    columns = ["recording", "status", "ate_smoothed_m", "run_hash", "configuration_hash"]
    pd.testing.assert_frame_equal(forced[columns], table[columns])


class StoppedError(Exception):
    """Ends a batch."""


def test_a_stopped_batch_leaves_a_table(near: Client, bags: Path, tmp_path: Path) -> None:
    def stop(progress: BatchProgress) -> None:
        if progress.n_done == 1:
            raise StoppedError

    with pytest.raises(StoppedError):
        run(bags, out=tmp_path, client=near, options=NO_REPORT, on_progress=stop)
    table = pd.read_csv(tmp_path / "results.csv")
    assert len(table) == 1
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert "2 runs were not made: the batch was stopped" in page
    again = run(bags, out=tmp_path, client=near, options=NO_REPORT)
    assert again["status"].tolist() == ["complete"] * 3
    (first,) = table["recording"]
    assert again.set_index("recording")["is_found"][first]
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert "were not made" not in page


def test_a_table_that_cannot_be_written_ends_the_batch(
    near: Client, bags: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("gvo.batch.running._EVERY_S", 0.0)
    (tmp_path / "results.csv").mkdir()
    with pytest.raises(OutputError, match=r"results\.csv: cannot be written") as error:
        run(bags, out=tmp_path, client=near, options=NO_REPORT)
    # Though the error, and with it all that it went through, is still held.
    assert near.futures == {}
    assert error is not None
