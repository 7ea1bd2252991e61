"""A site's markers, measured in its map, and the scale of a rig by known markers."""
