"""Data-set folders: KITTI odometry, EuRoC (ASL), TUM RGB-D."""
