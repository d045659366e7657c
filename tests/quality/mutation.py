"""Plant small faults in the code, one at a time, and count those that make a test fail.

Each mutant replaces one node of the syntax tree inside of a function, as `_faults` says. All tests
are run once to find which lines each reaches. Each mutant is then a fork in which the code of one
function is replaced: it runs the tests that reach the changed lines, quick ones first, until one
fails or takes ten times its processor time. Kernels are not compiled: Python runs them. The
interval printed is Wilson's, at 95 %.

Example: python tests/quality/mutation.py --sample 200 --seed 0 --jobs 2
"""

import argparse
import ast
import gc
import json
import os
import random
import signal
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import redirect_stdout
from dataclasses import dataclass, field
from itertools import zip_longest
from pathlib import Path
from types import CodeType, FunctionType
from typing import Any

import coverage
import cv2
import pytest
from scipy.stats import binomtest

ROOT = Path(__file__).resolve().parents[2]
PATHS = ("gvo/geometry", "gvo/backend", "gvo/kernels", "gvo/trajectory", "gvo/io/sync.py")
TESTS = [f"tests/{room}" for room in ("geometry", "backend", "kernels", "trajectory")]
TESTS += ["tests/io/test_sync.py", "tests/io/test_sync_reference.py"]
MIN_KILLED, UNUSABLE = 0.9, 3
SPARE_S, PATIENCE = 5.0, 10.0
# What is tested in processes of its own, where no mutant is.
NOT_CHANGED = {ROOT / "gvo/kernels/jit.py", ROOT / "gvo/kernels/compiler.py"}
# Compiled kernels do not warn of what is divided by zero.
WARNINGS = "filterwarnings=error\nignore::RuntimeWarning:gvo.kernels"

_NEIGHBOURS: dict[type[ast.AST], tuple[type[Any], ...]] = {
    ast.Lt: (ast.LtE, ast.GtE), ast.LtE: (ast.Lt, ast.Gt), ast.Gt: (ast.GtE, ast.LtE),
    ast.GtE: (ast.Gt, ast.Lt), ast.Eq: (ast.NotEq,), ast.NotEq: (ast.Eq,), ast.Is: (ast.IsNot,),
    ast.IsNot: (ast.Is,), ast.In: (ast.NotIn,), ast.NotIn: (ast.In,), ast.Add: (ast.Sub,),
    ast.Sub: (ast.Add,), ast.Mult: (ast.Div,), ast.Div: (ast.Mult,), ast.FloorDiv: (ast.Mult,),
    ast.Mod: (ast.Mult,), ast.Pow: (ast.Mult,), ast.BitAnd: (ast.BitOr,), ast.BitOr: (ast.BitAnd,),
    ast.And: (ast.Or,), ast.Or: (ast.And,),
}  # fmt: skip
_SWAPS = ("minimum maximum", "min max", "any all", "argmin argmax", "zeros ones", "sin cos")
_NAMES = {a: b for pair in _SWAPS for a, b in (pair.split(), pair.split()[::-1])}
_UNTOUCHED = {"annotation", "returns", "decorator_list"}
_CONDITIONS = (ast.Name, ast.Attribute, ast.Call, ast.NamedExpr, ast.Subscript)
_HARMLESS = {"reason", "encoding", "newline", "strict"}


@dataclass(frozen=True, kw_only=True)
class Mutant:
    """One fault: `node` in place of what stands in a field of `parent`."""

    path: Path
    function: str
    lines: range
    operator: str
    old: ast.AST
    node: ast.AST
    tree: ast.Module
    parent: ast.AST
    place: tuple[str, int | None]

    def __str__(self) -> str:
        change = f"{ast.unparse(self.old)!r} -> {ast.unparse(self.node)!r}"
        return f"{self.path}:{self.lines.start} {self.function}: {self.operator} {change}"

    def plant(self) -> None:
        """Change the tree; only once, in a process that ends with the mutant."""
        ast.copy_location(self.node, self.old)
        name, index = self.place
        if index is None:
            setattr(self.parent, name, self.node)
        else:
            getattr(self.parent, name)[index] = self.node
        ast.fix_missing_locations(self.tree)


