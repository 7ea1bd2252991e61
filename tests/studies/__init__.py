"""Experiments whose results are kept: each a script, a picture, and a page under docs/studies."""
