"""How kernels are compiled, and the small dense linear algebra that they share."""
