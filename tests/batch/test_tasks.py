"""A task is a run like that of `gvo run`, unless its folder holds it already."""

import json
import shutil
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

import gvo
from gvo.batch.tasks import MARK, BatchOptions, BatchRow, Task, TaskOptions, run_task
from gvo.io.excerpt import Excerpt
from gvo.io.run_folder.writer import written_alone
from gvo.types import Progress
from tests.batch.conftest import N_FRAMES, NO_REPORT, copy_of
from tests.conftest import assert_same_files

CONFIG = gvo.load_configuration(settings=["runtime.threads=1"])


def task_of(source: object, config: gvo.Config = CONFIG, **values: Any) -> Task:
    given = {"recording": "a", "variant": "default", "folder": "a"} | values
    return Task(source=str(source), config=config, **given)


@pytest.fixture
def options(tmp_path: Path) -> TaskOptions:
    out = tmp_path / "out"
    out.mkdir()
    (out / MARK).write_text('{"mark": "x"}')
    return TaskOptions(out=out, mark="x", batch=NO_REPORT)


@pytest.fixture
def bag(bags: Path, tmp_path: Path) -> Path:
    return copy_of(bags / "walk0.mcap", tmp_path / "in", "walk.mcap")


def test_a_task_writes_what_a_run_writes(
    bag: Path, options: TaskOptions, run_alone: Callable[[Path], Path]
) -> None:
    seen: list[int] = []
    row = run_task(task_of(bag), options, on_progress=lambda progress: seen.append(progress.n_done))
    out, alone = options.out / "a", run_alone(bag)
    assert_same_files(out, alone)
    assert {path.name for path in out.iterdir()} == {path.name for path in alone.iterdir()}
    assert seen == list(range(1, N_FRAMES + 1))
    summary = json.loads((alone / "summary.json").read_text())
    errors = {each["name"]: each for each in summary["errors"]}
    assert row.status == "complete"
    assert (row.frames, row.tracked) == (N_FRAMES, summary["tracked"])
    assert row.ate_raw_m == errors["raw"]["ate_m"]
    assert row.ate_smoothed_m == errors["smoothed"]["ate_m"]
    assert row.rpe_smoothed_deg == errors["smoothed"]["rpe_deg"]
    assert row.run_s is not None
    assert (row.gvo_version, row.is_found) == (gvo.__version__, False)


@pytest.mark.parametrize("change", ["configuration", "recording", "excerpt"])
def test_another_run_in_the_folder_is_replaced(
    bag: Path, bags: Path, options: TaskOptions, tmp_path: Path, change: str
) -> None:
    run_task(task_of(bag), options)
    fresh = replace(options, out=shutil.copytree(options.out, tmp_path / "fresh"))
    shutil.rmtree(tmp_path / "fresh" / "a")
    task = task_of(bag)
    if change == "configuration":
        task = task_of(bag, gvo.load_configuration(settings=["window.size=3", "runtime.threads=1"]))
    elif change == "recording":
        copy_of(bags / "walk1.mcap", bag.parent, bag.name)
    else:
        part = BatchOptions(report=False, excerpt=Excerpt(every=2))
        options, fresh = (replace(each, batch=part) for each in (options, fresh))
    row = run_task(task, options)
    assert (row.status, row.is_found) == ("complete", False)
    run_task(task, fresh)
    assert_same_files(options.out / "a", tmp_path / "fresh" / "a")


def test_a_recording_that_fails_is_a_row_and_reason(options: TaskOptions, tmp_path: Path) -> None:
    (tmp_path / "text.bag").write_text("no bag")
    for source, said in ((tmp_path / "none.bag", "does not exist"), (tmp_path / "text.bag", "")):
        row = run_task(task_of(source, parameters={"a.b": 1}), options)
        assert (row.status, row.frames, row.run_s) == ("failed", None, None)
        assert row.reason.startswith(f"{source}")
        assert said in row.reason
        assert (row.recording, row.folder, row.source) == ("a", "a", str(source))
        assert row.parameters == {"a.b": 1}


@pytest.mark.parametrize("content", [None, '{"mark": "y"}', "[]"])
def test_a_disk_of_others_is_refused(bag: Path, options: TaskOptions, content: str | None) -> None:
    mark = options.out / MARK
    mark.unlink()
    if content is not None:
        mark.write_text(content, encoding="latin-1")
    row = run_task(task_of(bag), options)
    assert row.status == "failed"
    assert "does not see the client's folder" in row.reason
    assert not (options.out / "a").exists()


def test_another_version_is_refused(bag: Path, options: TaskOptions) -> None:
    row = run_task(task_of(bag), replace(options, gvo_version="0.0.1"))
    assert row.status == "failed"
    assert row.reason == (f"the worker has gvo {gvo.__version__}, the client 0.0.1: install one")
    assert not (options.out / "a").exists()


def test_a_folder_that_another_process_writes_is_waited_for(
    bag: Path, options: TaskOptions, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = options.out / "a"
    other = ExitStack()
    other.enter_context(written_alone(out))
    waited: list[float] = []

    def wait(seconds: float) -> None:
        waited.append(seconds)
        if len(waited) == 3:
            other.close()

    monkeypatch.setattr("gvo.batch.tasks.time.sleep", wait)
    row = run_task(task_of(bag), options)
    assert (row.status, len(waited)) == ("complete", 3)


def test_a_folder_that_stays_busy_is_a_failure_and_the_other_run_goes_on(
    bag: Path, options: TaskOptions, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("gvo.batch.tasks._BUSY_S", 0.0)
    rows: list[BatchRow] = []

    def start_another(progress: Progress) -> None:
        if progress.n_done == 3:
            rows.append(run_task(task_of(bag), options))

    row = run_task(task_of(bag), options, on_progress=start_another)
    assert "another process is writing this run" in rows[0].reason
    assert (rows[0].status, row.status) == ("failed", "complete")
