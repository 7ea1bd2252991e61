"""Recordings as messages on topics, whatever file they lie in."""
