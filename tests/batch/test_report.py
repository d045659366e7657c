"""The report of a batch: what it counts, draws and links, whatever the names hold."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gvo.batch.report import write_batch_report
from gvo.batch.results import to_frame
from gvo.batch.tasks import BatchRow, Value
from tests.batch.rows import complete, failed
from tests.viz.report_page import Page


def made_up(values: Sequence[Value], n_recordings: int) -> list[BatchRow]:
    """Return complete runs whose error doubles and whose time halves from value to value."""
    rng = np.random.default_rng(5)
    rows = []
    for number in range(n_recordings):
        for place, value in enumerate(values):
            variant = f"window.n_links={value}" if len(values) > 1 else "default"
            error_m = 10.0 ** (number - 1) * 2.0**place * np.exp(0.1 * rng.normal())
            rows.append(
                complete(
                    recording=f"drive {number}",
                    variant=variant,
                    folder=f"drive_{number}/{variant}",
                    parameters={"window.n_links": value} if len(values) > 1 else {},
                    frames=1000,
                    ate_raw_m=3.0 * error_m,
                    ate_smoothed_m=error_m,
                    frame_ms=20.0 / 2.0**place,
                    run_s=20.0,
                    gvo_version="1.2.3",
                )
            )
    return rows


def page_of(folder: Path, rows: Sequence[BatchRow], **options: Any) -> Page:
    write_batch_report(folder, to_frame(rows), **options)
    return Page((folder / "report.html").read_text(encoding="utf-8"))


def test_a_sweep_has_its_totals_boxes_medians_and_runs(tmp_path: Path) -> None:
    rows = made_up([1, 3, 5], 4)
    rows[4] = failed(rows[4], "no frame is usable")
    rows[8] = replace(rows[8], status="partly", reason="2 frames are faulty", is_found=True)
    page = page_of(tmp_path, rows, note="Made up.")
    assert [name for name in page.ids if name in ("boxes", "configurations", "runs")] == [
        *("boxes", "configurations", "runs")
    ]
    assert page.drawn == ["boxes"]
    facts = page.facts()
    assert facts["Recordings"] == "4"
    assert facts["Configurations"] == "3"
    assert facts["Swept"] == "window.n_links"
    assert facts["Runs"] == "12: 10 complete, 1 partly, 1 failed"
    assert facts["Frames"] == "11000"
    assert facts["Found finished"] == "1"
    assert facts["Time of all runs"] == "220 s"
    assert facts["Version"] == "gvo 1.2.3"
    assert "<p>Made up.</p>" in page.text
    assert "1 x no frame is usable" in page.text
    medians = page.text.partition('id="configurations"')[2].partition('id="runs"')[0]
    places = [medians.index(f"window.n_links={value}") for value in (1, 3, 5)]
    assert places == sorted(places)  # the most accurate first


def test_the_worst_runs_come_first_and_reports_are_linked(tmp_path: Path) -> None:
    rows = [*made_up(["x"], 3), failed(recording="gone", folder="gone")]
    (tmp_path / "drive_1" / "default").mkdir(parents=True)
    (tmp_path / "drive_1" / "default" / "report.html").touch()
    page = page_of(tmp_path, rows)
    runs = page.text.partition('id="runs"')[2]
    places = [runs.index(name) for name in ("gone", "drive 2", "drive 1", "drive 0")]
    assert places == sorted(places)
    assert 'href="drive_1/default/report.html"' in runs
    assert runs.count("href") == 1


@pytest.mark.parametrize(
    ("rows", "shows"),
    [
        ([failed()], "no run has an error or a time"),
        ([complete()], "no run has an error or a time"),
        ([complete(frame_ms=3.0, ate_smoothed_m=0.0)], "A row per recording"),
        (made_up(["x"], 60), "The first 40 of 60 are drawn"),
    ],
)
def test_any_table_has_a_report(tmp_path: Path, rows: list[BatchRow], shows: str) -> None:
    assert shows in page_of(tmp_path, rows).text


def test_nothing_outside_is_referred_to_and_equal_tables_give_equal_files(tmp_path: Path) -> None:
    rows = made_up([1, 3], 3)
    page = page_of(tmp_path, rows)
    page.assert_nothing_outside()
    assert "#runs" in page.links
    assert not {*page.tags} & {"script", "img", "iframe", "object", "base"}
    assert page_of(tmp_path, rows).text == page.text


def test_texts_of_others_are_escaped(tmp_path: Path) -> None:
    evil = '</title></svg><script>alert("1")</script>&$x_1$\u202e'
    rows = [
        replace(
            row,
            recording=f"{row.recording}{evil}",
            variant=f"{row.variant}{evil}",
            reason=evil,
            gvo_version=evil,
        )
        for row in [*made_up([1, 3], 2), failed()]
    ]
    page = page_of(tmp_path, rows)
    assert "script" not in page.tags
    assert "\u202e" not in page.text
    page.assert_nothing_outside()
