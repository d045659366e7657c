"""The sub-commands of benchmark.py, a module each."""
