"""The table in docs/reliability.md is the catalogue of faults."""

from pathlib import Path

import pytest

from gvo.testing import faults
from gvo.testing.faults import Fault
from tests.testing.catalogue import FAULTS, parameters
from tests.testing.named import describe_faults
from tests.testing.test_faults_runs import N_SKIPPED, N_UNPAIRED, TOLD

PAGE = Path(__file__).parents[2] / "docs/reliability.md"
GROUPS = list(dict.fromkeys(fault.group for fault in FAULTS.values()))


@pytest.mark.parametrize("group", GROUPS)
def test_the_page_shows_all_faults_of_a_group(group: str) -> None:
    table = describe_faults(fault for fault in FAULTS.values() if fault.group == group)
    assert f"\n{table}\n" in PAGE.read_text()


def test_the_short_run_takes_one_fault_of_each_group() -> None:
    chosen = [fault.group for fault in FAULTS.values() if not parameters(fault=fault).marks]
    assert chosen == GROUPS


def test_the_page_counts_the_faults() -> None:
    assert f"{len(FAULTS)} faults" in PAGE.read_text()
    assert len(FAULTS) >= 45


def test_the_page_names_the_faults_that_a_run_does_not_tell() -> None:
    silent = [f"`{fault.name}`" for fault in FAULTS.values() if fault.is_silent]
    assert ", ".join(silent) in " ".join(PAGE.read_text().split())


def test_all_kinds_of_faults_are_in_the_catalogue() -> None:
    sound = type("Sound", (), {"info": type("Info", (), {"sensor": "stereo"})()})()
    made = {type(part) for fault in FAULTS.values() for part in fault.make(sound)}
    public = [getattr(faults, name) for name in faults.__all__]
    kinds = [kind for kind in public if isinstance(kind, type) and issubclass(kind, Fault)]
    bases = {base for kind in kinds for base in kind.__mro__[1:]}
    assert set(kinds) - bases - made == set()


def test_what_is_expected_is_of_faults_that_exist() -> None:
    assert {*N_SKIPPED, *N_UNPAIRED, *TOLD} <= set(FAULTS)
