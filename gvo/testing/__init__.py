"""Tests for a front-end of one's own, and faults to put into recordings."""

from gvo.testing.faults import Black, Dropped, FaultySource
from gvo.testing.frontend import ContractError, check_frontend

__all__ = ["Black", "ContractError", "Dropped", "FaultySource", "check_frontend"]
