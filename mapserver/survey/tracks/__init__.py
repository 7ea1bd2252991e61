"""Landmarks from verified keyframe pairs."""
