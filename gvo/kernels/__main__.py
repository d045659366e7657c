"""Compile all kernels now, not in the first run: `python -m gvo.kernels`."""

from __future__ import annotations

from gvo.kernels.jit import machine_code

if __name__ == "__main__":
    machine_code()
