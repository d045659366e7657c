"""Cameras and poses in ROS bags: files, topics, messages, calibrations."""
