"""Tests that others can run on what they plug in."""

from gvo.testing.frontend import ContractError, check_frontend

__all__ = ["ContractError", "check_frontend"]
