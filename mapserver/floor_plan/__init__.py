"""The drawing of a building: the pose of a site's map in it, and named areas."""
