"""The drawing of a building: where a site's map lies in it, and the areas that people have names for."""
