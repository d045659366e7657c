"""Feed what reads files and messages with input that means harm, guided by coverage.

    python tests/quality/fuzz.py --list
    python tests/quality/fuzz.py --target edge_lines --seconds 60
    python tests/quality/fuzz.py --all --seconds 3600 --json counts.json
    python tests/quality/fuzz.py --target edge_lines --replay fuzz-findings/edge_lines-3f2a.bin

Nothing but a `GvoError` may come out, in a bounded time and a bounded memory; docs/fuzzing.md says
how much. Anything else is a finding: its input is written to a folder, and the exit code is 1.
Needs `pip install '.[test]'`, on a machine for which atheris has a wheel.
"""

import argparse
import hashlib
import json
import os
import random
import re
import subprocess
import sys
import tempfile
import time
import traceback
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
FINDINGS = Path("fuzz-findings")
# libFuzzer ends the process on these; the parent goes on with the rest of the time.
CRASHES = ("crash-*", "timeout-*", "oom-*", "slow-unit-*")
SLACK_S = 300.0  # to start, on a busy machine, and to end


def main() -> int:
    options = parse()
    sys.path.insert(0, str(ROOT))
    if options.worker:
        return work(options)
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    os.environ.setdefault("OPENCV_LOG_LEVEL", "OFF")
    from tests.fuzz.targets import TARGETS

    if options.list:
        print("\n".join(TARGETS))
        return 0
    if options.replay:
        return replay(options.target, options.replay)
    names = list(TARGETS) if options.all else [options.target]
    unknown = [name for name in names if name not in TARGETS]
    if unknown:
        print(f"no target {unknown[0]}: --list names them", file=sys.stderr)
        return 2
    share = None if options.seconds is None else options.seconds / len(names)
    rows = []
    for name in names:
        rows.append(run_target(name, share, options))
        if options.log:
            with options.log.open("a") as log:
                log.write(json.dumps(rows[-1]) + "\n")
    print(table(rows))
    if options.json:
        options.json.write_text(json.dumps(rows, indent=1) + "\n")
    return 1 if any(row["findings"] for row in rows) else 0


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--list", action="store_true", help="print the names of the targets")
    parser.add_argument("--target", help="one of them")
    parser.add_argument("--all", action="store_true", help="all of them, one after the other")
    parser.add_argument("--seconds", type=float, help="in all; divided among the targets")
    parser.add_argument("--runs", type=int, help="executions per target")
    parser.add_argument("--seed", type=int, default=0, help="of the random numbers; 0: any")
    parser.add_argument("--corpus", type=Path, help="folder of inputs, kept; a folder per target")
    parser.add_argument("--findings", type=Path, default=FINDINGS, help="where to write findings")
    parser.add_argument("--json", type=Path, help="write the counts to a file")
    parser.add_argument("--log", type=Path, help="append the counts to a file, a line per target")
    parser.add_argument("--replay", type=Path, help="run --target once with the input of a file")
    parser.add_argument("--worker", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if not (options.list or options.all or options.target):
        parser.error("give --list, --all or --target NAME")
    if options.seconds is None and options.runs is None:
        options.seconds = 60.0
    return options


def replay(name: str, path: Path) -> int:
    """Run a target once with the input of a file; what is wrong comes as a traceback."""
    from tests.fuzz.targets import TARGETS

    TARGETS[name].execute(path.read_bytes())
    print(f"{path}: {name} stands it")
    return 0


def run_target(name: str, seconds: float | None, options: argparse.Namespace) -> dict[str, Any]:
    """Fuzz one target in processes of its own until time or runs are used up."""
    start = time.monotonic()
    n_executions, findings = 0, set[str]()
    options.findings.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix="gvo-fuzz-") as folder:
        while True:
            left_s = None if seconds is None else seconds - (time.monotonic() - start)
            left_runs = None if options.runs is None else options.runs - n_executions
            if (left_s is not None and left_s < 1) or (left_runs is not None and left_runs < 1):
                break
            n_done, found = run_worker(name, Path(folder), (left_s, left_runs), options)
            findings |= found
            n_executions += n_done
            if not n_done or any("the process ended" in finding for finding in found):
                break
    elapsed_s = time.monotonic() - start
    return {
        "target": name,
        "executions": n_executions,
        "seconds": round(elapsed_s, 1),
        "per_second": round(n_executions / max(elapsed_s, 1e-9)),
        "findings": sorted(findings),
    }


def run_worker(
    name: str, folder: Path, left: tuple[float | None, int | None], options: argparse.Namespace
) -> tuple[int, set[str]]:
    """Run one process; return its executions and findings."""
    left_s, left_runs = left
    report = folder / "report.json"
    report.unlink(missing_ok=True)
    command = [sys.executable, str(Path(__file__).resolve()), "--target", name]
    command += ["--worker", str(folder), "--seed", str(options.seed)]
    command += ["--seconds", f"{left_s:.0f}"] if left_s is not None else []
    command += ["--runs", str(left_runs)] if left_runs is not None else []
    command += ["--corpus", str(options.corpus)] if options.corpus else []
    limit_s = None if left_s is None else left_s + SLACK_S
    try:
        answer = subprocess.run(command, capture_output=True, timeout=limit_s, check=False)
        output, is_dead = answer.stderr.decode(errors="replace"), answer.returncode != 0
    except subprocess.TimeoutExpired as error:
        output, is_dead = (error.stderr or b"").decode(errors="replace"), True
    found = {
        keep_finding(name, path, options.findings) for path in sorted(folder.glob("found-*[0-9]"))
    }
    crashes = [path for pattern in CRASHES for path in sorted(folder.glob(pattern))]
    found |= {keep_finding(name, path, options.findings) for path in crashes}
    n_done = max([0, *(int(number) for number in re.findall(r"^#(\d+)\s", output, re.M))])
    if report.is_file():
        n_done = max(n_done, json.loads(report.read_text())["executions"])
    if is_dead and not found:
        found.add(f"{name}: the process ended: {output[-300:]!r}")
    return n_done, found