def mutants_of(path: Path) -> Iterator[Mutant]:
    """Yield all mutants of a file."""
    tree = ast.parse(path.read_text())
    for names, function in _functions(tree, ()):
        for parent, place, statement in _places(function, function):
            value = getattr(parent, place[0])
            old = value if place[1] is None else value[place[1]]
            for operator, node in _faults(old, place[0]):
                where: Any = {"path": path, "function": ".".join(names), "lines": _lines(statement)}
                change: Any = {"old": old, "node": node, "parent": parent, "place": place}
                yield Mutant(operator=operator, tree=tree, **where, **change)


def _functions(node: ast.AST, names: tuple[str, ...]) -> Iterator[tuple[tuple[str, ...], Any]]:
    """Yield the outermost functions and methods with their qualified names."""
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.FunctionDef):
            yield (*names, child.name), child
        elif isinstance(child, ast.ClassDef):
            yield from _functions(child, (*names, child.name))


def _places(
    parent: ast.AST, statement: ast.stmt
) -> Iterator[tuple[ast.AST, tuple[str, int | None], ast.stmt]]:
    """Yield where each node stands that may be changed, and the statement that it is part of."""
    for name, value in ast.iter_fields(parent):
        for index, node in enumerate(value if isinstance(value, list) else [value]):
            if name in _UNTOUCHED or not isinstance(node, ast.AST) or _is_text(node):
                continue
            inside = node if isinstance(node, ast.stmt) else statement
            yield parent, (name, index if isinstance(value, list) else None), inside
            if not isinstance(node, ast.Raise):
                yield from _places(node, inside)


def _is_text(node: ast.AST) -> bool:
    """Tell whether a node only says something, or is the head of a function."""
    if isinstance(node, ast.arguments):
        return True
    if isinstance(node, ast.keyword):
        return node.arg == "reason"
    if isinstance(node, ast.Expr):
        node = node.value
    is_failure = isinstance(node, ast.Call) and ast.unparse(node.func) == "Failure"
    is_string = isinstance(node, ast.Constant) and isinstance(node.value, str)
    return is_failure or is_string or isinstance(node, ast.JoinedStr)


def _lines(statement: ast.stmt) -> range:
    """Return the lines of a statement; of a compound one those of its head."""
    body = getattr(statement, "body", None)
    last = body[0].lineno - 1 if body else statement.end_lineno
    return range(statement.lineno, max(last or 0, statement.lineno) + 1)


def _faults(node: Any, name: str) -> Iterator[tuple[str, ast.AST]]:
    """Yield what may stand in the place of a node."""
    if name in ("test", "ifs") and isinstance(node, _CONDITIONS):
        yield "logic", ast.UnaryOp(op=ast.Not(), operand=node)
    if isinstance(node, ast.stmt):
        yield from _statements(node)
    if isinstance(node, ast.Compare):
        for other in _NEIGHBOURS[type(node.ops[0])] if len(node.ops) == 1 else ():
            yield "comparison", _changed(node, ops=[other()])
    elif isinstance(node, ast.BinOp) and isinstance(node.op, ast.MatMult):
        yield "arithmetic", _changed(node, left=node.right, right=node.left)
    elif isinstance(node, ast.BinOp | ast.BoolOp | ast.AugAssign):
        for other in _NEIGHBOURS.get(type(node.op), ()):
            yield "arithmetic", _changed(node, op=other())
    else:
        yield from _atoms(node)


def _changed(node: Any, **parts: object) -> ast.AST:
    changed: ast.AST = type(node)(**dict(ast.iter_fields(node)) | parts)
    return changed


