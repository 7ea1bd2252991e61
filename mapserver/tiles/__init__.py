"""From a survey to tiles: choice of landmarks for robots, and their tiles."""
