"""Stereo: matches along rows and sub-pixel disparities."""
