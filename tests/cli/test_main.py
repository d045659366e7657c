"""The command line: what it prints, its exit codes, one line for bad input."""

import json
import re
import signal
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

import gvo
from gvo.io.bag.source import BagSource
from tests.conftest import (
    TABLES,
    Command,
    is_one_line,
    python,
    refused,
    start,
)


def test_version_is_printed(command: Command) -> None:
    assert command("--version").out == f"gvo {gvo.__version__}\n"


def test_config_prints_a_few_or_all_and_is_read_back(command: Command, tmp_path: Path) -> None:
    for options in ([], ["--all"]):
        answer = command("config", *options, "--set", "window.n_links=4")
        assert yaml.safe_load(answer.out)["window"]["n_links"] == 4
        (tmp_path / "config.yaml").write_text(answer.out)
        assert command("config", *options, "--config", tmp_path / "config.yaml").out == answer.out
    few, every = (command("config", *options).out.splitlines() for options in ([], ["--all"]))
    assert len(few) < 0.6 * len(every)


def test_run_writes_and_prints_errors(command: Command, room_bag: Path, tmp_path: Path) -> None:
    options = ["--duration", "0.2", "--no-report"]
    answer = command("run", room_bag, "--out", tmp_path / "out", *options)
    assert answer.code == 0, answer.err
    assert "smoothed" in answer.out
    assert " in 6 frames, all tracked; " in answer.out
    learnt = json.loads((tmp_path / "out" / "summary.json").read_text())["rig_offsets"]
    assert {"readout_ms", "readout_sigma_ms"} <= set(learnt)
    *_, checked, wrote = answer.out.splitlines()
    assert checked == "gvo check: healthy"
    assert re.fullmatch(
        rf"wrote {tmp_path}/out: 6 frames in [\d.]+ s, [\d.]+ frames per second", wrote
    )
    assert answer.err == ""
    names = {path.name for path in (tmp_path / "out").iterdir()}
    others = {"effects.npy", "global.txt", "global_covariance.csv", "graph.g2o", "loops.csv"}
    assert (
        names == {*TABLES, "timings.csv", "ground_truth.txt", "summary.json", "rig.yaml"} | others
    )


@pytest.mark.parametrize(
    "arguments",
    [
        ["run", "missing.bag", "--out", "taken"],
        ["run", "missing.bag", "--bag", "taken"],
        ["run", "missing.bag", "--overlay", "taken/summary.json"],
        ["run", "missing.bag", "--plots", "taken"],
        ["compare", "missing.txt", "missing.txt", "--plot", "taken/summary.json"],
        ["compare", "missing.txt", "missing.txt", "--report", "taken/summary.json"],
        ["convert", "missing.bag", "taken"],
        ["demo", "--out", "taken"],
    ],
)
def test_what_is_there_is_refused_before_a_recording_is_opened(
    command: Command, here: Path, arguments: list[str]
) -> None:
    (here / "taken").mkdir()
    (here / "taken" / "summary.json").write_text("mine")
    answer = command(*arguments)
    assert "error: taken" in refused(answer)
    assert answer.out == ""
    assert (here / "taken" / "summary.json").read_text() == "mine"
    assert [path.name for path in here.rglob("*")] == ["taken", "summary.json"]


def test_a_run_is_replaced_if_asked_for(command: Command, room_bag: Path, tmp_path: Path) -> None:
    run = ["run", room_bag, "--out", tmp_path, "--no-report", "--duration"]
    assert command(*run, "0.1").code == 0
    before = (tmp_path / "raw.txt").read_text()
    assert command(*run, "0.15").code == 2
    assert (tmp_path / "raw.txt").read_text() == before
    assert command(*run, "0.15", "--force").code == 0
    assert (tmp_path / "raw.txt").read_text() != before


def test_settings_reach_the_run(command: Command, room_bag: Path, tmp_path: Path) -> None:
    (tmp_path / "c.yaml").write_text("window: {size: 4}\nfeatures: {n_features: 300}\n")
    settings = ["--config", tmp_path / "c.yaml", "--set", "features.n_features=400"]
    options = ["--no-report", "--duration", "0.1", *settings]
    command("run", room_bag, "--out", tmp_path / "out", *options)
    configuration = json.loads((tmp_path / "out/summary.json").read_text())["configuration"]
    assert configuration["window"]["size"] == 4
    assert configuration["features"]["n_features"] == 400
    rows = (tmp_path / "out/frames.csv").read_text().splitlines()[1:]
    assert all(int(row.split(",")[2]) <= 400 for row in rows)


