"""Dense maps of a version: occupancy grid, surfels, pictures of the surveys, and what is seen of them."""
