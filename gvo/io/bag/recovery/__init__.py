"""Readers of ROS 1 bags and MCAP files without their index."""