def _atoms(node: Any) -> Iterator[tuple[str, ast.AST]]:
    if isinstance(node, ast.UnaryOp):
        yield "logic", node.operand
    elif isinstance(node, ast.Constant) and isinstance(node.value, int | float):
        value = node.value
        is_large = isinstance(value, float) and abs(value) > 1e3
        new = not value if isinstance(value, bool) else value * 2 if is_large else value + 1
        yield "number", ast.Constant(value=new)
    elif isinstance(node, ast.Attribute) and node.attr in _NAMES:
        yield "name", _changed(node, attr=_NAMES[node.attr])
    elif isinstance(node, ast.Name) and node.id in _NAMES:
        yield "name", _changed(node, id=_NAMES[node.id])
    elif isinstance(node, ast.Call) and not ast.unparse(node.func).rpartition(".")[2][:1].isupper():
        for each in node.keywords:
            rest = [other for other in node.keywords if other is not each]
            if each.arg and each.arg not in _HARMLESS:
                yield "argument", _changed(node, keywords=rest)


def _statements(node: ast.stmt) -> Iterator[tuple[str, ast.AST]]:
    is_left_out = isinstance(node, ast.Raise | ast.AugAssign | ast.Expr)
    if isinstance(node, ast.Assign):
        is_left_out = isinstance(node.targets[0], ast.Attribute | ast.Subscript)
    if is_left_out:
        yield "statement", ast.Pass()
    elif isinstance(node, ast.Break | ast.Continue):
        yield "statement", ast.Continue() if isinstance(node, ast.Break) else ast.Break()
    elif isinstance(node, ast.Return) and not isinstance(node.value, ast.Constant | None):
        yield "statement", ast.Return(value=ast.Constant(value=None))


@dataclass(kw_only=True, eq=False)
class Mutation:
    """A pytest plugin that runs mutants in place of the tests."""

    mutants: list[Mutant]
    jobs: int
    survivors: list[Mutant] = field(default_factory=list)
    n_run: int = 0
    failed: bool = False
    reason: str = ""  # why a test fails without a mutant

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        if report.failed:
            self.failed, self.reason = True, report.longreprtext.rpartition("\n")[2]

    def pytest_runtestloop(self, session: pytest.Session) -> bool:
        with tempfile.TemporaryDirectory() as folder:
            answer = Path(folder) / "reached.json"
            pid = os.fork()
            if pid == 0:
                _hush()
                self._measure(session, answer)
            if os.waitpid(pid, 0)[1]:
                self.reason = answer.read_text() if answer.exists() else "all of them"
                return True
            seconds, reached = json.loads(answer.read_text())
        gc.freeze()  # so that forks share what is there
        running: dict[int, Mutant] = {}
        for mutant in self.mutants:
            lines = reached.get(str(mutant.path), {})
            names = {name for line in mutant.lines for name in lines.get(str(line), []) if name}
            chosen = sorted(map(int, names), key=lambda test: seconds[test])
            running[self._fork(mutant, session, chosen, seconds)] = mutant
            while len(running) >= self.jobs:
                self._await(running)
        while running:
            self._await(running)
        return True

    def _measure(self, session: pytest.Session, answer: Path) -> None:
        """Write down how long each test takes and which lines it reaches, or which one fails."""
        files = sorted({str(mutant.path) for mutant in self.mutants})
        tracer = coverage.Coverage(data_file=None, config_file=False, include=files)
        tracer.start()
        seconds = []
        indices = range(len(session.items))
        for index, following in zip_longest(indices, indices[1:]):
            tracer.switch_context(str(index))
            start = time.process_time()
            self._run_test(session, index, following)
            seconds.append(time.process_time() - start)
            if self.failed:
                answer.write_text(f"{session.items[index].nodeid}: {self.reason}")
                os._exit(1)
        tracer.stop()
        data = tracer.get_data()
        reached = {file: data.contexts_by_lineno(file) for file in data.measured_files()}
        answer.write_text(json.dumps([seconds, reached]))
        os._exit(0)

    def _run_test(self, session: pytest.Session, index: int, following: int | None) -> None:
        item = session.items[index]
        next_item = None if following is None else session.items[following]
        try:
            item.ihook.pytest_runtest_protocol(item=item, nextitem=next_item)
        except BaseException as error:  # noqa: BLE001 - as pytest.exit or an interrupt
            self.failed, self.reason = True, repr(error)

    def _fork(
        self, mutant: Mutant, session: pytest.Session, tests: list[int], seconds: list[float]
    ) -> int:
        """Start the tests of a mutant; the process ends with 0 where none fails."""
        pid = os.fork()
        if pid:
            return pid
        _hush()
        signal.signal(signal.SIGPROF, signal.SIG_DFL)
        try:
            is_usable = install(mutant)
        except (KeyError, SyntaxError, ValueError):
            is_usable = False
        if not is_usable:
            os._exit(UNUSABLE)
        for test, following in zip_longest(tests, tests[1:]):
            signal.setitimer(signal.ITIMER_PROF, SPARE_S + PATIENCE * seconds[test])
            self._run_test(session, test, following)
            if self.failed:
                break
        os._exit(int(self.failed))

    def _await(self, running: dict[int, Mutant]) -> None:
        pid, status = os.wait()
        mutant = running.pop(pid)
        self.n_run += os.waitstatus_to_exitcode(status) != UNUSABLE
        if status == 0:
            self.survivors.append(mutant)
            print(mutant, file=sys.__stdout__, flush=True)


