"""Tests for a front-end of one's own, and faults to put into recordings."""

from gvo.testing.frontend import ContractError, check_frontend

__all__ = ["ContractError", "check_frontend"]
