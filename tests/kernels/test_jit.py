"""How kernels are compiled and kept, on a small package of two of them, in processes."""

import os
import shutil
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
# Prints what was scaled; Numba is not loaded.
_CALL = """
import sys
import numpy as np
from gvo.kernels import loops
scaled = np.empty(2)
loops.scale(np.array([1.0, 2.0]), 3.0, scaled)
assert "numba" not in sys.modules
print(*scaled)
"""
_SCALED = "6.0 12.0\n"
_LINE = "compiling, once on this machine: 1 of 2\n"


def fill(folder: Path) -> Path:
    """Write a package gvo that has the module to be tested, and two kernels."""
    kernels = folder / "gvo/kernels"
    kernels.mkdir(parents=True)
    (folder / "gvo/__init__.py").touch()
    (folder / "gvo/_version.py").write_text('__version__ = "1.2"\n')
    source = Path(gvo.kernels.__file__).parent
    for name in ("errors.py", "_text.py"):
        shutil.copy(source.with_name(name), folder / "gvo")
    texts = {name: (source / f"{name}.py").read_text("utf-8") for name in ("jit", "compiler")}
    for name, text in (texts | {"__init__": "", "helpers": _HELPERS, "loops": _LOOPS}).items():
        (kernels / f"{name}.py").write_text(text)
    return folder


@pytest.fixture
def package(tmp_path: Path) -> Path:
    """Return a folder with a package gvo of which nothing is compiled."""
    return fill(tmp_path)


@pytest.fixture(scope="module")
def compiled(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the cache in which what `package` holds is compiled; it depends on no path."""
    folder = fill(tmp_path_factory.mktemp("compiled"))
    assert said(folder) == (_SCALED, _LINE)
    return folder / "cache"


@pytest.fixture
def compiled_package(package: Path, compiled: Path) -> Path:
    shutil.copytree(compiled, package / "cache")
    return package


def started(package: Path, program: str = _CALL, **environment: str) -> subprocess.Popen[str]:
    home = {"XDG_CACHE_HOME": str(package / "cache"), "PYTHONPATH": str(package)}
    home["GVO_KERNELS"] = ""
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


def kept(package: Path) -> list[Path]:
    return sorted((package / "cache/gvo").rglob("*.o"))


def test_what_was_compiled_once_is_loaded(compiled_package: Path) -> None:
    (path,) = kept(compiled_package)
    assert path.parent.name.startswith("kernels-1.2-")
    made_ns = path.stat().st_mtime_ns
    assert said(compiled_package) == (_SCALED, "")
    assert path.stat().st_mtime_ns == made_ns


@pytest.mark.parametrize("edited", ["gvo/kernels/helpers.py", "gvo/_version.py"])
def test_an_edit_elsewhere_or_an_update_compiles_anew(compiled_package: Path, edited: str) -> None:
    path = compiled_package / edited
    path.write_text(path.read_text().replace("2", "5"))
    expected = "15.0 30.0\n" if "helpers" in edited else _SCALED
    assert said(compiled_package) == (expected, _LINE)
    assert len(kept(compiled_package)) == 2


def test_a_broken_file_is_made_anew(compiled_package: Path) -> None:
    (path,) = kept(compiled_package)
    whole = path.read_bytes()
    path.write_bytes(whole[:1000])
    assert said(compiled_package) == (_SCALED, _LINE)
    assert path.read_bytes() == whole


def test_a_place_that_cannot_be_written_is_no_matter(package: Path) -> None:
    path = package / "cache"
    path.write_text("a file")
    assert said(package) == (_SCALED, "")
    assert path.read_text() == "a file"


def test_without_that_variable_the_cache_is_in_the_home(package: Path) -> None:
    before = {*package.rglob("*")}
    said(package, XDG_CACHE_HOME="", HOME=str(package / "home"), PYTHONDONTWRITEBYTECODE="1")
    assert len([*(package / "home/.cache/gvo").glob("kernels-1.2-*/*.o")]) == 1
    written = [path for path in {*package.rglob("*")} - before if path.is_file()]
    assert all(path.is_relative_to(package / "home/.cache/gvo") for path in written)


def test_of_two_processes_one_compiles_and_the_other_waits(package: Path) -> None:
    program = 'print("ready", flush=True)\ninput()\n' + _CALL
    processes = [started(package, program) for _ in range(2)]
    for process in processes:
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"
    for process in processes:
        assert process.stdin is not None
        process.stdin.write("\n")
        process.stdin.flush()
    answers = [process.communicate(timeout=120) for process in processes]
    assert sorted(answers) == [(_SCALED, ""), (_SCALED, _LINE)]


@pytest.mark.parametrize(
    ("body", "why"),
    [
        ("    if n[0] > 2:\n        raise ValueError\n", "must neither raise nor make arrays"),
        ("    n[0] = np.empty(len(image)).sum()\n", "must neither raise nor make arrays"),
        ("    image[0, 0] = 1\n", "annot modify readonly array"),
    ],
)
def test_a_kernel_that_does_what_it_must_not_is_not_compiled(
    package: Path, body: str, why: str
) -> None:
    path = package / "gvo/kernels/loops.py"
    path.write_text("import numpy as np\n" + path.read_text() + body)
    process = started(package)
    _, err = process.communicate(timeout=120)
    assert process.returncode == 1
    assert why in err
    assert "the kernels could not be compiled" in err
    assert not kept(package)


def test_arrays_that_compiled_code_would_misread_are_refused(compiled_package: Path) -> None:
    program = """
import numpy as np
from gvo.kernels.loops import scale
values, scaled = np.array([1.0, 2.0]), np.empty(2)
scale(values, 3.0, scaled)
values.flags.writeable = False
scale(values, 3.0, scaled)
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
"""
    assert said(compiled_package, program)[0].split() == ["refused"] * 6


def test_python_itself_runs_kernels_where_it_is_told_to(package: Path) -> None:
    assert said(package, GVO_KERNELS="python") == (_SCALED, "")
    assert not (package / "cache").exists()
