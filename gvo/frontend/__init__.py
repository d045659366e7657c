"""From images to observations, from two frames' observations to a relative pose."""
