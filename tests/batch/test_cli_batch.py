"""`gvo batch`: what it takes, what it says, how it ends."""

import os
import signal
import subprocess
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import pandas as pd
import pytest
from distributed import Client

import gvo
from gvo.io.run_folder.reader import read_run
from tests.batch.conftest import is_complete, is_under_way, state_of, wait_until
from tests.conftest import (
    GVO,
    Answer,
    Command,
    is_one_line,
    python,
    refused,
    run_of,
)

Batch = Callable[..., Answer]


@pytest.fixture
def batch(near: Client, command: Command) -> Batch:
    """Return a function that runs `gvo batch` on the workers of this process."""
    address = near.scheduler_info(n_workers=0)["address"]

    def run(*arguments: object) -> Answer:
        return command("batch", *arguments, "--scheduler", address, "--no-report")

    return run


def test_all_complete_is_0(batch: Batch, bags: Path, tmp_path: Path) -> None:
    answer = batch(bags, "--out", tmp_path)
    assert answer.code == 0
    lines = answer.out.splitlines()
    assert lines == ["3 recordings, 1 configuration", f"3 runs: 3 complete; {tmp_path}/report.html"]
    said = sorted(line.partition("] ")[2] for line in answer.err.splitlines())
    assert said == [f"walk{n}: complete" for n in range(3)]
    assert [line.partition("]")[0] for line in answer.err.splitlines()] == ["[1/3", "[2/3", "[3/3"]


def test_some_failed_is_3_and_each_is_named(batch: Batch, bags: Path, tmp_path: Path) -> None:
    (tmp_path / "broken.bag").write_text("no bag")
    answer = batch(bags / "walk0.mcap", tmp_path / "broken.bag", "--out", tmp_path / "out")
    assert answer.code == 3
    assert f"gvo: warning: broken: failed: {tmp_path}/broken.bag" in answer.err
    assert "2 runs: 1 complete, 1 failed" in answer.out
    table = pd.read_csv(tmp_path / "out" / "results.csv")
    assert table["status"].tolist() == ["complete", "failed"]


def test_all_failed_is_2(batch: Batch, tmp_path: Path) -> None:
    answer = batch("/none/a.bag", "/none/b.bag", "--out", tmp_path)
    assert answer.code == 2
    assert answer.err.splitlines()[-1] == "gvo: error: all runs failed"
    assert "2 runs: 2 failed" in answer.out
    assert len(pd.read_csv(tmp_path / "results.csv")) == 2


def test_configurations_and_sweeps_are_all_pairs(batch: Batch, bags: Path, here: Path) -> None:
    for name, size in (("a", 3), ("b", 4)):
        (here / f"{name}.yaml").write_text(f"window: {{size: {size}}}\n")
    # As the shell expands a pattern without quotes.
    options = ["--sweep", "window.n_links=1,2", "--no-loops", "--every", "2"]
    answer = batch(bags / "walk0.mcap", "--out", "out", "--configs", "a.yaml", "b.yaml", *options)
    assert answer.code == 0, answer.err
    table = pd.read_csv("out/results.csv")
    values = list(zip(table["window.size"], table["window.n_links"], strict=True))
    assert values == [(3, 1), (3, 2), (4, 1), (4, 2)]
    assert table["variant"][0] == "a,window.n_links=1"
    summary = read_run(here / "out" / "walk0" / "b,window.n_links=2").summary
    assert not summary["configuration"]["loops"]["enabled"]
    assert summary["frames"] == 4


def test_a_folder_that_holds_a_run_is_refused(batch: Batch, bags: Path, tmp_path: Path) -> None:
    run_of(bags / "walk0.mcap", tmp_path / "walk0")
    before = state_of(tmp_path)
    words = ["--out", tmp_path, "--set", "window.size=3"]
    assert "holds an earlier result (summary.json)" in refused(batch(bags / "walk0.mcap", *words))
    assert state_of(tmp_path) == before
    assert batch(bags / "walk0.mcap", *words, "--force").code == 0
    # Now it is the batch's.
    assert batch(bags / "walk0.mcap", *words).code == 0


