"""The catalogue of faults is the page docs/reliability.md."""

from typing import Any

from gvo.testing import faults
from gvo.testing.faults import Fault
from tests.testing.catalogue import FAULTS, MADE, PAGE, parameters
from tests.testing.test_faults_runs import N_SKIPPED, N_UNPAIRED, TOLD


def test_the_page_shows_each_fault_that_is_made() -> None:
    assert list(FAULTS) == list(MADE)
    assert f"{len(FAULTS)} faults" in PAGE.read_text()
    assert any(fault.is_silent for fault in FAULTS.values())


def test_the_short_run_takes_one_fault_of_each_group() -> None:
    chosen = [fault.group for fault in FAULTS.values() if not parameters(fault=fault).marks]
    assert chosen == list(dict.fromkeys(fault.group for fault in FAULTS.values()))
    assert len(chosen) == 7


def test_all_kinds_of_faults_are_in_the_catalogue() -> None:
    sound: Any = type("Sound", (), {"info": type("Info", (), {"sensor": "stereo"})()})()
    made = {type(fault) for name in FAULTS for fault in FAULTS[name].wrap(sound).faults}
    kinds = [kind for kind in vars(faults).values() if isinstance(kind, type)]
    kinds = [kind for kind in kinds if issubclass(kind, Fault)]
    bases = {base for kind in kinds for base in kind.__mro__[1:]}
    assert set(kinds) - bases - made == set()


def test_what_is_expected_is_of_faults_that_exist() -> None:
    assert {*N_SKIPPED, *N_UNPAIRED, *TOLD} <= set(FAULTS)
