"""Routes, splines, and motion of a robot's body."""
