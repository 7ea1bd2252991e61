"""Routes, splines, and how a robot's body moves."""
