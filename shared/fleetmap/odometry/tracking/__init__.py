"""Feature tracking from frame to frame."""
