"""Diagnostics: a recording checked before a run, one frame explained."""
