"""The sliding window of poses; the only room that imports GTSAM."""
