"""Compilation of kernels, the small dense linear algebra that they share, and memory."""
