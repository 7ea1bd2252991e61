"""Sources of priors: what a robot knows of its place without the map."""
