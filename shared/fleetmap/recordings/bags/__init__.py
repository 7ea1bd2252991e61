"""Recordings as messages on topics, independent of the file format."""
