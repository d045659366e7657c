"""What notebooks show of values: HTML with small drawings, as strings."""
