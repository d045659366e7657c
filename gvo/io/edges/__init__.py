"""What other front-ends give: pose graphs, pose streams, lines."""