def test_a_run_finds_loops_if_asked_for(command: Command, room_bag: Path, tmp_path: Path) -> None:
    options = ["--no-report", "--duration", "0.2"]
    same = "; global is smoothed\n"
    for out, given, is_global in (
        ("a", ["--set", "loops.enabled=false", "--loops"], True),
        ("b", ["--no-loops"], False),
    ):
        answer = command("run", room_bag, "--out", tmp_path / out, *options, *given)
        summary = json.loads((tmp_path / out / "summary.json").read_text())
        assert answer.code == 0, answer.err
        assert (tmp_path / out / "global.txt").exists() == is_global
        assert (f"no loop found{same}" in answer.out) == is_global
        assert summary["configuration"]["loops"]["enabled"] == is_global
        assert (summary["global"] is not None) == is_global
        assert ("global" in {row["name"] for row in summary["errors"]}) == is_global
    told = json.loads((tmp_path / "a" / "summary.json").read_text())["global"]
    lines = (tmp_path / "a" / "graph.g2o").read_text().splitlines()
    assert told["frames"] == sum(line.startswith("VERTEX") for line in lines) > 0
    assert told["edges"] == sum(line.startswith("EDGE") for line in lines) > 0
    assert told["loops"] == {"found": 0, "counted": 0, "refused": {}}
    assert told["error"] is told["error_before"] is None
    for name in ("{}.txt", "{}_covariance.csv"):
        smoothed, best = (tmp_path / "a" / name.format(each) for each in ("smoothed", "global"))
        assert smoothed.read_text() == best.read_text()


def test_compare_agrees_with_the_run(command: Command, room_bag: Path, tmp_path: Path) -> None:
    command("run", "--no-report", room_bag, "--out", tmp_path)
    answer = command("compare", room_bag, tmp_path / "raw.txt", tmp_path / "smoothed.txt", "--json")
    estimates = json.loads(answer.out)["estimates"]
    errors = json.loads((tmp_path / "summary.json").read_text())["errors"]
    assert [entry["name"] for entry in estimates] == ["raw", "smoothed"]
    for key in ("segments_m", "jumps"):
        first, second = (entry.pop(key) for entry in (estimates[0], errors[0]))
        assert first == second, key
    assert estimates[0] == pytest.approx(errors[0])
    errors_of = {"ate_m", "rpe_m", "rpe_deg", "t_pct", "r_deg_per_100m"}
    assert set(estimates[0]) >= {"name", "n"} | errors_of


def test_compare_of_a_run_folder_tells_of_its_covariances_too(
    command: Command, room_bag: Path, tmp_path: Path
) -> None:
    run, other = tmp_path / "run", tmp_path / "other.txt"
    command("run", "--no-report", room_bag, "--out", run)
    other.write_bytes((run / "raw.txt").read_bytes())
    row = {"rotation": 9.0, "translation": 1.25, "along": 0.5, "n": 40, "low": 0.6, "high": 1.5}
    summary = json.loads((run / "summary.json").read_text())
    told = {"nees": {"window": {"1s": {"bare": row}}}, "reference": "too short to fit"}
    (run / "summary.json").write_text(json.dumps(summary | told))
    found = json.loads(command("compare", room_bag, run, other, "--json").out)
    names = ["raw", "causal", "smoothed", "global", "other"]
    assert [entry["name"] for entry in found["estimates"]] == names
    assert found["runs"] == {str(run): summary | told}
    answer = command("compare", room_bag, run)
    assert f"{run}, against its ground truth\n" in answer.out
    assert re.search(
        r"window over 1 s, bare +40 +9\.00 +1\.25 +0\.50 +0\.60 to 1\.50\n", answer.out
    )
    assert "The run is too short to fit where the reference lies.\n" in answer.out
    files = [run / f"{name}.txt" for name in names[:-1]]
    assert command("compare", room_bag, *files).out == answer.out[: answer.out.index(f"\n{run}")]
    assert "runs" not in json.loads(command("compare", room_bag, other, "--json").out)


