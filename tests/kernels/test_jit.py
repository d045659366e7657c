"""How kernels are compiled and kept, on a small package of two of them, in processes."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

import gvo.kernels

_HELPERS = """
from gvo.kernels.jit import helper


@helper
def twice(x):
    return 2.0 * x
"""
_LOOPS = """
from gvo.kernels.helpers import twice
from gvo.kernels.jit import In, Out, kernel


@kernel(In("f8", 1), "f8", Out("f8", 1))
def scale(values, factor, scaled):
    for k in range(len(values)):
        scaled[k] = twice(values[k]) * factor


@kernel(In("u1", 2), Out("i8", 1))
def count(image, n):
    for v in range(image.shape[0]):
        for u in range(image.shape[1]):
            n[0] += image[v, u] > 0
"""
# Prints what was scaled, and how many of the two kernels were compiled and not loaded.
_CALL = """
import numpy as np
from gvo.kernels import loops
scaled = np.empty(2)
loops.scale(np.array([1.0, 2.0]), 3.0, scaled)
n_compiled = sum(not each.stats.cache_hits for each in (loops.scale, loops.count))
print(*scaled, n_compiled)
"""
_LINE = "compiling, once on this machine: 1 of 2\n"


@pytest.fixture
def package(tmp_path: Path) -> Path:
    """Return a folder with a package gvo that has the module to be tested, and two kernels."""
    kernels = tmp_path / "gvo/kernels"
    kernels.mkdir(parents=True)
    (tmp_path / "gvo/__init__.py").touch()
    (tmp_path / "gvo/_version.py").write_text('__version__ = "1.2"\n')
    jit = Path(gvo.kernels.__file__).with_name("jit.py").read_text("utf-8")
    for name, text in (("__init__", ""), ("jit", jit), ("helpers", _HELPERS), ("loops", _LOOPS)):
        (kernels / f"{name}.py").write_text(text)
    return tmp_path


def started(package: Path, program: str = _CALL, **environment: str) -> subprocess.Popen[str]:
    home = {"XDG_CACHE_HOME": str(package / "cache"), "PYTHONPATH": str(package)}
    home["NUMBA_DISABLE_JIT"] = "0"
    return subprocess.Popen(
        [sys.executable, "-c", program],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        cwd=package,
        env=os.environ | home | environment,
    )


def said(package: Path, program: str = _CALL, **environment: str) -> tuple[str, str]:
    """Return standard output and error of a program that ends well."""
    process = started(package, program, **environment)
    out, err = process.communicate(timeout=120)
    assert process.returncode == 0, err
    return out, err


def folders(package: Path) -> list[Path]:
    return sorted((package / "cache/gvo").iterdir())


def test_what_was_compiled_once_is_loaded(package: Path) -> None:
    assert said(package) == ("6.0 12.0 2\n", _LINE)
    (folder,) = folders(package)
    assert folder.name.startswith("kernels-1.2-")
    kept = {path: path.stat().st_mtime_ns for path in folder.rglob("*.nb?")}
    assert len(kept) == 4
    assert said(package) == ("6.0 12.0 0\n", "")
    assert kept == {path: path.stat().st_mtime_ns for path in folder.rglob("*.nb?")}


@pytest.mark.parametrize("edited", ["gvo/kernels/helpers.py", "gvo/_version.py"])
def test_an_edit_elsewhere_or_an_update_compiles_anew(package: Path, edited: str) -> None:
    said(package)
    path = package / edited
    path.write_text(path.read_text().replace("2", "5"))
    expected = "15.0 30.0" if "helpers" in edited else "6.0 12.0"
    assert said(package) == (f"{expected} 2\n", _LINE)
    assert len(folders(package)) == 2


@pytest.mark.parametrize("is_within", [False, True])
def test_a_place_that_cannot_be_written_is_no_matter(package: Path, is_within: bool) -> None:
    path = package / "cache/gvo" if is_within else package / "cache"
    path.parent.mkdir(exist_ok=True)
    path.write_text("a file")
    assert said(package) == ("6.0 12.0 2\n", "")
    assert path.read_text() == "a file"


def test_without_that_variable_the_cache_is_in_the_home(package: Path) -> None:
    said(package, XDG_CACHE_HOME="", HOME=str(package / "home"))
    assert len([*(package / "home/.cache/gvo").glob("kernels-1.2-*/**/*.nbi")]) == 2


def test_of_two_processes_one_compiles_and_the_other_waits(package: Path) -> None:
    program = 'import numba\nprint("ready", flush=True)\ninput()\n' + _CALL
    processes = [started(package, program) for _ in range(2)]
    for process in processes:
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"
    for process in processes:
        assert process.stdin is not None
        process.stdin.write("\n")
        process.stdin.flush()
    n_compiled = []
    for process in processes:
        out, err = process.communicate(timeout=120)
        assert process.returncode == 0, err
        *scaled, n = out.split()
        assert scaled == ["6.0", "12.0"]
        n_compiled.append(int(n))
    assert sum(n_compiled) == 2


def test_one_compilation_takes_read_only_and_writeable_arrays_alone(package: Path) -> None:
    program = """
import numpy as np
from gvo.kernels.loops import scale
values, scaled = np.array([1.0, 2.0]), np.empty(2)
scale(values, 3.0, scaled)
values.flags.writeable = False
scale(values, 3.0, scaled)
print(len(scale.signatures))
fixed = np.empty(2)
fixed.flags.writeable = False
for wrong in (
    (values.astype(np.float32), 3.0, scaled),
    (np.arange(2), 3.0, scaled),
    (np.zeros(4)[::2], 3.0, scaled),
    (np.zeros((1, 2)), 3.0, scaled),
    (values, 3.0, fixed),
    (values, 3.0),
):
    try:
        scale(*wrong)
        print("taken")
    except TypeError:
        print("refused")
print(len(scale.signatures))
"""
    assert said(package, program)[0].split() == ["1", *["refused"] * 6, "1"]


def test_python_itself_runs_kernels_where_nothing_may_be_compiled(package: Path) -> None:
    program = _CALL.replace("each.stats.cache_hits", "False")
    assert said(package, program, NUMBA_DISABLE_JIT="1") == ("6.0 12.0 2\n", "")
    assert not (package / "cache").exists()
