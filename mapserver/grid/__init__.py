"""The occupancy grid and the height map of a site, from the pictures of its surveys. Pure."""
