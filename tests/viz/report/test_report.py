"""The page of a run and of a comparison, seen as text."""

import json
import re
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from gvo.io.run_folder.reader import read_run
from gvo.io.synthetic import SyntheticRecording
from gvo.viz.report import write_run_report
from tests.conftest import run_of
from tests.viz.report_page import Page

SECTIONS = [
    *("above", "side", "space", "errors_over_time", "errors_over_distance", "drift", "covariance"),
    *("status", "counts", "timings", "chi2", "rig"),
]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("run")
    run_of(SyntheticRecording("driving", "stereo", n_frames=12, scale=0.25), path)
    return path


@pytest.fixture(scope="module")
def page(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the page of the run, with its plots in the folder beside it."""
    path = tmp_path_factory.mktemp("page") / "page.html"
    write_run_report(path, read_run(folder), plots=path.parent / "plots")
    return path


@pytest.fixture
def copy(folder: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(folder, tmp_path / "copy"))


def rewrite_summary(folder: Path, **fields: object) -> None:
    path = folder / "summary.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | fields))


def page_of(folder: Path) -> str:
    path = folder / "page.html"
    write_run_report(path, read_run(folder))
    return path.read_text(encoding="utf-8")


def test_covariances_are_shown_both_ways_with_the_reference(copy: Path) -> None:
    row = {"rotation": 9.0, "translation": 1.25, "along": 0.5, "n": 40, "low": 0.6, "high": 1.5}
    sigmas = {"rotation_deg": [0.1] * 3, "lever_m": [0.001] * 3, "delay_ms": 0.6}
    reference = {"rotation_deg": [1.2, 0.0, 0.0], "lever_m": [0.0] * 3, "delay_ms": 4.0}
    ways = {"bare": row, "fitted": row | {"rotation": 2.0, "error_m": 0.01, "error_deg": 0.1}}
    nees = {"raw": {"1s": ways}, "window": {"1s": {}}}
    rewrite_summary(copy, nees=nees, reference=reference | {"sigmas": sigmas})
    text = page_of(copy)
    shown = re.findall(r"<td[^>]*>([^<]*)", text)
    start, rest = shown.index("raw over 1 s, bare"), ["1.25", "0.50", "0.60 to 1.50"]
    assert shown[start + 1 : start + 6] == ["40", "9.00", *rest]
    assert shown[start + 6 : start + 12] == ["raw over 1 s, fitted", "40", "2.00", *rest]
    assert "Fitted: the reference is turned by 1.2 \u00b1 0.1 deg" in text


def test_each_section_is_there_and_drawn_and_nothing_outside_referred_to(page: Path) -> None:
    content = Page(page.read_text())
    assert [name for name in content.ids if name in SECTIONS] == SECTIONS
    assert content.drawn == SECTIONS
    content.assert_nothing_outside()


def test_the_plots_are_files_named_by_their_order(page: Path) -> None:
    found = sorted((page.parent / "plots").iterdir())
    numbered = [f"{n:02d}_{slug}" for n, slug in enumerate(SECTIONS, 1) if slug != "space"]
    names = [f"{name}{end}" for name in numbered for end in (".pdf", ".png")]
    assert [path.name for path in found] == names
    assert np.asarray(cv2.imread(str(found[1]))).shape[2] == 3


def test_without_truth_a_sentence_says_why_and_all_texts_are_escaped(
    page: Path, copy: Path
) -> None:
    evil = "</title></script><script>alert(1)</script>\"'><img onload='x'>&"
    n_scripts = Page(page.read_text()).tags.count("script")
    rewrite_summary(copy, recording=evil, warnings=[evil], decisions=[evil], sensor=evil, errors=[])
    configuration = {"frontend": {"kind": evil}, "window": {"n_links": 7, "n_keyframes": 20}}
    rewrite_summary(copy, ground_truth=f"none: {evil}", configuration=configuration)
    (copy / "ground_truth.txt").unlink()
    rows = (copy / "frames.csv").read_text().splitlines()
    (copy / "frames.csv").write_text("\n".join([*rows[:-1], f"{rows[-1]}{evil}", ""]))
    text = page_of(copy)
    assert "<script>alert" not in text
    assert "<img onload" not in text
    assert text.count("&lt;script&gt;alert(1)") >= 6 + len(SECTIONS[3:7])
    assert Page(text).tags.count("script") == n_scripts
    assert Page(text).drawn == SECTIONS[:3] + SECTIONS[7:]
    # What differs from the default is marked, with the default.
    assert 'class="changed"' not in page.read_text()
    marked = re.findall(r'<tr class="changed">(.*?)</tr>', text)
    assert [re.sub("<[^>]*>", " ", row).split() for row in marked][-1] == [
        *("n_links", "7", "default", "3"),
    ]


def write_loops(folder: Path, n: int, *, reason: str) -> None:
    """Write loops from frame 0 to the last one, the first half of them refused."""
    header = "stamp_ns,reference_ns,n_inliers,residual,reason"
    stamps_ns = read_run(folder).trajectories["global"].stamps_ns
    ends = f"{stamps_ns[-1]},{stamps_ns[0]}"
    rows = [f"{ends},{50 + k},1.5,{reason if k < n // 2 else ''}" for k in range(n)]
    (folder / "loops.csv").write_text("\n".join([header, *rows, ""]))
    loops = {"found": n, "counted": n - n // 2, "refused": {reason: n // 2}}
    rewrite_summary(folder, **{"global": {"loops": loops}})


def test_loops_are_counted_drawn_and_listed(copy: Path, page: Path) -> None:
    assert "no loop found; global is smoothed." in page.read_text()
    assert "Thin lines" not in page.read_text()
    assert "loops" not in Page(page.read_text()).ids
    write_loops(copy, 90, reason="odd & <b>")
    text = page_of(copy)
    assert "<p>45 loops closed, 45 refused (45: odd &amp; &lt;b&gt;).</p>" in text
    for name in ("loops (45)", "refused loops (45)"):
        assert text.count(f">{name}<") == 3  # above, aside, and in space
    assert "Thin lines join both ends of a loop" in text
    table = text[text.index('<section id="loops">') :]
    table = table[: table.index("</section>")]
    assert table.count("<tr>") == 1 + 20
    assert table.count("odd &amp; &lt;b&gt;") == 10
    assert "70 more are in loops.csv" in table


def test_what_an_imu_did_is_said(copy: Path, page: Path) -> None:
    assert "the IMU" not in page.read_text()
    imu = {"has_started": False, "name": "/imu", "reason": "a <b> hole"}
    rewrite_summary(copy, imu=imu)
    assert "<p>the IMU /imu was not used: a &lt;b&gt; hole.</p>" in page_of(copy)


def test_positions_without_rotations_leave_out_what_needs_rotations(copy: Path) -> None:
    truth = read_run(copy).truth
    assert truth is not None
    (copy / "ground_truth.txt").unlink()
    points = zip(truth.stamps_ns.tolist(), truth.positions.tolist(), strict=True)
    rows = [f"{stamp_ns},{x},{y},{z}" for stamp_ns, (x, y, z) in points]
    table = "\n".join(["stamp_ns,x_m,y_m,z_m", *rows, ""])
    (copy / "ground_truth_positions.csv").write_text(table)
    text = page_of(copy)
    assert {*SECTIONS} - {*Page(text).drawn} == {"drift", "covariance"}
    assert "rotation error [deg]" not in text


def test_an_interrupted_run_is_shown_as_far_as_it_went(copy: Path) -> None:
    for name in ("summary.json", "edges.csv", "timings.csv", "ground_truth.txt"):
        (copy / name).unlink()
    text = page_of(copy)
    assert "has not ended" in text
    assert Page(text).drawn == [*SECTIONS[:3], "status", "counts"]
    for path in copy.glob("*.txt"):
        path.write_text("")
    (copy / "frames.csv").write_text("stamp_ns,status,reason\n")
    assert Page(page_of(copy)).drawn == []
