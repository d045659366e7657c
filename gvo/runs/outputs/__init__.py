"""What a run writes besides its folder: a bag, a film, a Rerun file."""