def test_compare_counts_repeated_rows_and_needs_3_poses(command: Command, tmp_path: Path) -> None:
    rows = [f"{k} {k} 0 0 0 0 0 1\n" for k in range(4)]
    (tmp_path / "truth.txt").write_text("".join(rows))
    (tmp_path / "twice.txt").write_text("".join([*rows, rows[-1], rows[-1]]))
    (tmp_path / "one.txt").write_text(50 * rows[0])
    answer = command("compare", tmp_path / "truth.txt", tmp_path / "twice.txt")
    assert answer.code == 0
    assert "twice.txt: 2 rows were left out, the next has the same stamp" in answer.err
    answer = command("compare", tmp_path / "truth.txt", tmp_path / "one.txt")
    assert answer.code == 2
    assert "one.txt: 49 rows were left out" in answer.err
    assert "one and the reference have poses in common: 1, expected at least 3" in answer.err


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["run", "missing.bag", "--out", "out"], ["missing.bag", "does not exist"]),
        (["run", ".", "--out", "out"], ["a recording is"]),
        (["run", "{bag}", ".", "--out", "out"], ["only bags can be combined into one recording"]),
        (["run", "{bag}", "--out", "out", "--set", "window.n_link=3"], ["window.n_links"]),
        (["run", "{bag}", "--out", "out", "--color", "/nothing"], ["/nothing"]),
        (["run", "{bag}", "--out", "text.bag"], ["text.bag", "cannot be written"]),
        (["run", "{bag}", "--out", "out", "--ground-truth", "missing.txt"], ["missing.txt"]),
        (["compare", "missing.txt", "missing.txt"], ["missing.txt"]),
        (["compare", "poses.txt", "poses.txt", "--segments", "0"], ["--segments 0"]),
        (["compare", "poses.txt", "poses.txt", "--plot", "plot.gif"], ["plot.gif"]),
        (["demo", "--out", "poses.txt"], ["poses.txt", "cannot be written"]),
        (["smooth", "missing.g2o"], ["missing.g2o", "does not exist"]),
        (["smooth", "text.g2o"], ["text.g2o:1"]),
        (["smooth", "poses.txt", "--topic", "/odom"], ["--topic /odom", "poses.txt"]),
        (["smooth", "poses.txt", "--sigma", "1"], ["--sigma 1", "0.1,0.02"]),
        (["smooth", "poses.txt", "--sigma", "1,2", "--sigma", "1,2"], ["2 times for 1 inputs"]),
        (["smooth", "graph.g2o", "--sigma", "1,2"], ["--sigma", "graph.g2o"]),
        (["smooth", "graph.g2o", "poses.txt"], ["graph.g2o", "one input"]),
        (["smooth", "-", "poses.txt"], ["standard input"]),
        (["smooth", "-", "--topic", "/odom"], ["--topic", "standard input"]),
        (["smooth", "poses.txt", "--set", "window.size=3"], ["--set", "--window"]),
        (["smooth", "poses.txt", "--keyframes", "manual"], ["--keyframes", "--window"]),
        (["smooth", "poses.txt", "--window", "--robust", "gnc"], ["--robust", "at once"]),
        (["smooth", "-", "--covariances"], ["--covariances", "at once"]),
        (["smooth", "{bag}"], ["holds no poses"]),
        (["explain", "{bag}", "--frame", "99", "--out", "out"], ["99", "20"]),
        (["explain", "{bag}", "--frame", "0", "--out", "text.txt"], ["text.txt"]),
        (["explain", "{bag}", "--frame", "1", "--out", "o", "--every", "0"], ["--every"]),
        (["view", "."], ["recording"]),
        (["view", "{bag}", "--port", "0", "--host", "203.0.113.7"], ["203.0.113.7"]),
        (["run", "{bag}", "--out", "out", "--overlay", "film.avi"], ["film.avi", ".webm"]),
        (["run", "{bag}", "--out", "out", "--no-report", "--plots", "p"], ["--plots"]),
        (["run", "{bag}", "--out", "out", "--every", "9", "--plots", "text.txt"], ["text.txt"]),
    ],
)
def test_bad_input_gets_one_line_and_exit_code_2(
    command: Command, room_bag: Path, here: Path, arguments: list[str], words: list[str]
) -> None:
    for name in ("text.bag", "text.txt", "text.g2o"):
        Path(name).write_text("No recording at all\n")
    Path("graph.g2o").write_text("EDGE3 0 1 1 0 0 0 0 0\n")
    write_poses(Path("poses.txt"))
    answer = command(*(argument.format(bag=room_bag) for argument in arguments))
    said = refused(answer)
    assert not (answer.out and arguments[0] == "compare")
    for word in words:
        assert word in said
    assert Path("text.txt").read_text() == "No recording at all\n"


