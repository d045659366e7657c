"""Plant mutants one at a time, and see whether a test fails: the work of `assurance.py --mutation`.

The tests are collected once, by a process that has imported everything; each mutant is a fork of
it, in which the code of one function is replaced. It runs the tests that reach the changed lines,
quick ones first, until one fails. Hypothesis draws the same examples each time and does not
shrink. Each test may use ten times the processor time that it takes without a mutant, and some
seconds; beyond, the mutant counts as killed by time. What no test reaches survives.

Results are kept in a file, by the text of the function and of the change: a run that is stopped
goes on where it was. What depends on other functions is not noticed: begin a new file
when the code has changed much. With other tests, `again` runs what survived once more.
"""

import ast
import gc
import json
import os
import random
import resource
import signal
import sys
import tempfile
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from itertools import zip_longest
from pathlib import Path
from types import CodeType, FunctionType

import coverage
import pytest
from mutants import Mutant, mutants_of  # type: ignore[import-not-found]

KILLED, TIMEOUT, SURVIVED, UNUSABLE = "killed", "timeout", "survived", "unusable"
_MEMORY = 8 << 30
_PATIENCE = 10.0


@dataclass(frozen=True, kw_only=True)
class Baseline:
    """What the tests do without a mutant."""

    seconds: list[float]
    reached: dict[str, dict[int, list[int]]]  # by file and line: the tests that run it


