"""The page of a batch, seen as text."""

import itertools
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from urllib.parse import unquote, urlsplit
from urllib.request import url2pathname

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gvo.batch.report.plots import MAX_ROWS, box_of
from gvo.batch.report.report import run_address, write_batch_report
from gvo.batch.report.values import log_limits, log_ticks
from gvo.batch.tasks import BatchRow, Value
from gvo.config import Config
from gvo.errors import ConfigurationError
from tests.batch.rows import complete, failed
from tests.viz.report_page import Page

SWEEP: Mapping[str, Sequence[Value]] = {
    "window.n_links": [1, 3, 5],
    "frontend.subpixel": [True, False],
}
SECTIONS = ["boxes", "error_by_value", "time_by_value", "front", "runs"]


def made_up(
    sweep: Mapping[str, Sequence[Value]], n_recordings: int, *, noise: float = 0.1
) -> list[BatchRow]:
    """Return complete runs whose error doubles and whose time halves with the first parameter."""
    rng = np.random.default_rng(5)
    rows = []
    for number, combination in itertools.product(
        range(n_recordings), itertools.product(*sweep.values())
    ):
        parameters = dict(zip(sweep, combination, strict=True))
        variant = ",".join(f"{name}={value}" for name, value in parameters.items()) or "default"
        place = [*next(iter(sweep.values()))].index(combination[0]) if sweep else 0
        error_m = 10.0 ** (number - 1) * 2.0**place * np.exp(noise * rng.normal())
        rows.append(
            complete(
                recording=f"drive {number}",
                variant=variant,
                source=f"drive_{number}.mcap",
                folder=f"drive_{number}/{variant}",
                parameters=parameters,
                frames=1000,
                ate_raw_m=3.0 * error_m,
                ate_smoothed_m=error_m,
                frame_ms=20.0 / 2.0**place,
                run_s=20.0,
                gvo_version="1.2.3",
            )
        )
    return rows


def page_of(
    folder: Path, rows: Sequence[BatchRow], *, title: str = "Batch", note: str = ""
) -> Page:
    path = folder / "batch.html"
    write_batch_report(path, rows, title=title, note=note)
    return Page(path.read_text(encoding="utf-8"))


def test_a_sweep_has_all_sections_and_its_totals(tmp_path: Path) -> None:
    rows = made_up(SWEEP, 3)
    rows[4] = failed(rows[4], "no frame is usable")
    rows[8] = replace(rows[8], status="partly", reason="2 frames are faulty", is_found=True)
    page = page_of(tmp_path, rows, note="Made up.")
    assert [name for name in page.ids if name in SECTIONS] == SECTIONS
    assert page.drawn == SECTIONS[:-1]
    facts = page.facts()
    assert facts["Recordings"] == "3"
    assert facts["Configurations"] == "6"
    assert facts["Swept"] == "window.n_links, frontend.subpixel"
    assert facts["Runs"] == "18: 16 complete, 1 partly, 1 failed"
    assert facts["Frames"] == "17000"
    assert facts["Found finished"] == "1"
    assert facts["Version"] == "gvo 1.2.3"
    assert "<p>Made up.</p>" in page.text
    assert "<li>1 run: no frame is usable</li>" in page.text


def test_nothing_outside_is_referred_to_and_no_id_is_there_twice(tmp_path: Path) -> None:
    page = page_of(tmp_path, made_up(SWEEP, 3))
    page.assert_nothing_outside()
    assert "#runs" in page.links
    assert not {*page.tags} & {"script", "img", "iframe", "object", "base"}


def test_equal_input_gives_equal_files(tmp_path: Path) -> None:
    rows = made_up(SWEEP, 2)
    texts = set()
    for name in ("a", "b"):
        path = tmp_path / f"{name}.html"
        write_batch_report(path, rows, title="Batch", plots=tmp_path / name)
        texts.add(path.read_bytes())
    assert len(texts) == 1
    first, second = (sorted((tmp_path / name).iterdir()) for name in ("a", "b"))
    names = [f"{n:02d}_{s}{e}" for n, s in enumerate(SECTIONS[:-1], 1) for e in (".pdf", ".png")]
    assert [path.name for path in first] == names
    assert [path.read_bytes() for path in first] == [path.read_bytes() for path in second]


