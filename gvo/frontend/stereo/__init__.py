"""Stereo: matches along rows, sub-pixel disparities, offsets of the rig."""
