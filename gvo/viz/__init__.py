"""Plots, overlays, films, reports and the page in the browser."""
