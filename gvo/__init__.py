"""Visual odometry for calibrated stereo and RGB-D cameras, with a sliding-window back-end."""

__version__ = "0.1.0"
