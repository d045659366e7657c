"""Odometry: the raw chain, keyframes and segments, driving front-end and back-end."""