def test_texts_of_others_are_escaped(tmp_path: Path) -> None:
    evil = '</title></svg><script>alert("1")</script>&$x_1$'
    rows = [
        replace(
            row,
            recording=f"{row.recording}{evil}",
            variant=f"{row.variant}{evil}",
            reason=evil,
            folder=f"javascript:alert(1){evil}",
            parameters={f"a.{evil}": f"{row.parameters['a.b']}{evil}"},
            gvo_version=evil,
        )
        for row in made_up({"a.b": ["x", "y"]}, 3)
    ]
    rows[0] = failed(rows[0], evil)
    page = page_of(tmp_path, rows, title=evil, note=evil)
    assert "script" not in page.tags
    assert "<script" not in page.text
    assert page.text.count("&lt;script&gt;") >= 3 * len(rows)
    assert page.drawn == SECTIONS[:-1]
    assert page.rows["runs"][1][0] == f"drive 0{evil}"
    assert not [link for link in page.links if "javascript" in link]


def test_what_cannot_be_printed_is_escaped_and_other_scripts_are_kept(tmp_path: Path) -> None:
    rows = [
        replace(row, recording=f"{row.recording} 記録\u202e\x00\udc80", reason="a\nb")
        for row in made_up({}, 3)
    ]
    page = page_of(tmp_path, rows)
    assert page.drawn == ["boxes"]
    assert page.rows["runs"][1][0] == r"drive 2 記録\u202e\x00\udc80"
    assert r"記録\u202e\x00\udc80" in page.text.split('id="runs"')[0]


def test_a_name_leads_to_the_report_or_the_folder_or_nowhere(tmp_path: Path) -> None:
    rows = made_up({}, 5)
    names = ["a: b#c?d%20e", "only folder", "missing", "../beside", str(tmp_path / "absolute")]
    rows = [replace(row, folder=name) for row, name in zip(rows, names, strict=True)]
    page_folder = tmp_path / "pages"
    for name, has_report in zip(names, (True, False, None, True, True), strict=True):
        if has_report is not None:
            (page_folder / name).mkdir(parents=True)
        if has_report:
            (page_folder / name / "report.html").write_text("")
    links = [link for link in page_of(page_folder, rows).links if link[:1] != "#"][1:]
    found = [
        Path(url2pathname(urlsplit(link).path)) if "://" in link else page_folder / unquote(link)
        for link in links
    ]
    expected = [page_folder / names[n] / "report.html" for n in (4, 3, 0)]
    expected.insert(2, page_folder / names[1])
    assert [path.resolve() for path in found] == [path.resolve() for path in expected]
    assert not [link for link in links if urlsplit(link).scheme not in ("", "file")]
    assert not [link for link in links if "#" in link or "?" in link]


@pytest.mark.parametrize(
    ("folder", "address"),
    [
        ("https://runs.example/a b", "https://runs.example/a b"),
        ("javascript://%0aalert(1)", ""),
        ("//host.example/x", ""),
        ("data:text/html,x", ""),
        ("x" * 5000, ""),
        ("a\x00b", ""),
    ],
)
def test_only_addresses_of_the_web_lead_into_it(folder: str, address: str, tmp_path: Path) -> None:
    assert run_address(folder, tmp_path) == address


def test_an_absolute_folder_is_none_of_another_machine(tmp_path: Path) -> None:
    # a browser takes two slashes for the name of a host
    assert run_address(f"/{tmp_path}", tmp_path).startswith("file://")


