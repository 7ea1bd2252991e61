"""Compilation of kernels, and the small dense linear algebra that they share."""
