"""Images to observations to relative poses."""
