"""Textures, painted from one seed."""
