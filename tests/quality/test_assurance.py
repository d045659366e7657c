"""The mutants of a small module, and what tests of known strength make of them."""

from pathlib import Path

import pytest

from tests.conftest import python

pytestmark = pytest.mark.acceptance

HERE = Path(__file__).parent

MODULE = '''
"""A module."""

LIMIT = 3


def clip(value: int, *, step: int = 1) -> int:
    """Return 1 more, but never more than the limit."""
    if value < 0:
        raise ValueError(f"{value - 1} is below {0}")
    return min(value + step, LIMIT)


def wait(n: int) -> None:
    while n > 0:
        n -= 1


def forgotten() -> int:
    return 2 + 2
'''
TESTS = """
import module
import pytest


@pytest.mark.parametrize(("value", "expected"), [(0, 1), (1, 2), (2, 3), (3, 3), (5, 3)])
def test_it_clips(value, expected):
    assert module.clip(value) == expected


def test_a_negative_one_is_refused():
    with pytest.raises(ValueError):
        module.clip(-1)


def test_it_waits():
    module.wait(2)
"""


def test_faults_that_no_test_sees_survive_and_others_do_not(tmp_path: Path) -> None:
    (tmp_path / "module.py").write_text(MODULE)
    (tmp_path / "test_module.py").write_text(TESTS)
    options = ["--paths", tmp_path / "module.py", "--tests", tmp_path / "test_module.py"]
    options += ["--results", tmp_path / "results.json", "--spare-s", "1"]
    first, second = (python(HERE / "assurance.py", "--mutation", *options) for _ in range(2))
    assert first.returncode == 1, first.stderr  # less than the aim
    *survivors, _heading, _row, total = first.stdout.splitlines()
    changes = {line.partition(" ")[2] for line in survivors}
    # Nothing tells the end of a wait from that of a shorter one; what no test calls is not seen.
    assert changes == {
        *("wait: comparison 'n > 0' -> 'n >= 0'", "wait: comparison 'n > 0' -> 'n <= 0'"),
        *("wait: number '0' -> '1'", "wait: number '1' -> '2'"),
        "forgotten: statement 'return 2 + 2' -> 'return None'",
        *("forgotten: arithmetic '2 + 2' -> '2 - 2'", "forgotten: number '2' -> '3'"),
    }
    # What never ends is ended: `n -= 1` left out, or turned round.
    assert total.split()[2] == "2", total
    assert second.stdout == first.stdout
    assert " 0 to run" in second.stderr
