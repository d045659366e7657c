"""One recording, one folder: a run, smoothing of other front-ends' edges, a round trip."""
