"""Plots, pictures, reports and films."""