@dataclass(kw_only=True)
class Mutation:
    """A pytest plugin that runs mutants in place of the tests."""

    paths: list[Path]
    results_file: Path
    sample: int | None
    seed: int
    jobs: int
    spare_s: float
    again: bool = False
    mutants: list[Mutant] = field(default_factory=list)
    results: dict[str, str] = field(default_factory=dict)
    failed: bool = False

    def pytest_collection(self) -> None:
        """Make Hypothesis repeatable, before any test is imported."""
        from hypothesis import Phase, settings  # not before pytest has rewritten it

        phases = (Phase.explicit, Phase.generate)
        settings.register_profile(
            "mutation", deadline=None, derandomize=True, database=None, phases=phases
        )
        settings.load_profile("mutation")

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Remember that a test failed."""
        self.failed |= report.failed

    def pytest_runtestloop(self, session: pytest.Session) -> bool:
        """Run the mutants."""
        every = [mutant for path in self.paths for mutant in mutants_of(path)]
        # In the order of chance: what is done when a run is stopped is a sample too.
        random.Random(self.seed).shuffle(every)
        self.mutants = [each for each in every if each.before != each.after][: self.sample]
        if self.results_file.exists():
            self.results = json.loads(self.results_file.read_text(encoding="utf-8"))
        undone = ["", UNUSABLE, *([SURVIVED] if self.again else [])]
        left = [each for each in self.mutants if self.results.get(each.key, "") in undone]
        _say(f"{len(every)} mutants, {len(self.mutants)} chosen, {len(left)} to run")
        if left:
            baseline = self._measure(session)
            self._run_all(left, session, baseline)
        return True

    def _measure(self, session: pytest.Session) -> Baseline:
        """Run all tests once, in a fork, and find which lines each of them reaches."""
        with tempfile.TemporaryDirectory() as folder:
            answer = Path(folder) / "baseline.json"
            pid = os.fork()
            if pid == 0:
                _hush()
                os._exit(self._measure_here(session, answer))
            if os.waitpid(pid, 0)[1] != 0:
                raise pytest.UsageError("the tests fail without a mutant: " + _text(answer))
            found = json.loads(_text(answer))
        reached = {
            path: {int(line): tests for line, tests in lines.items()}
            for path, lines in found["reached"].items()
        }
        _say(f"{len(session.items)} tests, {sum(found['seconds']):.0f} s without a mutant")
        return Baseline(seconds=found["seconds"], reached=reached)

    def _measure_here(self, session: pytest.Session, answer: Path) -> int:
        files = [str(path.resolve()) for path in self.paths]
        tracer = coverage.Coverage(data_file=None, config_file=False, include=files)
        tracer.start()
        seconds = []
        for index in range(len(session.items)):
            tracer.switch_context(str(index))
            start = time.process_time()
            self._run_test(session, index, None)
            seconds.append(time.process_time() - start)
            if self.failed:
                answer.write_text(session.items[index].nodeid, encoding="utf-8")
                return 1
        tracer.stop()
        data = tracer.get_data()
        reached = {
            path: {
                line: [int(name) for name in names if name]
                for line, names in data.contexts_by_lineno(path).items()
            }
            for path in data.measured_files()
        }
        answer.write_text(json.dumps({"seconds": seconds, "reached": reached}), encoding="utf-8")
        return 0

    def _run_test(self, session: pytest.Session, index: int, following: int | None) -> None:
        item = session.items[index]
        next_item = None if following is None else session.items[following]
        item.ihook.pytest_runtest_protocol(item=item, nextitem=next_item)

    def _run_all(self, left: Sequence[Mutant], session: pytest.Session, baseline: Baseline) -> None:
        """Keep as many forks busy as there are jobs, and write down what they find."""
        functions = live_functions(self.paths)
        gc.freeze()  # so that forks share what is there
        waiting, done = list(reversed(left)), 0
        running: dict[int, tuple[Mutant, float]] = {}
        try:
            while waiting or running:
                while waiting and len(running) < self.jobs:
                    mutant = waiting.pop()
                    tests = select_tests(mutant, baseline)
                    pid = self._fork(mutant, functions, session, tests, baseline.seconds)
                    limit = 60.0 + 20.0 * sum(baseline.seconds[index] for index in tests)
                    running[pid] = mutant, time.monotonic() + limit
                for pid, result in _ended({pid: end for pid, (_, end) in running.items()}):
                    self.results[running.pop(pid)[0].key] = result
                    done += 1
                    if done % 25 == 0:
                        self._save()
                        _say(f"{done} of {len(left)}")
        finally:
            for pid in running:
                os.killpg(pid, signal.SIGKILL)
            self._save()

    def _fork(
        self,
        mutant: Mutant,
        functions: dict[tuple[str, str], list[FunctionType]],
        session: pytest.Session,
        tests: list[int],
        seconds: list[float],
    ) -> int:
        """Start the tests of a mutant, and return the process that runs them."""
        pid = os.fork()
        if pid:
            return pid
        code = 3
        try:
            os.setsid()
            _hush()
            resource.setrlimit(resource.RLIMIT_DATA, (_MEMORY, _MEMORY))
            if install(mutant, functions):
                code = int(self._is_noticed(session, tests, seconds))
        finally:
            os._exit(code)

    def _is_noticed(self, session: pytest.Session, tests: list[int], seconds: list[float]) -> bool:
        signal.signal(signal.SIGPROF, signal.SIG_DFL)
        for index, following in zip_longest(tests, tests[1:]):
            limit = self.spare_s + _PATIENCE * seconds[index]
            signal.setitimer(signal.ITIMER_PROF, limit)
            try:
                self._run_test(session, index, following)
            except BaseException:  # noqa: BLE001 - as pytest.exit or an interrupt: noticed
                return True
            if self.failed:
                return True
        return False

    def _save(self) -> None:
        new = self.results_file.with_suffix(".new")
        new.write_text(json.dumps(self.results, indent=0, sort_keys=True), encoding="utf-8")
        new.replace(self.results_file)


def live_functions(paths: Iterable[Path]) -> dict[tuple[str, str], list[FunctionType]]:
    """Return the functions that were made of files, by file and qualified name."""
    files = {str(path.resolve()) for path in paths}
    found: dict[tuple[str, str], list[FunctionType]] = {}
    for each in gc.get_objects():
        if isinstance(each, FunctionType) and each.__code__.co_filename in files:
            place = each.__code__.co_filename, each.__code__.co_qualname
            found.setdefault(place, []).append(each)
    return found


def select_tests(mutant: Mutant, baseline: Baseline) -> list[int]:
    """Return the tests that reach a mutant, quick ones first."""
    reached = baseline.reached.get(str(mutant.path.resolve()), {})
    if mutant.is_constant:
        lines = {
            line
            for node in ast.walk(mutant.tree)
            if isinstance(node, ast.Name) and node.id == mutant.scope
            for line in range(node.lineno - 3, node.lineno + 4)
        }
    else:
        lines = set(range(mutant.lines[0], mutant.lines[1] + 1))
    tests = {test for line in lines for test in reached.get(line, [])}
    return sorted(tests, key=lambda test: baseline.seconds[test])


def install(mutant: Mutant, functions: dict[tuple[str, str], list[FunctionType]]) -> bool:
    """Put a mutant in the place of what is imported; False where it cannot be."""
    mutant.plant()
    file = str(mutant.path.resolve())
    module = compile(mutant.tree, file, "exec", dont_inherit=True)
    if mutant.is_constant:
        return _replace_constant(mutant, file)
    targets = functions.get((file, mutant.scope), [])
    codes = {code.co_firstlineno: code for code in _codes(module, mutant.scope)}
    for function in targets:
        try:
            function.__code__ = codes[function.__code__.co_firstlineno]
        except (KeyError, ValueError):
            return False
        if isinstance(mutant.parent, ast.arguments):
            _replace_default(mutant, function)
    return bool(targets)


def _codes(code: CodeType, name: str) -> Iterable[CodeType]:
    for each in code.co_consts:
        if isinstance(each, CodeType):
            if each.co_qualname == name:
                yield each
            yield from _codes(each, name)


def _replace_default(mutant: Mutant, function: FunctionType) -> None:
    value = ast.literal_eval(ast.unparse(mutant.node))
    if mutant.field == "kw_defaults":
        name = mutant.parent.kwonlyargs[mutant.index].arg
        function.__kwdefaults__ = {**(function.__kwdefaults__ or {}), name: value}
    else:
        old = function.__defaults__ or ()
        function.__defaults__ = (*old[: mutant.index], value, *old[mutant.index + 1 :])


def _replace_constant(mutant: Mutant, file: str) -> bool:
    """Give a constant its changed value, wherever it was imported."""
    home = next(m for m in sys.modules.values() if getattr(m, "__file__", None) == file)
    old = vars(home).get(mutant.scope)
    statement = next(
        each
        for each in mutant.tree.body
        if isinstance(each, ast.Assign) and ast.unparse(each.targets[0]) == mutant.scope
    )
    scratch = dict(vars(home))
    exec(compile(ast.Module([statement], []), file, "exec"), scratch)  # the file's own text
    for module in list(sys.modules.values()):
        if vars(module).get(mutant.scope) is old and old is not None:
            setattr(module, mutant.scope, scratch[mutant.scope])
    return old is not None


def _ended(deadlines: dict[int, float]) -> list[tuple[int, str]]:
    """Wait for forks to end; those beyond their time are ended."""
    while True:
        found = []
        for pid, deadline in deadlines.items():
            done, status = os.waitpid(pid, os.WNOHANG)
            if done:
                found.append((pid, _result(status)))
            elif time.monotonic() > deadline:
                os.killpg(pid, signal.SIGKILL)
                os.waitpid(pid, 0)
                found.append((pid, TIMEOUT))
        if found:
            return found
        time.sleep(0.01)


def _result(status: int) -> str:
    if os.WIFSIGNALED(status):
        return TIMEOUT if os.WTERMSIG(status) == signal.SIGPROF else KILLED
    return {0: SURVIVED, 3: UNUSABLE}.get(os.WEXITSTATUS(status), KILLED)


def _hush() -> None:
    nothing = os.open(os.devnull, os.O_RDWR)
    for stream in (0, 1, 2):
        os.dup2(nothing, stream)


def _text(path: Path) -> str:
    return path.read_text(encoding="utf-8") if path.exists() else ""


def _say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)