def test_the_worst_run_of_a_sweep_stands_first(tmp_path: Path) -> None:
    rows = made_up({"window.n_links": [1, 3, 5]}, 3, noise=0.0)
    # errors 0.1, 0.2, 0.4; 1, 2, 4; 10, 20, 40
    rows[1] = replace(rows[1], ate_smoothed_m=1.5)  # fifteen times the best, though small
    rows[8] = failed(rows[8], "no frame is usable")
    rows[3] = replace(rows[3], status="partly", coverage_percent=97.0)
    rows[4] = replace(rows[4], status="partly", coverage_percent=99.0)
    table = page_of(tmp_path, rows).rows["runs"]
    at, over = table[0].index("configuration"), table[0].index("over the best")
    order = [(row[0], row[at][-1]) for row in table[1:]]
    assert order == [
        ("drive 2", "5"),
        ("drive 1", "1"),
        ("drive 1", "3"),
        ("drive 0", "3"),
        ("drive 0", "5"),
        ("drive 1", "5"),
        ("drive 2", "3"),
        ("drive 0", "1"),
        ("drive 2", "1"),
    ]
    assert table[1][2:] == ["failed", "no frame is usable"]
    assert [row[over] for row in table[4:]] == [
        *("15.000", "4.000", "4.000", "2.000", "1.000", "1.000")
    ]


def test_global_errors_have_a_column_where_there_are_any(tmp_path: Path) -> None:
    rows = made_up({}, 2)
    assert "ATE global [m]" not in page_of(tmp_path, rows).rows["runs"][0]
    rows[0] = replace(rows[0], ate_global_m=0.0123)
    header, *lines = page_of(tmp_path, rows).rows["runs"]
    at = header.index("ATE global [m]")
    assert header[at - 1] == "ATE smoothed [m]"
    assert sorted(line[at] for line in lines) == ["-", "0.0123"]


def test_the_worst_recording_of_one_configuration_stands_first(tmp_path: Path) -> None:
    rows = made_up({}, 4)
    rows[1] = failed(rows[1])
    page = page_of(tmp_path, rows)
    assert page.drawn == ["boxes"]
    assert [name for name in page.ids if name in SECTIONS] == ["boxes", "runs"]
    assert [row[0] for row in page.rows["runs"][1:]] == ["drive 1", "drive 3", "drive 2", "drive 0"]
    assert "configuration" not in page.rows["runs"][0]
    for label in ("drive 0", "drive 1 (failed)", "all 3"):
        assert f">{label}</text>" in page.text


def test_the_table_of_values_holds_the_planted_effect(tmp_path: Path) -> None:
    rows = made_up(SWEEP, 4, noise=0.0)
    rows[0] = failed(rows[0])
    rows[7] = replace(rows[7], status="partly", coverage_percent=50.0, ate_smoothed_m=1e-9)
    page = page_of(tmp_path, rows)
    head, *values = page.rows["time_by_value"]
    assert [row[:3] for row in values] == [
        ["window.n_links", "1", "0.500"],
        ["", "3", "1.000"],
        ["", "5", "2.000"],
        ["frontend.subpixel", "false", "1.000"],
        ["", "true", "1.000"],
    ]
    assert values[0][3:6] == ["0.500 to 0.500", "2.000", "2.000 to 2.000"]
    assert head[6:] == ["compared", "set aside", "failed"]
    assert [row[6:] for row in values] == [
        ["6", "1", "1"],
        ["8", "0", "0"],
        ["8", "0", "0"],
        ["11", "1", "0"],
        ["11", "0", "1"],
    ]
    assert ">1 failed</text>" in page.text


def test_the_front_names_its_members_and_leaves_out_what_failed(tmp_path: Path) -> None:
    rows = made_up({"window.n_links": [1, 3, 5]}, 3, noise=0.0)
    page = page_of(tmp_path, rows)
    assert [row[0] for row in page.rows["front"][1:]] == [f"window.n_links={n}" for n in (5, 3, 1)]
    assert page.rows["front"][1][1:] == ["1", "2.000", "0.500", "3 of 3"]
    assert ">1: n_links=5</text>" in page.text
    assert ">default values</text>" in page.text
    assert Config().window.n_links == 3
    rows[2] = failed(rows[2])
    page = page_of(tmp_path, rows)
    assert [row[0][-1] for row in page.rows["front"][1:]] == ["3", "1"]
    assert ">incomplete</text>" in page.text
    assert "2 of 3 configurations have a comparable run of each of the 3" in page.text


