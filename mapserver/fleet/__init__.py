"""The robots that a server knows: what they run, what they report, what follows from it."""
