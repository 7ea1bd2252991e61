"""Features of images: corners, descriptors, matches, sub-pixel positions."""