def test_the_configuration_with_all_defaults_is_marked(tmp_path: Path) -> None:
    defaults = Config()
    n_links, n_inliers = defaults.window.n_links, defaults.ransac.min_inliers
    sweep = {"window.n_links": [n_links, 77], "ransac.min_inliers": [78, n_inliers]}
    bold = r"<text style=\"[^\"]*(?:bold|700)[^\"]*\"[^>]*>([^<]*)</text>"
    page = page_of(tmp_path, made_up(sweep, 2))
    assert re.findall(bold, page.text) == [f"n_links={n_links},min_inliers={n_inliers}"]
    # with a value that is not its default there is none
    assert not re.findall(bold, page_of(tmp_path, made_up({**sweep, "a.b": [1]}, 2)).text)


def test_without_truth_coverage_and_time_are_left(tmp_path: Path) -> None:
    rows = [replace(row, ate_raw_m=None, ate_smoothed_m=None) for row in made_up(SWEEP, 3)]
    page = page_of(tmp_path, rows)
    assert page.drawn == ["boxes", "time_by_value"]
    assert "ATE smoothed [m]" not in page.text
    assert page.rows["time_by_value"][1][:5] == ["window.n_links", "1", "-", "-", "2.000"]
    assert page.facts()["Ground truth"] == "no run has an error"
    assert not {"ATE smoothed [m]", "over the best"} & {*page.rows["runs"][0]}


@pytest.mark.parametrize("sweep", [SWEEP, {}])
def test_of_failed_runs_reasons_stay(sweep: Mapping[str, Sequence[Value]], tmp_path: Path) -> None:
    rows = [failed(row, f"reason {row.recording}") for row in made_up(sweep, 30)]
    page = page_of(tmp_path, rows)
    assert page.drawn == []
    assert len(page.rows["runs"]) == 1 + len(rows)
    assert page.text.count("reason drive 29") >= 1
    assert "10 other reasons: see the table" in page.text


@pytest.mark.parametrize("is_failed", [True, False])
def test_one_row_is_enough(is_failed: bool, tmp_path: Path) -> None:
    [row] = made_up({}, 1)
    page = page_of(tmp_path, [failed(row) if is_failed else row])
    assert page.drawn == ([] if is_failed else ["boxes"])
    assert len(page.rows["runs"]) == 2


@pytest.mark.parametrize("n", [1, 2, 3])
def test_two_runs_have_no_spread(n: int, tmp_path: Path) -> None:
    page = page_of(tmp_path, made_up({"window.n_links": [1, 3]}, n))
    quartiles = {text for row in page.rows["time_by_value"][1:] for text in (row[3], row[5])}
    assert (quartiles == {"-"}) == (n < 3)
    assert ("middle half" in page.text) == (n == 3)


def test_values_of_every_kind_stand_in_order(tmp_path: Path) -> None:
    sweep: dict[str, list[Value]] = {"a.kind": ["orb", "klt"], "b.limit": [2.5, None, 1.0]}
    page = page_of(tmp_path, made_up(sweep, 2))
    values = {row[1]: row[0] for row in page.rows["time_by_value"][1:]}
    assert [*values] == ["orb", "klt", "1", "2.5", "null"]


@pytest.mark.parametrize("n", [MAX_ROWS, MAX_ROWS + 15])
def test_of_many_configurations_the_best_and_the_worst_are_drawn(n: int, tmp_path: Path) -> None:
    rows = made_up({"window.n_links": [*range(1, n + 1)]}, 2, noise=0.0)
    # all take the same time: the front is the first alone
    rows = [replace(row, frame_ms=10.0) for row in rows]
    page = page_of(tmp_path, rows)
    boxes = page.text.split('id="boxes"')[1].split("</section>")[0]
    drawn = [int(name) for name in re.findall(r">n_links=(\d+)</text>", boxes)]
    expected = [*range(1, n + 1)] if n == MAX_ROWS else [*range(1, 11), *range(n - 9, n + 1)]
    assert drawn == expected
    assert (f"Of the {n} configurations" in boxes) == (n > MAX_ROWS)
    assert (">... 25 more ...</text>" in boxes) == (n > MAX_ROWS)
    assert len(page.rows["runs"]) == 1 + 2 * n