def test_a_batch_does_not_take_runs_out_of_a_table(
    batch: Batch, bags: Path, tmp_path: Path
) -> None:
    (tmp_path / "broken.bag").write_text("no bag")
    out = tmp_path / "out"
    words = ["--out", out, "--duration", "0.2"]
    assert batch(*(bags / f"walk{n}.mcap" for n in (0, 1)), tmp_path / "broken.bag", *words).code
    said = refused(batch(bags / "walk1.mcap", bags / "walk2.mcap", *words))
    assert f"{out}: holds another batch, of which walk0 would leave the table; give" in said
    # One that failed leaves nothing but its row.
    assert batch(bags, *words).code == 0
    assert batch(bags / "walk2.mcap", *words, "--force").code == 0
    assert batch(bags / "walk2.mcap", *words).code == 0


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--sweep", "window.sise=3,4"], "did you mean window.size"),
        (["--set", "window.size=1"], "greater than or equal to 2"),
        (["--configs", "none.yaml"], "none.yaml: No such file"),
        (["--workers", "2", "--scheduler", "tcp://127.0.0.1:1"], "--scheduler names a cluster"),
    ],
)
def test_misuse_is_a_line_before_anything_begins(
    command: Command,
    tmp_path: Path,
    bags: Path,
    monkeypatch: pytest.MonkeyPatch,
    arguments: list[str],
    said: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    answer = command("batch", bags, "--out", tmp_path / "out", *arguments)
    assert answer.code == 2
    assert said in answer.err
    assert is_one_line(answer.err)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("address", ["tcp://127.0.0.1:1", "tls://127.0.0.1:1", "127.0.0.1:x"])
def test_no_scheduler_is_a_line(
    bags: Path, tmp_path: Path, command: Command, monkeypatch: pytest.MonkeyPatch, address: str
) -> None:
    monkeypatch.setattr("gvo.batch.engine._CONNECT_S", "1s")
    said = refused(command("batch", bags, "--out", tmp_path / "out", "--scheduler", address))
    assert f"{address}: no scheduler of Dask answers" in said


def test_without_a_package_it_says_how_to_get_it(bags: Path, tmp_path: Path) -> None:
    program = f"import sys; sys.modules['dask'] = None\n{GVO[-1]}"
    said = refused(python("-c", program, "batch", bags, "--out", tmp_path / "out"))
    assert "batches need dask; install it by: " in said
    assert "[batch]'" in said
    assert not (tmp_path / "out").exists()


@pytest.mark.acceptance
def test_stopped_on_this_machine_it_leaves_no_process_and_goes_on(
    bags: Path, long_bag: Path, tmp_path: Path, batch: Batch
) -> None:
    """As a terminal does it, or the end of a session: the signal goes to all processes."""
    out = tmp_path / "out"
    command = [*GVO, "batch", bags / "walk0.mcap", long_bag, "--out", out, "--workers", "2"]
    process = subprocess.Popen(
        [*map(str, command), "--no-report"],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    group = process.pid
    try:
        wait_until(lambda: is_complete(out / "walk0") and is_under_way(out / "long"), "the middle")
        os.killpg(group, signal.SIGTERM)
        assert process.stderr is not None
        said = process.stderr.read()
        process.wait(timeout=60)
        wait_until(lambda: not is_alive(group), "the end of the workers")
    finally:
        if is_alive(group):
            os.killpg(group, signal.SIGKILL)
        process.wait()
        if process.stderr is not None:
            process.stderr.close()
    assert process.returncode == 143
    *rows, last = said.splitlines()
    # The first may have ended before its row was written.
    assert all(row.startswith("[1/2] walk0: complete") for row in rows), said
    assert last == f"gvo: interrupted; the poses so far are in {out}: the same command goes on"
    names = ("raw", "causal", "smoothed")
    assert len({len(gvo.read_trajectory(out / f"long/{name}.txt")) for name in names}) == 1
    assert not (out / "long" / "run.lock").exists()
    before = state_of(out / "walk0")
    answer = batch(bags / "walk0.mcap", long_bag, "--out", out)
    assert answer.code == 0, answer.err
    assert "walk0: complete, found" in answer.err
    assert state_of(out / "walk0") == before


def is_alive(group: int) -> bool:
    try:
        os.killpg(group, 0)
    except ProcessLookupError:
        return False
    return True


def test_on_a_terminal_there_is_one_line(
    batch: Batch, bags: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shown: list[str] = []

    class Status:
        def __init__(self, text: str, **_: object) -> None:
            shown.append(text)

        def __enter__(self) -> SimpleNamespace:
            return SimpleNamespace(update=shown.append)

        def __exit__(self, *_: object) -> None: ...

    monkeypatch.setattr("rich.status.Status", Status)
    monkeypatch.setattr("sys.stderr.isatty", lambda: True)
    answer = batch(bags / "walk0.mcap", "--out", tmp_path)
    assert answer.code == 0
    assert answer.err == ""
    assert shown[0] == "batch"
    assert shown[-1] == "batch: 1 of 1 runs, 0 failed, on 1 workers, 0:00:00 left"
