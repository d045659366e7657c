"""On a cluster of processes any of them may die: nothing is lost, nothing is done twice."""

import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest
from distributed import Client

from gvo.batch import BatchProgress, run
from tests.batch.conftest import NO_REPORT, Cluster, is_complete, is_under_way, wait_until
from tests.conftest import GVO, Command, assert_same_files


def batch(*arguments: object) -> subprocess.Popen[str]:
    command = [*GVO, "batch", *map(str, arguments), "--no-report"]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


@pytest.mark.acceptance
def test_a_worker_that_is_killed_in_the_middle_costs_nothing(
    cluster: Cluster, bags: Path, long_bag: Path, tmp_path: Path, run_alone: Callable[[Path], Path]
) -> None:
    killed: list[str] = []

    def kill(progress: BatchProgress) -> None:
        if not killed:
            wait_until(lambda: is_under_way(tmp_path / "long"), "the middle of a recording")
            name = cluster.worker_at(0)
            cluster.kill_worker(name)
            killed.append(name)
            assert not is_complete(tmp_path / "long")

    with Client(cluster.address) as client:
        asked = [long_bag, bags]
        table = run(asked, out=tmp_path, client=client, options=NO_REPORT, on_progress=kill)
    assert len(killed) == 1
    assert table["status"].tolist() == ["complete"] * 4
    for bag in (long_bag, bags / "walk0.mcap"):
        assert_same_files(tmp_path / bag.stem, run_alone(bag))


@pytest.mark.acceptance
def test_a_scheduler_that_is_lost_is_a_line_and_the_batch_goes_on_with_another(
    tmp_path: Path, long_bag: Path, bags: Path, near: Client, command: Command
) -> None:
    folder = tmp_path / "other"
    folder.mkdir()
    out, asked = tmp_path / "out", [bags / "walk0.mcap", long_bag]
    other = Cluster(folder)
    try:
        worker = other.add_worker()
        with batch(*asked, "--out", out, "--scheduler", other.address) as process:
            wait_until(lambda: is_under_way(out / "long"), "the middle of the batch")
            with other.frozen(worker):  # or it ends the recording
                other.scheduler.kill()
                said = process.communicate(timeout=120)[1]
                other.kill_worker(worker)
    finally:
        other.close()
    assert process.returncode == 2, said
    assert said.splitlines()[-1].startswith("gvo: error: ")
    assert "the scheduler is gone" in said.splitlines()[-1]
    assert "Traceback" not in said
    address = near.scheduler_info(n_workers=0)["address"]
    options = ["--out", out, "--scheduler", address, "--no-report"]
    answer = command("batch", *asked, *options)
    assert answer.code == 0, answer.err
    assert answer.err.count("complete, found") == 1
