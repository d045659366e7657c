"""Recordings: folders, bags and rendered worlds, read as frames."""
