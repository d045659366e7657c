"""Recordings written as bags or as data-set folders."""
