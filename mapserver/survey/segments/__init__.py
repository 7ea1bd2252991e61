"""Long surveys in segments that overlap: each is followed and adjusted in parallel with others, and joined to the one before."""
