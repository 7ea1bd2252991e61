"""Keyframe selection, connected components, revisit thinning."""
