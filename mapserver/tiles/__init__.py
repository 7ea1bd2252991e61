"""From a survey to tiles: which landmarks robots get, and in which tile."""