def install(mutant: Mutant) -> bool:
    """Put a mutant in the place of what is imported; False where it cannot be."""
    mutant.plant()
    file = str(mutant.path)
    module = compile(mutant.tree, file, "exec", dont_inherit=True)
    codes = {code.co_firstlineno: code for code in _codes(module, mutant.function)}
    gc.unfreeze()
    functions = [
        each
        for each in gc.get_objects()
        if isinstance(each, FunctionType)
        and (each.__code__.co_filename, each.__code__.co_qualname) == (file, mutant.function)
    ]
    for function in functions:
        function.__code__ = codes[function.__code__.co_firstlineno]
    return bool(functions)


def _codes(code: CodeType, name: str) -> Iterator[CodeType]:
    for each in code.co_consts:
        if isinstance(each, CodeType):
            if each.co_qualname == name:
                yield each
            yield from _codes(each, name)


def _hush() -> None:
    nothing = os.open(os.devnull, os.O_RDWR)
    for stream in (0, 1, 2):
        os.dup2(nothing, stream)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--paths", nargs="+", default=PATHS, help="files or folders to change")
    parser.add_argument("--tests", nargs="+", default=TESTS, help="tests that should notice")
    parser.add_argument("--sample", type=int, default=200, metavar="N")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--jobs", type=int, default=2)
    arguments = parser.parse_args()
    os.chdir(ROOT)
    os.environ["GVO_KERNELS"] = "python"
    cv2.setNumThreads(1)  # a fork has no threads, and would wait for them
    given = [Path(path).resolve() for path in arguments.paths]
    files = [file for path in given for file in (sorted(path.rglob("*.py")) or [path])]
    changed = [file for file in files if file.exists() and file not in NOT_CHANGED]
    every = [mutant for file in changed for mutant in mutants_of(file)]
    random.Random(arguments.seed).shuffle(every)
    mutation = Mutation(mutants=every[: arguments.sample], jobs=arguments.jobs)
    tests = [test for test in arguments.tests if Path(test).exists()]
    options = ["-q", "-p", "no:cacheprovider", "-n", "0", "--hypothesis-seed=0"]
    options += ["-o", WARNINGS]
    with Path(os.devnull).open("w") as nothing, redirect_stdout(nothing):
        code = pytest.main([*options, *tests], plugins=[mutation])
    if mutation.n_run == 0:
        failing = f"without a mutant this fails: {mutation.reason}"
        unable = f"no mutant could be run (pytest ended with {int(code)})"
        print(f"mutation: {failing if mutation.reason else unable}", file=sys.stderr)
        return 2
    n_killed = mutation.n_run - len(mutation.survivors)
    low, high = binomtest(n_killed, mutation.n_run).proportion_ci(method="wilson")
    print(
        f"{n_killed} of {mutation.n_run} noticed ({100 * n_killed / mutation.n_run:.1f} %); "
        f"{100 * low:.1f} to {100 * high:.1f} % of all {len(every)}"
    )
    return int(n_killed < MIN_KILLED * mutation.n_run)


if __name__ == "__main__":
    sys.exit(main())