def test_of_many_recordings_the_best_and_the_worst_are_drawn_beside_all(tmp_path: Path) -> None:
    rows = [replace(row, ate_smoothed_m=1.0 + n) for n, row in enumerate(made_up({}, 50))]
    rows[30] = failed(rows[30])
    page = page_of(tmp_path, rows)
    boxes = page.text.split('id="boxes"')[1].split("</section>")[0]
    drawn = [int(name) for name in re.findall(r">drive (\d+)</text>", boxes)]
    assert drawn == [*range(10), *range(40, 50)]
    assert ">all 49</text>" in boxes
    assert len(page.rows["runs"]) == 51


def test_long_names_of_a_sweep_are_told_apart_by_their_values(tmp_path: Path) -> None:
    sweep: dict[str, list[Value]] = {f"section.parameter_{letter}": [1, 2] for letter in "abcd"}
    page = page_of(tmp_path, made_up(sweep, 2))
    assert ">1 / 2 / 1 / 2</text>" in page.text
    assert "Names are the values of parameter_a / parameter_b / parameter_c / parameter_d" in (
        page.text
    )


def test_long_names_of_others_are_told_apart_by_what_differs(tmp_path: Path) -> None:
    names = [f"a search over many parameters, number {n} of all that were made" for n in range(4)]
    rows = made_up({"window.n_links": [1, 2, 3, 4]}, 2)
    rows = [replace(row, variant=names[n % 4], parameters={}) for n, row in enumerate(rows)]
    page = page_of(tmp_path, rows)
    assert page.drawn == ["boxes", "front"]
    assert re.findall(r">(\.\.\.\d\.\.\.)</text>", page.text) == [f"...{n}..." for n in range(4)]
    assert {row[1] for row in page.rows["runs"][1:]} == {*names}


def test_boxes_on_a_logarithmic_axis_are_those_of_the_logarithms() -> None:
    values = 10.0 ** np.array([0.0, 1.0, 2.0, 3.0, 4.0, 50.0])
    five = box_of(values, is_logarithmic=True)
    assert np.log10(five).tolist() == pytest.approx([0.0, 1.25, 2.5, 3.75, 4.0])


@given(st.floats(1e-6, 1e6), st.floats(1.0, 1e8), st.integers(4, 10))
def test_logarithmic_axes_have_a_few_labels_inside(low: float, ratio: float, n_most: int) -> None:
    first, last = log_limits(low, low * ratio)
    assert first < low
    assert last > low * ratio
    ticks = log_ticks(first, last, n_most)
    assert 2 <= len(ticks) <= n_most
    assert first <= min(ticks) < max(ticks) <= last
    assert len({f"{tick:g}" for tick in ticks}) == len(ticks)
    if ratio > 1e4:
        assert min(after / before for before, after in itertools.pairwise(ticks)) > 1.9


def test_what_cannot_be_written_is_refused(tmp_path: Path) -> None:
    rows = made_up({}, 2)
    (tmp_path / "file").write_text("")
    with pytest.raises(ValueError, match="at least one row"):
        write_batch_report(tmp_path / "page.html", [], title="Batch")
    with pytest.raises(ConfigurationError, match=r"ending in \.html"):
        write_batch_report(tmp_path / "page.txt", rows, title="Batch")
    with pytest.raises(ConfigurationError, match="cannot be made"):
        write_batch_report(tmp_path / "page.html", rows, title="B", plots=tmp_path / "file")
    assert "</html>" in (tmp_path / "page.html").read_text()
