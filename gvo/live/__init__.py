"""Odometry of a camera that is running: from any program, or from a device."""
