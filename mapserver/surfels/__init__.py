"""A map that renders: surfels of a version, what a camera should see of them, and how a picture differs from that. Pure."""
