"""Recordings, poses and edges: read and written."""
