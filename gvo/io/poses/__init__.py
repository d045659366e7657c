"""Recorded poses: tf, ground truth, and the frame whose poses are written."""
