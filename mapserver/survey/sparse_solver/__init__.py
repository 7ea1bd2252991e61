"""Cholesky factorisation of large sparse matrices of poses."""