@pytest.mark.parametrize("arguments", [["config", "-q"], ["compare", "a.txt", "a.txt", "-q"]])
def test_quiet_prints_errors_alone(command: Command, here: Path, arguments: list[str]) -> None:
    write_poses(here / "a.txt")
    assert command(*arguments)[::2] == (0, "")
    assert command("compare", "a.txt", "a.txt", "-q") == (0, "", "")
    assert is_one_line(command("compare", "a.txt", "missing.txt", "-q").err)
    assert "a" in command("compare", "a.txt", "a.txt").out


def test_verbose_logs_what_is_done(command: Command, room_bag: Path, tmp_path: Path) -> None:
    options = ["--no-report", "--duration", "0.1", "-v"]
    answer = command("run", room_bag, "--out", tmp_path / "out", *options)
    assert answer.code == 0
    lines = answer.err.splitlines()
    assert sum(line.startswith("gvo.runs.loop: frame at ") for line in lines) == 3
    assert any("parameters: defaults" in line for line in lines)
    assert command("check", room_bag).err == ""


def test_a_run_warns_of_a_calibration_that_changes(
    command: Command, monkeypatch: pytest.MonkeyPatch, room_bag: Path, tmp_path: Path
) -> None:
    monkeypatch.setattr(BagSource, "camera_info_changes", {"/camera/color/camera_info": 7})
    arguments = ["run", room_bag, "--out", tmp_path / "out", "--no-report", "--duration", "0.1"]
    answer = command(*arguments)
    assert answer.code == 0
    assert answer.err.startswith(
        "gvo: warning: CameraInfo changes on the way (7 of /camera/color/camera_info): "
    )
    assert command("check", room_bag).out.count("7 of /camera/color/camera_info") == 1


