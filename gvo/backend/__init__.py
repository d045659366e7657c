"""The sliding window of poses; the only package that imports gtsam."""
