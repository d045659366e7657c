"""Trajectories: their files, alignment and evaluation."""
