"""The sliding window; the only part that knows GTSAM."""
