"""Trajectories, their files, their alignment and evaluation."""
