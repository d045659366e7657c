"""Loops over points, corners and pixels, compiled: arrays in, arrays out."""
