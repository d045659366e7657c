"""Calibrations out of CameraInfo messages and calibration files."""
