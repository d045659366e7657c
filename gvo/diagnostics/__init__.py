"""Diagnostics: check a recording before a run, explain one of its frames."""
