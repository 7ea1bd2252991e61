"""Rendering: a picture and its depth from a scene and the motion of a camera."""
