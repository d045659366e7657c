"""One recording, one folder: a run, or the smoothing of other front-ends' edges."""