def test_run_and_check_take_masks_of_the_images_size(
    command: Command, room_bag: Path, tmp_path: Path
) -> None:
    camera = gvo.open_recording(room_bag).info.camera
    mask, other = tmp_path / "mask.png", tmp_path / "other.png"
    for path, height in ((mask, camera.height), (other, 7)):
        pixels = np.full((height, camera.width), 255, np.uint8)
        pixels[: 4 * height // 5] = 0
        assert cv2.imwrite(str(path), pixels)
    short = ["--duration", "0.1"]
    sizes = f"the mask has {camera.width}x7 pixels, the images {camera.width}x{camera.height}"
    out = ["--out", tmp_path / "out", "--no-report", *short]
    for arguments in (
        ["run", room_bag, *out],
        ["check", room_bag],
        ["explain", room_bag, "--frame", "0"],
    ):
        assert sizes in refused(command(*arguments, "--mask", other))
    counts = []
    for name, options in (("a", ()), ("b", ("--mask", mask))):
        folder = tmp_path / name
        answer = command("run", room_bag, "--out", folder, "--no-report", *short, *options)
        assert answer.code == 0
        rows = (folder / "frames.csv").read_text().splitlines()
        counts.append(
            int(dict(zip(rows[0].split(","), rows[1].split(","), strict=True))["n_points"])
        )
    assert counts[1] < 0.7 * counts[0]


def test_check_and_run_tell_of_a_calibration_for_images_of_another_size(
    command: Command, room_bag: Path, tmp_path: Path
) -> None:
    camera = gvo.open_recording(room_bag).info.camera
    K = [*(2.0 * camera.K).ravel().tolist()[:8], 1.0]
    keys = {"width": camera.width, "height": camera.height, "k": K}
    (tmp_path / "c.yaml").write_text(yaml.safe_dump(keys))
    options = ["--calibration", tmp_path / "c.yaml", "--duration", "0.1", "--no-report"]
    told = f"K fits an image of {2 * camera.width}x{2 * camera.height}, the image is "
    answer = command("run", room_bag, "--out", tmp_path / "out", *options)
    assert (answer.code, answer.err.count(f"gvo: warning: colour: {told}")) == (0, 1)
    assert told not in " ".join(answer.out.split())
    answer = command("check", room_bag, *options[:2])
    said = " ".join(answer.out.split())
    assert (answer.code, said.count(told), said.count("factor 0.5")) == (1, 1, 1)


def write_poses(path: Path, n: int = 20) -> Path:
    path.write_text("".join(f"{i} {i * i} 0 {i} 0 0 0 1\n" for i in range(n)))
    return path


@pytest.mark.parametrize("options", [["--window", "--keyframes", "manual"], ["--covariances"]])
def test_smooth_writes_and_compares(command: Command, tmp_path: Path, options: list[str]) -> None:
    poses = write_poses(tmp_path / "poses.txt")
    names_of = ("raw", "causal", "smoothed") if "--window" in options else ("raw", "smoothed")
    certain = names_of if "--window" in options else ("smoothed",)
    options = ["--sigma", "0.1,0.02", "--ground-truth", str(poses), *options]
    answer = command("smooth", poses, poses, "--out", tmp_path / "out", *options)
    assert answer.code == 0, answer.err
    assert "20 poses, 38 edges" in answer.out
    assert "smoothed" in answer.out
    assert answer.err == ""
    names = {path.name for path in (tmp_path / "out").iterdir()}
    assert names == {
        *(f"{name}.txt" for name in names_of),
        *(f"{name}_covariance.csv" for name in certain),
        *("frames.csv", "summary.json", "trajectories.png"),
    }


def test_smooth_tells_the_error_of_a_pose_graph(command: Command, tmp_path: Path) -> None:
    edge = "EDGE_SE3:QUAT 0 1 1 0 0 0 0 0 1 1 0 0 0 0 0 1 0 0 0 0 1 0 0 0 1 0 0 1 0 1\n"
    path = tmp_path / "graph.g2o"
    path.write_text(edge)
    answer = command("smooth", path, "--out", tmp_path / "out", "--robust", "gnc")
    assert answer.code == 0, answer.err
    assert "error 0 after 1 iterations" in answer.out
    assert "2 poses, 1 edges" in answer.out
    assert (tmp_path / "out/smoothed.g2o").read_text().splitlines()[-1] == edge.strip()


FIRST_LINE = '{"id": "a", "stamp_ns": 0}'
SECOND_LINE = '{"id": "b", "stamp_ns": 100000000, "reference": "a", "pose": [0, 0, 1, 0, 0, 0, 1]}'


def test_smooth_answers_a_pipe_line_by_line_until_a_signal(tmp_path: Path) -> None:
    process = start("smooth", "-", "--out", tmp_path)
    assert process.stdin is not None
    assert process.stdout is not None
    answers = []
    for line in (FIRST_LINE, SECOND_LINE, "nonsense", FIRST_LINE):
        # an answer must come before the next line is sent
        process.stdin.write(f"{line}\n")
        answers.append(json.loads(process.stdout.readline()))
    process.send_signal(signal.SIGINT)
    # the input stays open: it is the signal that ends the waiting
    assert process.wait(timeout=60) == 130
    rest, errors = process.communicate(timeout=60)
    assert [answer.get("id") for answer in answers] == ["a", "b", None, "a"]
    assert answers[2]["error"].startswith("line 3:")
    assert errors.startswith(f"gvo: interrupted; the poses so far are in {tmp_path}")
    assert (rest, errors.count("\n")) == ("", 1)
    for name in ("raw", "causal", "smoothed"):
        assert len(gvo.read_trajectory(tmp_path / f"{name}.txt")) == 2


@pytest.mark.parametrize(
    ("write", "told"),
    [
        (
            "os.write(2, 2 * b'libpng warning: \\x1b[31m\\n')",
            r"2 lines.*: libpng warning: \\x1b\[31m",
        ),
        ("subprocess.run(['sh', '-c', 'yes >&2'])", "more than 16384 lines.*: y"),
    ],
    ids=["few", "endless"],
)
def test_what_libraries_write_is_counted_what_gvo_writes_is_shown(write: str, told: str) -> None:
    program = (
        "import os, subprocess, sys\n"
        "from gvo.cli.terminal import chatter_counted\n"
        "with chatter_counted():\n"
        f"    {write}\n"
        "    print('own', file=sys.stderr)\n"
        "print('after', file=sys.stderr)\n"
        "os.write(2, b'last')\n"
    )
    answer = python("-c", program)
    assert re.fullmatch(f"own\ngvo: warning: {told}\nafter\nlast", answer.stderr)


def test_without_a_command_all_are_listed(command: Command) -> None:
    answer = command()
    assert answer.code == 2
    assert answer.out == command("-h").out


def test_a_terminal_gets_whole_words_and_colours_unless_told_not_to(
    command: Command, monkeypatch: pytest.MonkeyPatch, here: Path
) -> None:
    write_poses(here / "truth.txt")
    rows = (here / "truth.txt").read_text().split("\n")
    (here / "a.txt").write_text("\n".join([*rows[:15], "15 300 0 15 0 0 0 1", *rows[16:]]))
    plain = command("compare", "truth.txt", "a.txt").out
    cause = plain.splitlines()[-1]
    assert cause.startswith("a: Likely cause: jumps of ")
    monkeypatch.setattr("sys.stdout.isatty", lambda: True)
    monkeypatch.setenv("COLUMNS", "60")
    monkeypatch.setenv("NO_COLOR", "1")
    fitted = command("compare", "truth.txt", "a.txt").out
    assert fitted.split() == plain.split()
    assert max(map(len, fitted.splitlines())) <= 60 < len(cause)
    monkeypatch.delenv("NO_COLOR")
    coloured = command("compare", "truth.txt", "a.txt").out
    assert coloured.count("\x1b[31m") == 1
    assert re.sub(r"\x1b\[\d+m", "", coloured) == fitted


def test_a_second_run_into_the_usual_folder_says_so_last(
    command: Command, room_bag: Path, here: Path
) -> None:
    arguments = ["run", room_bag, "--no-report", "--duration", "0.1"]
    last = [command(*arguments).out.splitlines()[-1] for _ in range(2)]
    folder = f"gvo-{room_bag.stem}"
    assert last[0].startswith(f"wrote {folder}: 3 frames in ")
    assert last[1].startswith(f"wrote {folder}-2: 3 frames in ")
    assert [line.endswith(f"; {folder} holds an earlier run") for line in last] == [False, True]


def test_a_run_keeps_what_it_learnt_and_another_starts_from_it(
    drive_bag: Path, command: Command, here: Path
) -> None:
    short = ["--duration", "0.5", "--no-report"]
    assert command("run", drive_bag, "--out", "first", *short).code == 0
    kept = here / "first" / "rig.yaml"
    held = json.loads((here / "first" / "summary.json").read_text())["rig"]
    assert yaml.safe_load(kept.read_text()) == held
    again = ["run", drive_bag, *short, "--rig", kept, "--out"]
    assert command(*again, "again").code == 0
    assert yaml.safe_load((here / "again/rig.yaml").read_text())["frames"] == 2 * held["frames"]
    off = ["--set", "stereo.estimate_offset=false"]
    assert command(*again, "held", *off).code == 0
    assert yaml.safe_load((here / "held/rig.yaml").read_text()) == held
    other = here / "other.yaml"
    other.write_text(kept.read_text().replace("sensor: stereo", "sensor: rgbd"))
    for name in ("run", "check", "explain"):
        frame = ["--frame", "2"] if name == "explain" else []
        assert "sensor rgbd" in refused(command(name, drive_bag, *frame, "--rig", other))
    written = refused(command("convert", drive_bag, here / "new.mcap", "--rig", kept))
    assert "--rig: images are written as they were recorded" in written
