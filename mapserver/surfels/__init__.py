"""Surfels: a renderable map of a version, expected views of a camera, and differences of pictures from them. Pure."""
