"""Readers of bags that rosbags refuses: never closed, truncated, damaged.

They walk over the records of a file, need no index, and allocate no more than what is there.
"""