def keep_finding(name: str, path: Path, findings: Path) -> str:
    """Move an input to the folder of findings; return how to replay it, and what it is."""
    data = path.read_bytes()
    digest = hashlib.blake2b(data, digest_size=4).hexdigest()
    kept = findings / f"{name}-{digest}.bin"
    kept.write_bytes(data)
    path.unlink()
    note = path.with_name(f"{path.name}.txt")
    kind = path.name.partition("-")[0]
    said = note.read_text() if note.is_file() else {"oom": "memory", "slow": "slow"}.get(kind, kind)
    note.unlink(missing_ok=True)
    kept.with_suffix(".txt").write_text(said)
    line = f"{said.strip().splitlines()[-1]}: --target {name} --replay {kept}"
    print(line, file=sys.stderr, flush=True)
    return line


def table(rows: list[dict[str, Any]]) -> str:
    lines = [f"{'target':20} {'executions':>11} {'seconds':>8} {'per s':>7} {'findings':>9}"]
    total = {
        "target": "all",
        "executions": sum(row["executions"] for row in rows),
        "seconds": sum(row["seconds"] for row in rows),
        "findings": [finding for row in rows for finding in row["findings"]],
    }
    total["per_second"] = round(total["executions"] / max(total["seconds"], 1e-9))
    for row in [*rows, total]:
        lines.append(
            f"{row['target']:20} {row['executions']:11} {row['seconds']:8.0f} "
            f"{row['per_second']:7} {len(row['findings']):9}"
        )
    return "\n".join(lines)


def work(options: argparse.Namespace) -> int:
    """Be the process that fuzzes: findings that are exceptions are noted, and it goes on."""
    atheris = import_module("atheris")  # without types
    with atheris.instrument_imports(include=["gvo", "rosbags", "yaml", "csv"]):
        from tests.fuzz.targets import TARGETS
    from tests.fuzz.target import MAX_MEGABYTES, MAX_SECONDS

    target, folder = TARGETS[options.target], options.worker
    counter = Counter(target.execute, folder)
    corpus = (options.corpus or folder) / options.target
    corpus.mkdir(parents=True, exist_ok=True)
    for number, seed in enumerate(target.seeds()):
        (corpus / f"seed-{number:03}").write_bytes(seed)
    arguments = [
        sys.argv[0],
        str(corpus),
        f"-artifact_prefix={folder}/",
        f"-timeout={MAX_SECONDS}",
        f"-rss_limit_mb={MAX_MEGABYTES}",
        f"-max_len={target.max_bytes}",
        f"-seed={options.seed}",
        "-print_final_stats=1",
        "-close_fd_mask=3",
    ]
    arguments += [f"-max_total_time={options.seconds:.0f}"] if options.seconds else []
    arguments += [f"-runs={options.runs}"] if options.runs else []
    chosen: dict[str, Any] = {}
    if target.mutate is not None:
        mutate = target.mutate

        def change(data: bytes, max_size: int, seed: int) -> bytes:
            rng = random.Random(seed)
            if rng.random() < 0.5:
                return bytes(atheris.Mutate(data, max_size))
            return mutate(data, rng)[:max_size]

        chosen["custom_mutator"] = change
    atheris.Setup(arguments, counter.run, enable_python_coverage=True, **chosen)
    atheris.Fuzz()
    return 0


class Counter:
    """Runs a target, counts, and keeps the first input of each kind of finding."""

    def __init__(self, execute: Callable[[bytes], None], folder: Path) -> None:
        self._execute = execute
        self._folder = folder
        self._kinds: set[tuple[str, str, int]] = set()
        self._n_executions = 0

    def run(self, data: bytes) -> None:
        self._n_executions += 1
        if self._n_executions % 1000 == 0:
            self._report()
        try:
            self._execute(data)
        except Exception as error:  # noqa: BLE001 - that is what is looked for
            self._note(error, data)

    def _note(self, error: Exception, data: bytes) -> None:
        frames = traceback.extract_tb(error.__traceback__)
        own = [frame for frame in frames if "/gvo/" in frame.filename] or frames
        kind = (type(error).__name__, own[-1].filename, own[-1].lineno or 0)
        if kind in self._kinds:
            return
        self._kinds.add(kind)
        path = self._folder / f"found-{len(self._kinds)}"
        text = "".join(traceback.format_exception(error))
        path.with_name(f"{path.name}.txt").write_text(text, errors="backslashreplace")
        path.write_bytes(data)

    def _report(self) -> None:
        (self._folder / "report.json").write_text(json.dumps({"executions": self._n_executions}))


if __name__ == "__main__":
    sys.exit(main())
